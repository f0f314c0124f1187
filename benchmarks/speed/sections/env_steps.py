"""Environment steps per CPU second of ``learn()`` on HalfCheetah, environment included."""

from typing import Any

from benchmarks.speed import contestants, learning
from benchmarks.speed.benchmark import HALF_CHEETAH, Benchmark
from benchmarks.speed.client import Contestant, median_ratio
from benchmarks.speed.contestants import AUTHORS, DEFAULT, DIFFUSION_QL, MISH_NETS, ONE_STEP_RELU, SAC, SAME_NETS, compiled
from benchmarks.speed.results import Results, Verdict

COLUMNS = ("group", "contestant", "steps per CPU second", "ms per step", "ms per refresh", "share of refreshes", "status")
ONE_ENV, MANY_ENVS = "CausalGDP, default, 1 environment", "CausalGDP, default, 16 environments"
# SB3's default with 16 environments
ONE_ENV_SELDOM, MANY_ENVS_SELDOM = f"{ONE_ENV}, an update for 16 steps", f"{MANY_ENVS}, an update for 16 steps"
TEN_STEPS = "CausalGDP, K=10, Mish 3x256"
TEN_STEPS_AS_AUTHORS = "CausalGDP, K=10, the networks of its authors' loop"
# Of Gym_Tasks/HalfCheetah.py: their critics define a second hidden layer and do not use it
AUTHORS_NETS = {
    "net_arch": {"pi": [256, 256], "qf": [256]},
    "activation_fn": "relu",
    "critic_normalization": "layer",
    "world_model_net_arch": [256],
}
STARTS = 2_100  # two causal graphs, with 16 environments too: they find theirs at 1,008 and 2,016


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    results = benchmark.results("env_steps")
    starts: dict[str, Any] = {"learning_starts": STARTS}
    ours = {**starts, "causal_refresh_freq": learning.REFRESH_PERIOD}
    every_step = {"gradient_steps": -1, **ours}
    beside_sac = [
        contestants.causalgdp(DEFAULT, **ours),
        contestants.causalgdp(ONE_STEP_RELU, policy_kwargs=SAME_NETS, **ours),
    ]
    ten_steps = [
        contestants.causalgdp(TEN_STEPS, diffusion_steps=10, policy_kwargs=MISH_NETS, **ours),
        contestants.causalgdp(TEN_STEPS_AS_AUTHORS, diffusion_steps=10, policy_kwargs=AUTHORS_NETS, **ours),
    ]
    n_envs = [contestants.causalgdp(ONE_ENV, **every_step), contestants.causalgdp(MANY_ENVS, n_envs=16, **every_step)]
    seldom = [
        contestants.causalgdp(ONE_ENV_SELDOM, train_freq=16, **ours),
        contestants.causalgdp(MANY_ENVS_SELDOM, n_envs=16, **ours),
    ]
    groups = {
        "beside SAC": [*benchmark.ours(beside_sac), contestants.sb3("SAC", **starts)],
        "K=10": [*benchmark.ours(ten_steps), *benchmark.diffusion_ql(10), *benchmark.authors()],
        "one update for each step": benchmark.ours(n_envs),
        "one update for 16 steps": benchmark.ours(seldom),
    }
    for group, who in groups.items():
        _measure(benchmark, results, group, who)
    wanted: tuple[tuple[str, str, str, float | None, float | None], ...] = (
        ("env steps: CausalGDP default, guided, vs SB3 SAC 3x256", DEFAULT, SAC, 1.0, 1.4),
        ("env steps: CausalGDP default with 3x256, guided, vs SB3 SAC 3x256", ONE_STEP_RELU, SAC, 1.0, 1.4),
        ("env steps, K=10: CausalGDP Mish 3x256 vs Diffusion-QL in a plain loop", TEN_STEPS, DIFFUSION_QL, None, None),
        ("env steps, K=10, the same networks: CausalGDP vs its authors' loop", TEN_STEPS_AS_AUTHORS, AUTHORS, 2.2, 3.0),
        ("env steps: 16 environments vs 1, an update for each step", MANY_ENVS, ONE_ENV, 1.3, 2.0),
        ("env steps: 16 environments vs 1, an update for 16 steps", MANY_ENVS_SELDOM, ONE_ENV_SELDOM, 1.3, 2.0),
    )
    for what, name, reference, must, goal in wanted:
        results.verdicts.append(_verdict(results, what, name, reference, must, goal))
        if not benchmark.args.no_compile:
            twin = compiled(reference) if reference in (ONE_ENV, ONE_ENV_SELDOM) else reference
            results.verdicts.append(_verdict(results, f"{what}, compiled", compiled(name), twin, must, goal))
    results.write(COLUMNS)


def _measure(benchmark: Benchmark, results: Results, group: str, who: list[Contestant]) -> None:
    args = benchmark.args
    with benchmark.field(who, transitions=benchmark.transitions(HALF_CHEETAH), env=HALF_CHEETAH) as field:
        turns = field.interleaved(
            args.learn_rounds,
            lambda worker: learning.turn(worker, args.steps),
            lambda worker: learning.warm_up(worker, STARTS),
        )
        results.about |= {name: worker.about for name, worker in field.workers.items()}
        results.rows += [{"group": group, "contestant": one.name, **learning.row(field, one.name, turns)} for one in who]


def _verdict(
    results: Results, what: str, name: str, reference: str, must: float | None = None, goal: float | None = None
) -> Verdict:
    seconds = {row["contestant"]: row for row in results.rows if row["status"] == "ok"}
    missing = [one for one in (name, reference) if one not in seconds]
    if missing:
        return Verdict(what, None, must, goal, note=f"not available: {missing[0]}")
    return Verdict(what, median_ratio(*(_with_refreshes(seconds[one]) for one in (reference, name))), must, goal)


def _with_refreshes(row: dict[str, Any]) -> list[float]:
    """Milliseconds per step of each turn."""
    refresh = (row["ms per refresh"] or 0.0) / learning.REFRESH_PERIOD
    return [1e3 * turn["seconds"] / turn["steps"] + refresh for turn in row["turns"]]
