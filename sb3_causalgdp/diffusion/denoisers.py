"""Networks that predict the noise in an action."""

import math
from collections.abc import Callable
from itertools import pairwise

import torch as th
from torch import nn

from sb3_causalgdp.acceleration.activations import fast
from sb3_causalgdp.acceleration.products import Linear, linear


def sinusoidal_embedding(n_steps: int, dimension: int) -> th.Tensor:
    """
    Sinusoidal embedding of the diffusion steps (Vaswani et al., 2017, as used by Diffusion-QL).

    :param n_steps: Number of diffusion steps K
    :param dimension: Size of the embedding, an even number of at least 4
    :return: Table of shape ``(K, dimension)``
    """
    if dimension < 4 or dimension % 2:
        raise ValueError(f"time_embedding_dim must be an even number of at least 4, got {dimension}")
    half = dimension // 2
    frequency = th.exp(th.arange(half) * (-math.log(10_000) / (half - 1)))
    angle = th.arange(n_steps).unsqueeze(1) * frequency
    return th.cat([angle.sin(), angle.cos()], dim=1)


class MLPDenoiser(nn.Module):
    """
    Predicts the noise eps_theta(a^k, k, s) with a multi-layer perceptron on ``[a^k, embedding of k, condition]``.

    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation
    :param n_steps: Number of diffusion steps K
    :param net_arch: Hidden layers, ``[]`` is a linear denoiser
    :param activation_fn: Activation class
    :param time_embedding_dim: Size of the embedding of the diffusion step
    :param alpha_bar: Where the perceptron gives the velocity v = sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) a^0 (Salimans and
        Ho, 2022, section 4), from which the noise follows: alpha_bar of each diffusion step, shape ``(K,)``. What it says of
        the clean action is then of one size at all steps. None where it gives the noise itself
    """

    time_table: th.Tensor
    signal_and_noise: th.Tensor

    def __init__(
        self,
        action_dim: int,
        condition_dim: int,
        n_steps: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.Mish,
        time_embedding_dim: int = 16,
        alpha_bar: th.Tensor | None = None,
    ) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.predicts_velocity = alpha_bar is not None
        parts = th.zeros(2, n_steps, 1) if alpha_bar is None else th.stack([alpha_bar, 1.0 - alpha_bar]).sqrt().unsqueeze(2)
        self.register_buffer("signal_and_noise", parts, persistent=False)
        self.register_buffer("time_table", sinusoidal_embedding(n_steps, time_embedding_dim), persistent=False)
        self.time_mlp = nn.Sequential(
            nn.Linear(time_embedding_dim, 2 * time_embedding_dim),
            nn.Mish(),
            nn.Linear(2 * time_embedding_dim, time_embedding_dim),
        )
        first, *rest = [*net_arch, action_dim]
        self.input_layer = nn.Linear(action_dim + time_embedding_dim + condition_dim, first)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise([first, *rest]):
            layers += [fast(activation_fn)(), Linear(inputs, outputs)]
        self.network = nn.Sequential(*layers)

    def bind(self, condition: th.Tensor) -> Callable[[th.Tensor, int | th.Tensor], th.Tensor]:
        """
        Do what is the same for all steps of a chain once: the condition's and the steps' parts of the first layer.

        :param condition: Features of the observation, shape ``(batch, condition_dim)``
        :return: Predicts the noise from the noisy action and the diffusion step, as :meth:`forward` does
        """
        time_dim = self.time_table.shape[1]
        action_weight, time_weight, condition_weight = self.input_layer.weight.split(
            [self.action_dim, time_dim, condition.shape[1]], dim=1
        )
        from_condition = linear(condition, condition_weight, self.input_layer.bias)
        from_time = linear(self.time_mlp(self.time_table), time_weight)

        def predict_noise(noisy_action: th.Tensor, step: int | th.Tensor) -> th.Tensor:
            output = self.network(th.addmm(from_condition + from_time[step], noisy_action, action_weight.t()))
            if not self.predicts_velocity:
                return output
            signal, noise = self.signal_and_noise
            return signal[step] * output + noise[step] * noisy_action

        return predict_noise

    def forward(self, noisy_action: th.Tensor, step: int | th.Tensor, condition: th.Tensor) -> th.Tensor:
        """
        :param noisy_action: a^k, shape ``(batch, d)``
        :param step: Index of the diffusion step, ``0..K-1``: one for all, or shape ``(batch,)``
        :param condition: Features of the observation, shape ``(batch, condition_dim)``
        :return: Predicted noise, shape ``(batch, d)``
        """
        return self.bind(condition)(noisy_action, step)
