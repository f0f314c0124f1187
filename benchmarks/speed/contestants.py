"""Who is measured: CausalGDP's settings and the peers, all with three layers of 256 units unless their name says otherwise."""

from typing import Any

from benchmarks.speed.client import Contestant

LAYERS = [256, 256, 256]
SAME_NETS = {"net_arch": LAYERS}
MISH_NETS = {"net_arch": LAYERS, "activation_fn": "mish"}

DEFAULT = "CausalGDP, default"
ONE_STEP = "CausalGDP, one_step, Mish 3x256"
ONE_STEP_RELU = "CausalGDP, default, ReLU 3x256"
CHAIN = "CausalGDP, chain, Mish 3x256"
SAC = "SB3 SAC"
SBX = "SBX SAC"
DIFFUSION_QL = "Diffusion-QL, its authors' code"
AUTHORS = "CausalGDP, its authors' code"


def causalgdp(name: str, one_at_a_time: bool = False, n_envs: int = 1, **kwargs: Any) -> Contestant:
    """
    :param name: As the tables call it
    :param one_at_a_time: One gradient step for each call of ``train()``, as ``learn()`` does it by default
    :param n_envs: Environments that it learns from
    :param kwargs: Arguments of the constructor
    """
    config = {"kwargs": kwargs, "updates_per_call": 1 if one_at_a_time else None, "n_envs": n_envs}
    return Contestant(name, "causalgdp", config)


def compiled(name: str) -> str:
    """
    :param name: Of one of CausalGDP's settings
    :return: Of the same with ``compile=True``
    """
    return f"{name}, compile"


def with_compiled(who: list[Contestant]) -> list[Contestant]:
    """
    :param who: CausalGDP's settings
    :return: Each with its compiled twin behind it
    """
    twins = []
    for one in who:
        config = {**one.config, "kwargs": {**one.config["kwargs"], "compile": True}}
        twins += [one, Contestant(compiled(one.name), one.module, config)]
    return twins


def main_settings() -> list[Contestant]:
    """The three that the tables are about; the world model is trained and the graph is known in all of CausalGDP's."""
    return [
        causalgdp(DEFAULT),
        causalgdp(ONE_STEP, actor_update="one_step", policy_kwargs=MISH_NETS),
        causalgdp(CHAIN, actor_update="chain", policy_kwargs=MISH_NETS),
    ]


def one_step_relu() -> Contestant:
    """The default with the layers of the peers."""
    return causalgdp(ONE_STEP_RELU, policy_kwargs=SAME_NETS)


def more_settings() -> list[Contestant]:
    """What takes longer, and what a call of ``train()`` costs."""
    return [
        causalgdp(f"{DEFAULT}, one update a call", one_at_a_time=True),
        one_step_relu(),
        causalgdp("CausalGDP, chain, Mish 3x256, no guidance", actor_update="chain", policy_kwargs=MISH_NETS, guidance=None),
    ]


def sb3(algorithm: str, name: str | None = None, one_at_a_time: bool = False, **kwargs: Any) -> Contestant:
    """
    :param algorithm: ``SAC``, ``TD3`` or ``TQC``
    :param name: As the tables call it
    :param one_at_a_time: One gradient step for each call of ``train()``
    :param kwargs: Arguments of the constructor
    """
    config = {
        "algorithm": algorithm,
        "kwargs": {"policy_kwargs": SAME_NETS, **kwargs},
        "updates_per_call": 1 if one_at_a_time else None,
    }
    return Contestant(name or f"SB3 {algorithm}", "sb3", config)


def sbx_sac(python: str, one_at_a_time: bool = False) -> Contestant:
    """
    :param python: Interpreter that has SBX
    :param one_at_a_time: One gradient step for each call of ``train()``
    """
    name = f"{SBX}, one update a call" if one_at_a_time else SBX
    config = {"kwargs": {"policy_kwargs": SAME_NETS}, "updates_per_call": 1 if one_at_a_time else None}
    return Contestant(name, "sbx_sac", config, python)


def d3rlpy_td3bc(python: str, with_sampling: bool = True) -> Contestant:
    """
    :param python: Interpreter that has d3rlpy
    :param with_sampling: Whether gathering the batch counts
    """
    name = "d3rlpy TD3+BC" if with_sampling else "d3rlpy TD3+BC, batch given"
    return Contestant(name, "d3rlpy_td3bc", {"net_arch": LAYERS, "with_sampling": with_sampling}, python)


def diffusion_ql(path: str, diffusion_steps: int = 5) -> Contestant:
    """
    :param path: Checkout of Diffusion-Policies-for-Offline-RL
    :param diffusion_steps: K
    """
    return Contestant(DIFFUSION_QL, "diffusion_ql", {"path": path, "diffusion_steps": diffusion_steps})


def causalgdp_authors(path: str) -> Contestant:
    """
    :param path: Checkout of the authors' CausalGDP
    """
    return Contestant(AUTHORS, "causalgdp_authors", {"path": path, "diffusion_steps": 5})
