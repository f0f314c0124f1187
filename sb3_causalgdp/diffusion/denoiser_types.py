"""Denoisers by name, or of one's own, and what is wrong with the latter."""

from collections.abc import Callable
from typing import Any, Protocol

import torch as th
from torch import nn

from sb3_causalgdp.checks import register
from sb3_causalgdp.diffusion.denoisers import MLPDenoiser, ResidualMLPDenoiser
from sb3_causalgdp.diffusion.transformer import TransformerDenoiser

DENOISERS: dict[str, Callable[..., nn.Module]] = {
    "mlp": MLPDenoiser,
    "residual_mlp": ResidualMLPDenoiser,
    "transformer": TransformerDenoiser,
}


_OWN_DENOISERS = tuple(DENOISERS.values())


class DenoiserNetwork(Protocol):
    """
    What a class of one's own has to be: a ``torch.nn.Module`` that can be made and called like this. :func:`check_denoiser`
    says what is wrong with one.

    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation
    :param n_steps: Number of diffusion steps K
    :param net_arch: Hidden layers that the policy asks for
    :param activation_fn: Activation class that it asks for
    """

    def __init__(
        self, action_dim: int, condition_dim: int, n_steps: int, net_arch: list[int], activation_fn: type[nn.Module]
    ) -> None: ...  # pragma: no cover

    def __call__(self, noisy_action: th.Tensor, step: int | float | th.Tensor, condition: th.Tensor) -> th.Tensor:
        """
        :param noisy_action: a^k, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1], an index, or a number between two: one for all, or shape ``(batch,)``
        :param condition: Features of the observation, shape ``(batch, condition_dim)``
        :return: Predicted noise, shape ``(batch, d)``
        """
        ...  # pragma: no cover


def register_denoiser(name: str, denoiser: type[nn.Module]) -> None:
    """
    Let ``policy_kwargs=dict(denoiser=name)`` be a network of one's own, also in YAML files. A class does without a name.

    :param name: Its name
    :param denoiser: As :class:`DenoiserNetwork` describes it
    :raises ValueError: If there is another denoiser of that name
    """
    register(DENOISERS, name, denoiser, "denoiser")


def make_denoiser(
    denoiser: str | type[nn.Module],
    action_dim: int,
    condition_dim: int,
    n_steps: int,
    net_arch: list[int],
    activation_fn: type[nn.Module] = nn.Mish,
    denoiser_kwargs: dict[str, Any] | None = None,
    alpha_bar: th.Tensor | None = None,
) -> nn.Module:
    """
    :param denoiser: ``mlp``, ``residual_mlp`` or ``transformer``, or a class as :class:`DenoiserNetwork` describes it
    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation
    :param n_steps: Number of diffusion steps K
    :param net_arch: Hidden layers
    :param activation_fn: Activation class
    :param denoiser_kwargs: Further arguments of the class
    :param alpha_bar: Of each diffusion step, shape ``(K,)``, where the network of a named denoiser gives the velocity, see
        :class:`~sb3_causalgdp.diffusion.denoisers.Velocity`. None where it gives the noise, as classes of one's own do
    :return: The denoiser
    :raises ValueError: If the name is unknown, the arguments do not fit, or the network is none that can denoise
    """
    if isinstance(denoiser, str) and denoiser not in DENOISERS:
        raise ValueError(f"Unknown denoiser {denoiser!r}: it must be one of {sorted(DENOISERS)} or a class of torch.nn")
    make = DENOISERS[denoiser] if isinstance(denoiser, str) else denoiser
    is_own = make in _OWN_DENOISERS
    keywords = {**({"alpha_bar": alpha_bar} if is_own and alpha_bar is not None else {}), **(denoiser_kwargs or {})}
    try:
        network = make(action_dim, condition_dim, n_steps, net_arch, activation_fn, **keywords)
    except TypeError as error:
        raise ValueError(
            f"denoiser {denoiser!r} cannot be made from (action_dim, condition_dim, n_steps, net_arch, activation_fn) and "
            f"denoiser_kwargs={denoiser_kwargs!r}: {error}"
        ) from error
    if not is_own:
        check_denoiser(network, action_dim, condition_dim, n_steps)
    return network


def check_denoiser(denoiser: nn.Module, action_dim: int, condition_dim: int, n_steps: int) -> None:
    """
    Call a denoiser as training and sampling do, on random actions.

    :param denoiser: The network
    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation
    :param n_steps: Number of diffusion steps K
    :raises ValueError: If the output is not a tensor of shape ``(batch, d)``, or of another type than the input, or not
        finite; if no gradient leads to the parameters or to the noisy action; if a row depends on the other rows of its batch;
        or if it takes no index, no tensor of indices or no fraction for the step
    """
    name = f"denoiser {type(denoiser).__name__}"
    generator = th.Generator().manual_seed(0)
    parameter = next(iter(denoiser.parameters()), th.zeros(0))
    action, condition = (th.randn(3, width, generator=generator).to(parameter) for width in (action_dim, condition_dim))
    action.requires_grad_()
    was_training = denoiser.training
    denoiser.eval()
    try:
        with th.random.fork_rng(devices=[]), th.enable_grad():
            output = _called(denoiser, name, action, n_steps - 1, condition)
            _check_output(name, output, action)
            _check_gradient(denoiser, name, output, action)
            _check_rows(denoiser, name, output, action, n_steps, condition)
    finally:
        denoiser.train(was_training)


def _called(
    denoiser: nn.Module, name: str, action: th.Tensor, step: int | float | th.Tensor, condition: th.Tensor
) -> th.Tensor:
    kind = f"{step.dtype} of shape {tuple(step.shape)}" if isinstance(step, th.Tensor) else repr(step)
    try:
        return denoiser(action, step, condition)
    except Exception as error:
        raise ValueError(
            f"{name} must accept noisy actions {tuple(action.shape)}, step {kind} and condition {tuple(condition.shape)}, "
            f"got {type(error).__name__}: {error}"
        ) from error


def _check_output(name: str, output: th.Tensor, action: th.Tensor) -> None:
    if not isinstance(output, th.Tensor):
        raise ValueError(f"{name} must return a tensor, got {type(output).__name__}")
    if output.shape != action.shape:
        raise ValueError(f"{name} must return the shape {tuple(action.shape)} of the noisy actions, got {tuple(output.shape)}")
    if output.dtype != action.dtype:
        raise ValueError(f"{name} must return {action.dtype}, as its parameters are, got {output.dtype}")
    if not bool(output.isfinite().all()):
        raise ValueError(f"{name} must return finite numbers, got {output.detach()[~output.isfinite()][0].item()}")


def _check_gradient(denoiser: nn.Module, name: str, output: th.Tensor, action: th.Tensor) -> None:
    parameters = [parameter for parameter in denoiser.parameters() if parameter.requires_grad]
    if not output.requires_grad:
        raise ValueError(f"{name} must return a tensor with a gradient, got one without: is it detached, or under no_grad()?")
    wanted = [*parameters, action]
    # Not of the sum, which layers that end in a normalisation do not change
    weights = th.linspace(-1.0, 2.0, output.numel()).reshape(output.shape).to(output)
    *of_parameters, of_action = th.autograd.grad((weights * output).sum(), wanted, allow_unused=True, retain_graph=True)
    if all(gradient is None for gradient in of_parameters):
        raise ValueError(f"{name} must have parameters that lead to its output, got {len(parameters)} of which none does")
    if of_action is None:
        raise ValueError(f"{name} must carry a gradient to the noisy action, got none: chains are back-propagated through")


def _check_rows(
    denoiser: nn.Module, name: str, output: th.Tensor, action: th.Tensor, n_steps: int, condition: th.Tensor
) -> None:
    def check(other: th.Tensor, expected: th.Tensor, what: str) -> None:
        _check_output(name, other, expected)
        if not th.allclose(other, expected, rtol=1e-3, atol=1e-4):
            difference = float((other - expected).detach().abs().max())
            raise ValueError(f"{name} must return the same for {what}, got a difference of {difference:.3g}")

    last = n_steps - 1
    alone = _called(denoiser, name, action[:1], last, condition[:1])
    check(alone, output[:1], "a row alone and in a batch")
    steps = th.full((len(action),), last, device=action.device)
    check(_called(denoiser, name, action, steps, condition), output, "a step and a tensor of it")
    check(_called(denoiser, name, action, steps.to(action.dtype), condition), output, "a step and the same as a float")
    _check_output(name, _called(denoiser, name, action, 0.5 * last, condition), action)
