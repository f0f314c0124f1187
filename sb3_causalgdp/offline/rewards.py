"""What others do to the rewards of offline datasets, by name."""

from collections.abc import Callable

from sb3_causalgdp.sources.rewards import RewardTransform, SavedRewards

__all__ = ["REWARD_TRANSFORMS", "RewardTransform", "SavedRewards", "check_reward_transform", "make_reward_transform"]


def _by_return_range(lowest: float, highest: float) -> RewardTransform:
    if not highest > lowest:
        raise ValueError("reward_transform='normalize' needs episodes with different returns")
    return RewardTransform(1000.0 / (highest - lowest))


REWARD_TRANSFORMS: dict[str, Callable[[float, float], RewardTransform]] = {
    "none": lambda lowest, highest: RewardTransform(),
    # 1000 / (highest - lowest return of an episode): IQL on MuJoCo (https://arxiv.org/abs/2110.06169), train_offline.py of
    # ikostrikov/implicit_q_learning; "iql_locomotion" of Diffusion-QL
    "normalize": _by_return_range,
    # (r - 0.5) * 4: CQL on AntMaze (https://arxiv.org/abs/2006.04779), d4rl/examples/cql_antmaze_new.py of
    # aviralkumar2907/CQL; "cql_antmaze" of Diffusion-QL
    "antmaze": lambda lowest, highest: RewardTransform(4.0, -2.0),
    # r - 1: IQL on AntMaze, where it found no difference to CQL's; "iql_antmaze" of Diffusion-QL
    "antmaze_iql": lambda lowest, highest: RewardTransform(1.0, -1.0),
}
"""By name, from the lowest and the highest return of an episode."""


def check_reward_transform(transform: str | RewardTransform) -> None:
    """
    :param transform: A transform or a name
    :raises ValueError: If the name is unknown
    """
    if isinstance(transform, str) and transform not in REWARD_TRANSFORMS:
        raise ValueError(f"Unknown reward_transform {transform!r}: it must be one of {sorted(REWARD_TRANSFORMS)}")


def make_reward_transform(name: str, returns: tuple[float, float]) -> RewardTransform:
    """
    :param name: A key of :data:`REWARD_TRANSFORMS`
    :param returns: Lowest and highest return of an episode
    :return: The transform
    """
    check_reward_transform(name)
    return REWARD_TRANSFORMS[name](*returns)
