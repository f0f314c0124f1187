"""Stressed environments by name."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym

from sb3_causalgdp.stress.wrappers import (
    IdleActions,
    LastAction,
    NoiseDistractors,
    Nuisance,
    OtherEnvironment,
    SensorDeath,
    WeakActuator,
)

BASES = (
    "Pendulum-v1",
    "HalfCheetah-v5",
    "Hopper-v5",
    "Walker2d-v5",
    "Ant-v5",
    "Reacher-v5",
    "Swimmer-v5",
)
DISTRACTED_IDS = tuple(f"Distracted/{base}" for base in BASES)


def make_stressed(
    base: str,
    noises: int = 0,
    coefficient: float = 0.95,
    other: str | None = None,
    copies: int = 1,
    controlled: bool = False,
    idle_actions: int = 0,
    last_action: bool = False,
    nuisance: str | None = None,
    dead_sensors: Sequence[int] = (),
    dies_at: int = 10_000,
    weak_action: int | None = None,
    weak_from: int = 10_000,
    weak_factor: float = 0.2,
    **kwargs: Any,
) -> gym.Env:
    """
    An environment with any of the wrappers around it; those that are not asked for are not there.

    :param base: Gymnasium's id of the environment
    :param noises: Number of :class:`~sb3_causalgdp.stress.NoiseDistractors`
    :param coefficient: Their correlation with the step before, in [0, 1)
    :param other: Id of an :class:`~sb3_causalgdp.stress.OtherEnvironment`
    :param copies: Number of these
    :param controlled: Whether the agent has actions that move them
    :param idle_actions: Number of :class:`~sb3_causalgdp.stress.IdleActions`
    :param last_action: Whether the :class:`~sb3_causalgdp.stress.LastAction` is observed
    :param nuisance: Mode of a :class:`~sb3_causalgdp.stress.Nuisance`
    :param dead_sensors: Sensors of the base that die, see :class:`~sb3_causalgdp.stress.SensorDeath`
    :param dies_at: Step at which they do
    :param weak_action: Action that gets weak, see :class:`~sb3_causalgdp.stress.WeakActuator`
    :param weak_from: Step at which it does
    :param weak_factor: What it is multiplied with then, in [0, 1]
    :param kwargs: Arguments of the environment itself
    :return: the environment; what was appended comes behind its own observations and actions, in the order of these arguments
    """
    env = gym.make(base, **kwargs)
    if weak_action is not None:
        env = WeakActuator(env, weak_action, weak_from, weak_factor)
    if dead_sensors:
        env = SensorDeath(env, dead_sensors, dies_at)
    if noises:
        env = NoiseDistractors(env, noises, coefficient)
    if other is not None:
        env = OtherEnvironment(env, other, copies, controlled)
    if idle_actions:
        env = IdleActions(env, idle_actions)
    if last_action:
        env = LastAction(env)
    if nuisance is not None:
        env = Nuisance(env, nuisance)
    return env


def register_environments() -> None:
    """Register ``Distracted/<id>``, with 100 noises unless its arguments say otherwise, if that has not been done."""
    for base, environment_id in zip(BASES, DISTRACTED_IDS, strict=True):
        if environment_id not in gym.registry:
            gym.register(
                environment_id, entry_point="sb3_causalgdp.stress:make_stressed", kwargs={"base": base, "noises": 100}
            )
