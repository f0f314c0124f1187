"""
Updates per second of CausalGDP on a GPU, plain, compiled and recorded as CUDA graphs, beside what its matrix products and its
kernel launches need at the least. Wall-clock time, because the work is not the processor's.

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
from benchmarks.speed.workers.matmuls import CYCLE, count_flops
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration.cuda_graphs import record

MODES: dict[str, dict[str, Any]] = {
    "plain": {"cuda_graph": False},
    "compile": {"compile": True, "cuda_graph": False},
    "reduce-overhead": {"compile": "reduce-overhead"},
    "cuda_graph": {},
    "compile, cuda_graph": {"compile": True},
}
COLUMNS = (
    "contestant",
    "mode",
    "updates/s",
    "one at a time",
    "ms",
    "ms of products",
    "ms of launches",
    "recorded",
    "deviation",
)
STEP_COLUMNS = ("contestant", "mode", "steps/s")
WARM_UPS = 24
STARTS = 1_000
CHECKED_UPDATES = 4


def make(setting: contestants.Contestant, transitions: str, device: str, mode: str, **config: Any) -> CausalGDPContestant:
    """
    :param setting: One of CausalGDP's
    :param transitions: Path of what it learns from
    :param device: PyTorch's name of the device
    :param mode: One of ``MODES``
    :param config: More of the contestant's configuration
    :return: The contestant in this process; without an environment, its replay buffer is filled and its graph known
    """
    kwargs = {**setting.config["kwargs"], "device": device, **MODES[mode]}
    return CausalGDPContestant({"batch_size": 256, "transitions": transitions, "kwargs": kwargs, **config})


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


def states_of(model: CausalGDP) -> list[th.Tensor]:
    """
    :param model: After its first update
    :return: All that an update writes: parameters, running averages and states of optimizers
    """
    states = [state for optimizer in model._updates.optimizers() for state in optimizer.state.values()]
    return [*model.policy.state_dict().values(), *(value for state in states for value in state.values())]


def deviations(ours: dict[str, CausalGDPContestant]) -> dict[str, float]:
    """
    :param ours: A contestant for each mode, before its first update, the plain one first
    :return: By how much a few updates from one state change the parameters otherwise than the plain ones, relative to these
    """
    changes: dict[str, th.Tensor] = {}
    start: list[th.Tensor] = []
    for mode, one in ours.items():
        one.model._n_updates = 100  # recordings begin behind the first hundred
        one.update(WARM_UPS)
        start = start or [state.clone() for state in states_of(one.model)]
        th._foreach_copy_(states_of(one.model), start)
        th.manual_seed(1), np.random.seed(1)
        before = th.nn.utils.parameters_to_vector(one.model.policy.parameters()).detach().clone()
        one.update(CHECKED_UPDATES)
        changes[mode] = th.nn.utils.parameters_to_vector(one.model.policy.parameters()).detach() - before
    return {mode: float((change - changes["plain"]).norm() / changes["plain"].norm()) for mode, change in changes.items()}


def per_launch(launch: Callable[[], Any], device: str, recorded: bool) -> float:
    """
    :param launch: One operation
    :param device: PyTorch's name of the device
    :param recorded: Whether a thousand of them are a CUDA graph, on a GPU
    :return: Wall-clock seconds of one
    """
    repeats = 1_000

    def launch_all() -> dict[str, th.Tensor]:
        for _ in range(repeats):
            launch()
        return {}

    function = record(launch_all, th.cuda.Stream(device)) if recorded and device.startswith("cuda") else launch_all
    function()
    return seconds(function, device) / repeats


def floors(contestant: CausalGDPContestant, device: str) -> dict[str, float]:
    """
    :param contestant: With the plain update
    :param device: PyTorch's name of the device
    :return: Milliseconds of an update's floating point operations at the rate of a hidden layer's products, recorded, and of
        its operations at the rate at which the device takes tiny ones, launched one by one and recorded
    """
    x, weight, tiny = th.randn(256, 256, device=device), th.randn(256, 256, device=device), th.zeros(1, device=device)
    result = th.empty_like(x)
    product = per_launch(lambda: th.mm(x, weight, out=result), device, recorded=True)
    flops = count_flops(lambda: contestant.update(CYCLE))["total"] / CYCLE
    with th.profiler.profile() as profiler:
        contestant.update(CYCLE)
    launches = sum(event.count for event in profiler.key_averages() if event.key.startswith("cudaLaunchKernel")) / CYCLE
    return {
        "ms of products": 1e3 * flops / (2 * 256**3) * product,
        "ms of launches": 1e3 * launches * per_launch(lambda: tiny.add_(1.0), device, recorded=False),
        "recorded": 1e3 * launches * per_launch(lambda: tiny.add_(1.0), device, recorded=True),
    }


def measure(
    setting: contestants.Contestant, transitions: str, device: str, modes: Sequence[str], updates: int, rounds: int
) -> list[dict[str, Any]]:
    """
    :param setting: One of CausalGDP's
    :param transitions: Path of what it learns from
    :param device: PyTorch's name of the device
    :param modes: Of ``MODES``, the plain one first; they take turns
    :param updates: Of one turn
    :param rounds: Turns of each
    :return: A row for each mode
    """
    ours = {mode: make(setting, transitions, device, mode) for mode in modes}
    deviation = deviations(ours)
    taken: dict[str, list[tuple[float, float]]] = {mode: [] for mode in modes}
    for round_ in range(rounds + 1):
        for mode, one in ours.items():
            at_once = seconds(lambda one=one: one.update(updates), device)  # type: ignore[misc]
            single = seconds(lambda one=one: [one.update(1) for _ in range(updates)], device)  # type: ignore[misc]
            if round_ > 0:  # the first one compiles
                taken[mode].append((at_once / updates, single / updates))
    floor = floors(ours["plain"], device)
    rows = []
    for mode, values in taken.items():
        at_once, single = np.median(values, axis=0)
        row = {"contestant": setting.name, "mode": mode, "updates/s": 1.0 / at_once, "one at a time": 1.0 / single}
        rows.append({**row, "deviation": deviation[mode], "ms": 1e3 * at_once, **floor})
    return rows


def environment_steps(transitions: str, device: str, mode: str, steps: int) -> list[dict[str, Any]]:
    """
    :param transitions: A path, of which nothing is used
    :param device: PyTorch's name of the device
    :param mode: One of ``MODES``
    :param steps: Environment steps that are measured
    :return: A row for one environment and one for 16, with one gradient step for each environment step in both
    """
    rows = []
    for n_envs in (1, 16):
        setting = contestants.causalgdp(contestants.DEFAULT, gradient_steps=-1, learning_starts=STARTS)
        one = make(setting, transitions, device, mode, env=HALF_CHEETAH, n_envs=n_envs)
        one.learn(2 * STARTS)  # the first graph is known, and everything is compiled
        taken: list[int] = []
        wall_clock = seconds(lambda one=one, taken=taken: taken.append(one.learn(steps)["steps"]), device)  # type: ignore[misc]
        rows.append({"contestant": f"{setting.name}, {n_envs} environments", "mode": mode, "steps/s": taken[0] / wall_clock})
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param argv: Its arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES), help="of updates beside the plain ones")
    parser.add_argument("--updates", type=int, default=200, help="of one turn (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each mode (%(default)s)")
    parser.add_argument("--rows", type=int, default=ROWS[HALF_CHEETAH], help="transitions in the buffer (%(default)s)")
    parser.add_argument("--steps", type=int, default=3_000, help="environment steps of learn(), 0 for none (%(default)s)")
    parser.add_argument("--output", type=Path, help="JSON file for the rows")
    args = parser.parse_args(argv)
    if args.device.startswith("cuda") and not th.cuda.is_available():
        parser.error("PyTorch finds no GPU here; --device cpu measures what there is")
    modes = ["plain", *(mode for mode in args.modes if mode != "plain")]
    with tempfile.TemporaryDirectory() as scratch:
        transitions = save(Path(scratch) / "transitions.npz", collect(HALF_CHEETAH, args.rows))
        rows = []
        for setting in contestants.main_settings():
            rows += measure(setting, transitions, args.device, modes, args.updates, args.rounds)
        name = th.cuda.get_device_name() if args.device.startswith("cuda") else "CPU"
        print(f"{date.today()}, {name}, PyTorch {th.__version__}, {HALF_CHEETAH} sizes, batch 256")
        print(markdown(rows, COLUMNS), flush=True)
        learn: list[dict[str, Any]] = []
        for mode in args.modes if args.steps > 0 else []:
            learn += environment_steps(transitions, args.device, mode, args.steps)
        print(markdown(learn, STEP_COLUMNS))
    if args.output is not None:
        args.output.write_text(json.dumps({"updates": rows, "learn": learn}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
