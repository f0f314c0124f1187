"""Gradient steps that are compiled or recorded, in as many threads as help."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from threading import current_thread, main_thread
from typing import Any
from warnings import warn

import torch as th

from sb3_causalgdp.acceleration import switch
from sb3_causalgdp.acceleration.cuda_graphs import Losses, UpdateGraphs, why_not_recorded
from sb3_causalgdp.acceleration.gradients import compiled, why_not_compiled, without_checks


class FastSteps:
    """
    What makes gradient steps fast, as a model's arguments say; where they say nothing, the steps are made as they are.

    :param optimizers: Those that the steps use
    :param compile_mode: The argument ``compile``: False, True, a mode of ``torch.compile`` or ``"auto"``
    :param cuda_graph: The argument ``cuda_graph``: True, False or ``"auto"``
    :param device: Where the networks are
    """

    # Compiling takes a minute or two, and saves 3 ms of each
    WORTH_COMPILING = 50_000

    def __init__(
        self, optimizers: Sequence[th.optim.Optimizer], compile_mode: bool | str, cuda_graph: bool | str, device: th.device
    ) -> None:
        self._optimizers, self._cuda_graph, self._device = optimizers, cuda_graph, device
        wanted = compile_mode if switch.is_on() else False
        self._may_compile = wanted == "auto"
        self._compile_mode = False if self._may_compile else wanted
        self.graphs: UpdateGraphs | None = None
        self.forget_recordings()

    def forget_recordings(self) -> None:
        """Record anew: the optimizers have other tensors."""
        recorded = switch.is_on() and self._cuda_graph and self._why_not_recorded() is None
        self.graphs = UpdateGraphs(self._optimizers) if recorded else None

    def check_recordable(self) -> None:
        """
        :raises ValueError: If recordings were asked for and cannot be made
        """
        reason = self._why_not_recorded() if self._cuda_graph is True and switch.is_on() else None
        if reason is not None:
            raise ValueError(reason)

    def _why_not_recorded(self) -> str | None:
        return why_not_recorded(self._device, self._compile_mode, self._optimizers)

    def compiled(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """
        :param function: Takes tensors, and may take gradients
        :return: The function, compiled if that was asked for
        """
        if self._may_compile:
            return partial(self._compiled_or_plain, compiled(function, True, self._device), function)
        return compiled(function, self._compile_mode, self._device) if self._compile_mode else function

    def _compiled_or_plain(self, fast: Callable[..., Any], plain: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if not self._compile_mode:
            return plain(*args, **kwargs)
        try:
            return fast(*args, **kwargs)
        except th._dynamo.exc.TorchDynamoException as error:
            reason = str(getattr(error, "inner_exception", error)).strip().split("\n")[0]
            warn(f"PyTorch cannot compile the updates, which go on as they are (compile=False does not try): {reason}")
            self._may_compile = self._compile_mode = False
            return plain(*args, **kwargs)

    def expect(self, gradient_steps: int, was_compiled: bool) -> bool:
        """
        Let ``compile="auto"`` decide. What is compiled stays so.

        :param gradient_steps: How many are to come
        :param was_compiled: Whether they continue compiled ones
        :return: Whether this compiles what was not compiled before
        """
        # A GPU is fast with recordings alone; PyTorch's settings for a compiler are those of all threads
        may_begin = self._may_compile and not self._compile_mode and self._device.type == "cpu"
        is_worth_it = was_compiled or gradient_steps >= self.WORTH_COMPILING
        if may_begin and is_worth_it and current_thread() is main_thread() and why_not_compiled("auto", self._device) is None:
            self._compile_mode = True
            return True
        return False

    def branch(self) -> Callable[[], AbstractContextManager[None]]:
        """
        :return: See :meth:`UpdateGraphs.branch`
        """
        return nullcontext if self.graphs is None else self.graphs.branch()

    def made_fast(self, gradient_steps: Callable[..., Losses], settings: Hashable) -> Callable[..., Losses]:
        """
        :param gradient_steps: Makes gradient steps: of some plans, which can be hashed, on some batches
        :param settings: All that they depend on beside these and tensors
        :return: The same in less time, as long as the settings stay
        """
        if self.graphs is None:
            return _WithFewChecks(gradient_steps) if self._compile_mode else gradient_steps
        self.graphs.update_learning_rates()
        return partial(_run, self.graphs, bool(self._compile_mode), gradient_steps, settings)


def _run(
    graphs: UpdateGraphs, compiles: bool, gradient_steps: Callable[..., Losses], settings: Hashable, plans: Any, *batches: Any
) -> Losses:
    if compiles:
        # What a CUDA graph returned is overwritten from here on
        th.compiler.cudagraph_mark_step_begin()
    kind = (plans, settings, len(batches[0].rewards))
    return graphs.run(kind, partial(gradient_steps, plans), batches)


class _WithFewChecks:
    """
    Within one call of ``train()``, compiled functions look once for each kind of steps at all that they depend on.

    :param gradient_steps: Makes gradient steps with compiled functions
    """

    def __init__(self, gradient_steps: Callable[..., Losses]) -> None:
        self._gradient_steps = gradient_steps
        self._known_kinds: set[Hashable] = set()

    def __call__(self, plans: Any, *batches: Any) -> Losses:
        th.compiler.cudagraph_mark_step_begin()
        # The weights of running averages are outside of compiled functions
        kind = tuple(plan._replace(running_weight=0.0) for plan in plans)
        with without_checks() if kind in self._known_kinds else nullcontext():
            losses = self._gradient_steps(plans, *batches)
        self._known_kinds.add(kind)
        return losses


@contextmanager
def n_threads_at_most(torch_threads: int | str | None, of_images: bool) -> Iterator[None]:
    """
    PyTorch's number of CPU threads, for a while.

    :param torch_threads: The argument of this name
    :param of_images: Whether observations are images
    """
    before = th.get_num_threads()
    n_threads = (None if of_images else 1) if torch_threads == "auto" else torch_threads
    if n_threads in (None, before):
        yield
        return
    th.set_num_threads(n_threads)  # type: ignore[arg-type]
    try:
        yield
    finally:
        th.set_num_threads(before)
