"""Gradient steps as CUDA graphs: one launch in place of hundreds."""

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Any

import torch as th

from sb3_causalgdp.offline.replay import leaves_of, map_sample

Losses = dict[str, th.Tensor]
Batches = Sequence[Any]
"""Samples of SB3's replay buffers."""
Recorder = Callable[[Callable[[], Losses]], Callable[[], Losses]]


def record(function: Callable[[], Losses], stream: th.cuda.Stream) -> Callable[[], Losses]:
    """
    :param function: Launches kernels on the GPU, on tensors that stay where they are, and does not wait for them
    :param stream: Where they are launched while recording
    :return: Launches all of them at once, and returns the tensors that the function returned, with what they hold then
    """
    graph = th.cuda.CUDAGraph()
    # An error only where this thread does what cannot be recorded: others may use the GPU meanwhile
    with th.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
        losses = function()

    def replay() -> Losses:
        graph.replay()
        return losses

    return replay


@contextmanager
def _branch(stream: th.cuda.Stream, start: th.cuda.Event) -> Iterator[None]:
    """Launch on that stream, behind the event; what comes afterwards on the current one waits for it."""
    current = th.cuda.current_stream(stream.device)
    stream.wait_event(start)
    with th.cuda.stream(stream):
        yield
    current.wait_stream(stream)


class UpdateGraphs:
    """
    Runs gradient steps, and from the fourth step of a kind on replays a recording of it. All that a recording reads is in
    tensors which stay in place: parameters, optimizer states, masks, and copies of the batch and of the learning rates.

    :param optimizers: Those that the steps use; they know steps that stay on the GPU (``capturable`` or ``fused``)
    :param recorder: Makes a recording, by default a CUDA graph
    """

    # Steps that create optimizer states, compile, and choose kernels
    WARM_UPS = 3
    # Each holds the memory of a gradient step; more only where something that is recorded changes all the time
    MOST_RECORDINGS = 32

    def __init__(self, optimizers: Sequence[th.optim.Optimizer], recorder: Recorder | None = None) -> None:
        device = optimizers[0].param_groups[0]["params"][0].device
        self._streams: tuple[th.cuda.Stream, th.cuda.Stream] | None = None
        if device.type == "cuda":
            # Warm-ups too: PyTorch remembers where a parameter was first used, and cannot record on its default stream
            self._streams = th.cuda.Stream(device), th.cuda.Stream(device)
        if recorder is None:
            assert self._streams is not None
            recorder = partial(record, stream=self._streams[0])
        self._recorder = recorder
        self._n_runs: Counter[Hashable] = Counter()
        self._recordings: dict[Hashable, tuple[list[th.Tensor], Callable[[], Losses]]] = {}
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        self._rates = [(group, th.full((), float(group["lr"]), device=group["params"][0].device)) for group in groups]

    def run(self, kind: Hashable, step: Callable[..., Losses], batches: Batches) -> Losses:
        """
        :param kind: Everything but tensors that the step depends on: what differs in it has recordings of its own
        :param step: The gradient step, of which other samples of the same sizes may be asked
        :param batches: Its samples
        :return: What the step returned; the next one of this kind overwrites it
        :raises RuntimeError: If the step cannot be recorded
        """
        if kind not in self._recordings:
            self._n_runs[kind] += 1
            if self._n_runs[kind] <= self.WARM_UPS:
                with self._own_stream(0)():
                    return step(*batches)
            self._record(kind, step, batches)
        inputs, replay = self._recordings[kind]
        th._foreach_copy_(inputs, list(tensors_of(batches)))
        return replay()

    def _record(self, kind: Hashable, step: Callable[..., Losses], batches: Batches) -> None:
        if len(self._recordings) >= self.MOST_RECORDINGS:
            self._recordings.clear()
        copies = [map_sample(th.clone, batch) for batch in batches]

        def on_copies() -> Losses:
            with self._learning_rates_as_tensors():
                return step(*copies)

        try:
            self._recordings[kind] = (list(tensors_of(copies)), self._recorder(on_copies))
        except RuntimeError as error:
            raise RuntimeError(
                "This gradient step cannot be recorded as a CUDA graph, because it waits for the GPU or has shapes that "
                f"change (a features extractor or optimizer of your own?): {error}. cuda_graph=False works with it."
            ) from error

    def _own_stream(self, index: int) -> Callable[[], AbstractContextManager[None]]:
        if self._streams is None:
            return nullcontext
        stream = self._streams[index]
        return partial(_branch, stream, th.cuda.current_stream(stream.device).record_event())

    def branch(self) -> Callable[[], AbstractContextManager[None]]:
        """
        :return: Makes contexts. What is launched in them runs, on a GPU, beside all that was launched between this call and
            the context; what is launched afterwards waits for both
        """
        return self._own_stream(1)

    def update_learning_rates(self) -> None:
        """Let recordings use the learning rates that the optimizers have now."""
        for group, rate in self._rates:
            rate.fill_(group["lr"])

    @contextmanager
    def _learning_rates_as_tensors(self) -> Iterator[None]:
        """A number would be recorded as it is."""
        before = [(group, group["lr"], group.get("capturable")) for group, _ in self._rates]
        try:
            for group, rate in self._rates:
                group.update(lr=rate, capturable=True)
            yield
        finally:
            for group, rate, capturable in before:
                group.update(lr=rate, capturable=capturable)


def why_not_recorded(device: th.device, compile_mode: bool | str, optimizers: Sequence[th.optim.Optimizer]) -> str | None:
    """
    :param device: Where the networks are
    :param compile_mode: False, True or a mode of ``torch.compile``
    :param optimizers: Those of the networks
    :return: Why gradient steps cannot be recorded as CUDA graphs, and what to do; None if they can
    """
    if device.type != "cuda":
        return f"cuda_graph=True needs device='cuda', and this model is on {str(device)!r}: use cuda_graph='auto'"
    if isinstance(compile_mode, str) and th._inductor.list_mode_options(compile_mode).get("triton.cudagraphs", False):
        return f"compile={compile_mode!r} makes CUDA graphs of its own, which cuda_graph=True cannot record: use compile=True"
    for optimizer in optimizers:
        if not all(group.get("capturable") or group.get("fused") for group in optimizer.param_groups):
            return (
                f"cuda_graph=True needs an optimizer with capturable=True or fused=True, and {type(optimizer).__name__} has "
                "neither: use policy_kwargs=dict(optimizer_kwargs=dict(capturable=True)) if it knows that, or cuda_graph=False"
            )
    return None


def tensors_of(samples: Batches) -> Iterator[th.Tensor]:
    """
    :param samples: Samples of SB3's replay buffers
    :return: Their tensors, in an order that depends on the kind of the samples alone
    """
    for sample in samples:
        for part in sample:
            if part is not None:
                yield from leaves_of(part)
