"""
Updates per second of CausalGDP on a GPU, plain, compiled and as CUDA graphs, beside what its matrix products and its kernel
launches need at the least. Wall-clock time, because the work is not the processor's.

    python -m benchmarks.speed.gpu
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from benchmarks.speed import contestants
from benchmarks.speed.benchmark import HALF_CHEETAH, ROWS
from benchmarks.speed.data import collect, save
from benchmarks.speed.results import markdown
from benchmarks.speed.workers.causalgdp import CausalGDPContestant
from benchmarks.speed.workers.matmuls import count_flops

MODES: dict[str, bool | str] = {"plain": False, "compile": True, "reduce-overhead": "reduce-overhead"}
COLUMNS = ("contestant", "mode", "updates/s", "one at a time", "ms", "ms of products", "ms of launches", "deviation")
CHECKED_UPDATES = 2


def make(setting: contestants.Contestant, transitions: str, device: str, mode: str) -> CausalGDPContestant:
    """
    :param setting: One of CausalGDP's
    :param transitions: Path of what it learns from
    :param device: PyTorch's name of the device
    :param mode: One of ``MODES``
    :return: The contestant in this process, its replay buffer filled and its graph known
    """
    kwargs = {**setting.config["kwargs"], "device": device, "compile": MODES[mode]}
    return CausalGDPContestant({"batch_size": 256, "transitions": transitions, "kwargs": kwargs})


def seconds(function: Callable[[], Any], device: str) -> float:
    """
    :param function: What is timed
    :param device: Whose work is waited for
    :return: Wall-clock seconds
    """
    wait = th.cuda.synchronize if device.startswith("cuda") else lambda: None
    wait()
    start = time.perf_counter()
    function()
    wait()
    return time.perf_counter() - start


def changes(contestant: CausalGDPContestant) -> th.Tensor:
    """
    :param contestant: Before its first update
    :return: What the first updates change in all parameters, for the same seed
    """
    parameters = list(contestant.model.policy.parameters())
    before = th.nn.utils.parameters_to_vector(parameters).detach().clone()
    th.manual_seed(1), np.random.seed(1)
    contestant.update(CHECKED_UPDATES)
    return (th.nn.utils.parameters_to_vector(parameters).detach() - before).cpu()


def floors(contestant: CausalGDPContestant, device: str) -> dict[str, float]:
    """
    :param contestant: With the plain update
    :param device: PyTorch's name of the device
    :return: Milliseconds of an update's floating point operations at the rate of a hidden layer, and of its operations at the
        rate at which the device takes tiny ones
    """
    x, weight, tiny = th.randn(256, 256, device=device), th.randn(256, 256, device=device), th.zeros(1, device=device)
    result, repeats = th.empty_like(x), 1_000
    product = seconds(lambda: [th.mm(x, weight, out=result) for _ in range(repeats)], device) / repeats
    launch = seconds(lambda: [tiny.add_(1.0) for _ in range(repeats)], device) / repeats
    flops = count_flops(lambda: contestant.update(2))["total"] / 2
    with th.profiler.profile() as profiler:
        contestant.update(2)
    launches = sum(event.count for event in profiler.key_averages() if event.key == "cudaLaunchKernel") / 2
    return {"ms of products": 1e3 * flops / (2 * 256**3) * product, "ms of launches": 1e3 * launches * launch}


def measure(
    setting: contestants.Contestant, transitions: str, device: str, modes: Sequence[str], updates: int, rounds: int
) -> list[dict[str, Any]]:
    """
    :param setting: One of CausalGDP's
    :param transitions: Path of what it learns from
    :param device: PyTorch's name of the device
    :param modes: Of ``MODES``; they take turns
    :param updates: Of one turn
    :param rounds: Turns of each
    :return: A row for each mode; ``deviation`` is how far its first updates are from the plain ones, relative to these
    """
    ours = {mode: make(setting, transitions, device, mode) for mode in modes}
    changed = {mode: changes(one) for mode, one in ours.items()}
    taken: dict[str, list[tuple[float, float]]] = {mode: [] for mode in modes}
    for round_ in range(rounds + 1):
        for mode, one in ours.items():
            at_once = seconds(lambda one=one: one.update(updates), device)  # type: ignore[misc]
            single = seconds(lambda one=one: [one.update(1) for _ in range(updates)], device)  # type: ignore[misc]
            if round_ > 0:  # the first one compiles
                taken[mode].append((at_once / updates, single / updates))
    plain = floors(ours["plain"], device) if "plain" in ours else {}
    rows = []
    for mode, values in taken.items():
        at_once, single = np.median(values, axis=0)
        row = {"contestant": setting.name, "mode": mode, "updates/s": 1.0 / at_once, "one at a time": 1.0 / single}
        if "plain" in changed:
            row["deviation"] = float((changed[mode] - changed["plain"]).norm() / changed["plain"].norm())
        rows.append({**row, "ms": 1e3 * at_once, **plain})
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param argv: Its arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--updates", type=int, default=200, help="of one turn (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each mode (%(default)s)")
    parser.add_argument("--rows", type=int, default=ROWS[HALF_CHEETAH], help="transitions in the buffer (%(default)s)")
    parser.add_argument("--output", type=Path, help="JSON file for the rows")
    args = parser.parse_args(argv)
    if args.device.startswith("cuda") and not th.cuda.is_available():
        parser.error("PyTorch finds no GPU here; --device cpu measures what there is")
    with tempfile.TemporaryDirectory() as scratch:
        transitions = save(Path(scratch) / "transitions.npz", collect(HALF_CHEETAH, args.rows))
        rows = []
        for setting in contestants.main_settings():
            rows += measure(setting, transitions, args.device, args.modes, args.updates, args.rounds)
    name = th.cuda.get_device_name() if args.device.startswith("cuda") else "CPU"
    print(f"{date.today()}, {name}, PyTorch {th.__version__}, {HALF_CHEETAH} sizes, batch 256\n{markdown(rows, COLUMNS)}")
    if args.output is not None:
        args.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
