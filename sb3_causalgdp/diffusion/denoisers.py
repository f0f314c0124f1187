"""Networks that predict the noise in an action."""

import math
from itertools import pairwise

import torch as th
from torch import nn

from sb3_causalgdp.acceleration.activations import fast
from sb3_causalgdp.acceleration.products import Linear, linear
from sb3_causalgdp.diffusion.guidance import NoisePredictor
from sb3_causalgdp.diffusion.schedules import at_step


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


class Velocity(nn.Module):
    """
    The noise that follows from a network's output where this is the velocity
    ``v = sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) a^0`` (Salimans and Ho, 2022, section 4). What the network says of the
    clean action is then of one size at all steps.

    :param alpha_bar: Share of signal left at each diffusion step, shape ``(K,)``
    """

    signal_and_noise: th.Tensor
    log_snr: th.Tensor

    def __init__(self, alpha_bar: th.Tensor) -> None:
        super().__init__()
        parts = th.stack([alpha_bar, 1.0 - alpha_bar]).sqrt().unsqueeze(2)
        self.register_buffer("signal_and_noise", parts, persistent=False)
        self.register_buffer("log_snr", alpha_bar.log() - th.log1p(-alpha_bar), persistent=False)

    def noise(self, velocity: th.Tensor, noisy_action: th.Tensor, step: int | float | th.Tensor) -> th.Tensor:
        """
        :param velocity: Shape ``(batch, d)``
        :param noisy_action: a^k, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1], an index or a number between two: one for all, or shape ``(batch,)``
        :return: Noise, shape ``(batch, d)``
        """
        if isinstance(step, float) or (isinstance(step, th.Tensor) and step.is_floating_point()):
            log_snr = at_step(self.log_snr, step).reshape(-1, 1)
            signal, noise = th.sigmoid(log_snr).sqrt(), th.sigmoid(-log_snr).sqrt()
        else:
            signal, noise = (part[step] for part in self.signal_and_noise)
        return signal * velocity + noise * noisy_action


class MLPDenoiser(nn.Module):
    """
    Predicts the noise eps_theta(a^k, k, s) with a multi-layer perceptron on ``[a^k, embedding of k, condition]``.

    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation
    :param n_steps: Number of diffusion steps K
    :param net_arch: Hidden layers, ``[]`` is a linear denoiser
    :param activation_fn: Activation class
    :param time_embedding_dim: Size of the embedding of the diffusion step
    :param alpha_bar: Where the perceptron gives the velocity, see :class:`Velocity`: alpha_bar of each diffusion step, shape
        ``(K,)``. None where it gives the noise itself
    """

    time_table: th.Tensor

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
        self.velocity = None if alpha_bar is None else Velocity(alpha_bar)
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

    def bind(self, condition: th.Tensor) -> NoisePredictor:
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

        def predict_noise(noisy_action: th.Tensor, step: int | float | th.Tensor) -> th.Tensor:
            output = self.network(th.addmm(from_condition + at_step(from_time, step), noisy_action, action_weight.t()))
            return output if self.velocity is None else self.velocity.noise(output, noisy_action, step)

        return predict_noise

    def forward(self, noisy_action: th.Tensor, step: int | float | th.Tensor, condition: th.Tensor) -> th.Tensor:
        """
        :param noisy_action: a^k, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1], an index or a number between two: one for all, or shape ``(batch,)``
        :param condition: Features of the observation, shape ``(batch, condition_dim)``
        :return: Predicted noise, shape ``(batch, d)``
        """
        return self.bind(condition)(noisy_action, step)


class ResidualMLPDenoiser(nn.Module):
    """
    Residual blocks with layer normalisation in front, each widening fourfold, as in IDQL (Hansen-Estruch et al., 2023) and
    SimBa (Lee et al., 2024): deeper and larger networks keep training where a plain one stalls.

    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation
    :param n_steps: Number of diffusion steps K
    :param net_arch: One equal width for each block, like ``[256, 256]``
    :param activation_fn: Activation class
    :param time_embedding_dim: Size of the embedding of the diffusion step
    :param widening: Width inside a block, over the width between blocks
    :param alpha_bar: Where the network gives the velocity, see :class:`Velocity`, shape ``(K,)``; None where it gives noise
    :raises ValueError: If the widths differ or there is none
    """

    time_table: th.Tensor

    def __init__(
        self,
        action_dim: int,
        condition_dim: int,
        n_steps: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.Mish,
        time_embedding_dim: int = 16,
        widening: int = 4,
        alpha_bar: th.Tensor | None = None,
    ) -> None:
        super().__init__()
        width = one_width(net_arch)
        self.velocity = None if alpha_bar is None else Velocity(alpha_bar)
        self.action_dim = action_dim
        self.register_buffer("time_table", sinusoidal_embedding(n_steps, time_embedding_dim), persistent=False)
        self.input_layer = nn.Linear(action_dim + time_embedding_dim + condition_dim, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width),
                Linear(width, widening * width),
                fast(activation_fn)(),
                Linear(widening * width, width),
            )
            for _ in net_arch
        )
        self.output_layer = nn.Sequential(nn.LayerNorm(width), Linear(width, action_dim))

    def forward(self, noisy_action: th.Tensor, step: int | float | th.Tensor, condition: th.Tensor) -> th.Tensor:
        """
        :param noisy_action: a^k, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1], an index or a number between two: one for all, or shape ``(batch,)``
        :param condition: Features of the observation, shape ``(batch, condition_dim)``
        :return: Predicted noise, shape ``(batch, d)``
        """
        time = at_step(self.time_table, step).expand(noisy_action.shape[0], -1)
        hidden = self.input_layer(th.cat([noisy_action, time, condition], dim=1))
        for block in self.blocks:
            hidden = hidden + block(hidden)
        output = self.output_layer(hidden)
        return output if self.velocity is None else self.velocity.noise(output, noisy_action, step)


def one_width(net_arch: list[int]) -> int:
    """
    :param net_arch: Hidden layers
    :return: Their width
    :raises ValueError: If there is none, or more than one
    """
    if len(set(net_arch)) != 1:
        raise ValueError(
            f"net_arch must hold an equal width for each block of this denoiser, like [256, 256], got {net_arch!r}"
        )
    return net_arch[0]
