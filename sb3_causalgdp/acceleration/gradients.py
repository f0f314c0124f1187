"""Losses together with their gradients, so that one compiled graph can hold the forward and the backward pass."""

import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache, wraps
from typing import Any

import torch as th

from sb3_causalgdp.acceleration import switch
from sb3_causalgdp.acceleration.products import uses_onednn

Gradients = tuple[th.Tensor | None, ...]
"""One gradient for each parameter of a module, None where a parameter has no part in the loss or is not trained."""

# One for each critic that is climbed, guided or not, for every batch size
_MOST_GRAPHS = 64


def gradients_of(module: th.nn.Module, loss: th.Tensor) -> Gradients:
    """
    :param module: The module that is trained
    :param loss: Scalar
    :return: The loss's gradient by each of the module's parameters, in their order; no other parameter's is computed
    """
    parameters = list(module.parameters())
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    gradients = iter(th.autograd.grad(loss, trained, allow_unused=True))
    return tuple(_laid_out_as(parameter, next(gradients)) if parameter.requires_grad else None for parameter in parameters)


def _laid_out_as(parameter: th.Tensor, gradient: th.Tensor | None) -> th.Tensor | None:
    # Fused optimizers on a GPU refuse other strides, which backward() mends and grad() does not
    if gradient is None or not parameter.is_cuda or gradient.stride() == parameter.stride():
        return gradient
    return th.empty_like(parameter, requires_grad=False).copy_(gradient)


def compiled(function: Callable[..., Any], mode: bool | str, device: th.device) -> Callable[..., Any]:
    """
    :param function: What to compile; it may take gradients, which become part of the graph
    :param mode: True, or a mode of ``torch.compile``
    :param device: Where its tensors are
    :return: The function, compiled at its first call; it draws the same random numbers as the plain one
    """

    @cache
    def graph() -> tuple[Callable[..., Any], AbstractContextManager[None]]:
        options: dict[str, Any] = th._inductor.list_mode_options(mode) if isinstance(mode, str) else {}
        # On a CPU the calls between the kernels are compiled, too: a twentieth of an update
        options |= {"fallback_random": True, "cpp_wrapper": device.type == "cpu"}
        if device.type == "cpu" and uses_onednn():
            # Two seconds, as in check_compile
            from sb3_causalgdp.acceleration.product_pass import OneDnnProducts

            options |= {"post_grad_custom_post_pass": OneDnnProducts()}
        run = th.compile(  # type: ignore[call-overload]  # the type stubs lack two arguments
            function, dynamic=False, options=options, isolate_recompiles=True, recompile_limit=_MOST_GRAPHS
        )
        # One for all calls: to make one takes longer than to enter it
        return run, th._dynamo.config.patch(trace_autograd_ops=True)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        run, tracing_gradients = graph()
        with tracing_gradients:
            return run(*args, **kwargs)

    return call


def without_checks() -> AbstractContextManager[None]:
    """
    :return: While it lasts, compiled functions see from their arguments alone which of their graphs to run, and not whether
        anything else changed that these depend on: a twentieth of an update. Every graph that is run must have been run before
    """
    return th.compiler.set_stance(skip_guard_eval_unsafe=True)


def check_compile(mode: bool | str, device: th.device) -> None:
    """
    :param mode: False, True, ``"auto"`` or a mode of ``torch.compile``
    :param device: Where the graphs would run
    :raises ValueError: If the mode is unknown, or cannot be had
    """
    if mode in (False, "auto") or not switch.is_on():
        return
    modes = list(th._inductor.list_mode_options())
    if mode is not True and mode not in modes:
        raise ValueError(f"compile must be True, False, 'auto' or one of {modes}, got {mode!r}")
    reason = why_not_compiled(mode, device)
    if reason is not None:
        raise ValueError(reason)


def why_not_compiled(mode: bool | str, device: th.device) -> str | None:
    """
    :param mode: What was asked for
    :param device: Where the graphs would run
    :return: Why this PyTorch cannot have a backward pass in a compiled graph, or a CPU's graphs find no C++ compiler; None if
        they can be had
    """
    # Two seconds, which those who do not compile need not wait
    from torch._inductor.cpp_builder import get_cpp_compiler

    has_arguments = "isolate_recompiles" in inspect.signature(th.compile).parameters
    if not (has_arguments and hasattr(th._dynamo.config, "trace_autograd_ops")):
        return f"compile={mode!r} needs PyTorch 2.13 or newer, this is {th.__version__}; compile=False works with it"
    if device.type == "cpu":
        try:
            get_cpp_compiler()
        except RuntimeError as error:
            return f"compile={mode!r} needs a C++ compiler such as g++, and none was found: {error}"
    return None
