"""The environment's own names of what it shows and takes."""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecFrameStack, VecTransposeImage

Names = tuple[str, ...]

_BIPED_LEGS = [f"{what}{joint} {leg}" for leg in (1, 2) for joint in ("hip", "knee") for what in ("", "vel ")]
_KNOWN: dict[str, tuple[Sequence[str], Sequence[str]]] = {
    "Pendulum": (("cos angle", "sin angle", "vel angle"), ("torque",)),
    "MountainCarContinuous": (("position", "velocity"), ("force",)),
    "LunarLander(Continuous)?": (
        ("x", "y", "vel x", "vel y", "angle", "vel angle", "left contact", "right contact"),
        ("main engine", "side engine"),
    ),
    "BipedalWalker(Hardcore)?": (
        (
            *("hull angle", "vel hull angle", "vel x", "vel y"),
            *(*_BIPED_LEGS[:4], "contact 1", *_BIPED_LEGS[4:], "contact 2"),
            *(f"lidar {ray}" for ray in range(10)),
        ),
        ("torque hip 1", "torque knee 1", "torque hip 2", "torque knee 2"),
    ),
    "InvertedDoublePendulum": (
        (
            *("slider", "sin hinge", "sin hinge2", "cos hinge", "cos hinge2"),
            *("vel slider", "vel hinge", "vel hinge2", "constraint slider"),
        ),
        (),
    ),
    "Reacher": (
        (
            *("cos joint0", "cos joint1", "sin joint0", "sin joint1", "target x", "target y"),
            *("vel joint0", "vel joint1", "fingertip to target x", "fingertip to target y"),
        ),
        (),
    ),
    "Pusher": (
        (
            *(
                f"{what}{joint}"
                for what in ("", "vel ")
                for joint in (
                    *("r_shoulder_pan_joint", "r_shoulder_lift_joint", "r_upper_arm_roll_joint", "r_elbow_flex_joint"),
                    *("r_forearm_roll_joint", "r_wrist_flex_joint", "r_wrist_roll_joint"),
                )
            ),
            *(f"{what} {axis}" for what in ("fingertip", "object", "goal") for axis in "xyz"),
        ),
        (),
    ),
}
"""By the id's name, without its version: of the observation and of the action; nothing where MuJoCo knows them."""
_FREE = (
    *("x", "y", "z", "quaternion w", "quaternion x", "quaternion y", "quaternion z"),
    *("vel x", "vel y", "vel z", "vel rotation x", "vel rotation y", "vel rotation z"),
)
_BALL = (*(f"quaternion {axis}" for axis in "wxyz"), *(f"vel rotation {axis}" for axis in "xyz"))


def found_names(env: VecEnv | gym.Env | None) -> tuple[Names | None, Names | None]:
    """
    Names of the components of a flat observation and of the actions: the attributes ``state_names`` and ``action_names`` of
    the environment or of one of its wrappers; else the joints and actuators of MuJoCo's models; else those that Gymnasium
    documents for its own environments. A wrapper that changes observations hides what lies below, unless it has the attribute.

    :param env: The environment, or several of one kind
    :return: Of the states and of the actions; None for those that were not found
    """
    one = _first_of(env)
    if one is None:
        return None, None
    found = []
    for attribute, space, own in (
        ("state_names", one.observation_space, _state_names),
        ("action_names", one.action_space, _action_names),
    ):
        names = _attribute_of(one, attribute)
        if names is None and not _is_changed(one, attribute):
            names = own(one.unwrapped)
        found.append(names if names is not None and _fit(names, space) else None)
    return found[0], found[1]


def _first_of(env: VecEnv | gym.Env | None) -> gym.Env | None:
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecFrameStack | VecTransposeImage):
            return None
        env = env.venv
    if isinstance(env, DummyVecEnv):
        return env.envs[0]
    if isinstance(env, VecEnv):
        # In other processes: what Gymnasium makes of the same id, without the wrappers that may lie around it there
        spec = next(iter(env.get_attr("spec")), None) if env.has_attr("spec") else None
        own = spec is not None and str(spec.entry_point).startswith("gymnasium.")
        return gym.make(spec.id) if spec is not None and own else None
    return env


def _attribute_of(env: gym.Env, attribute: str) -> Names | None:
    if not env.has_wrapper_attr(attribute):
        return None
    names = env.get_wrapper_attr(attribute)
    names = names() if callable(names) else names
    return None if names is None or isinstance(names, str) else tuple(str(name) for name in names)


def _is_changed(env: gym.Env, attribute: str) -> bool:
    """Whether a wrapper gives or takes something else than the environment inside."""
    space = "observation_space" if attribute == "state_names" else "action_space"
    changes = gym.ObservationWrapper if attribute == "state_names" else gym.ActionWrapper
    while isinstance(env, gym.Wrapper):
        rescaled = type(env).__name__ in ("NormalizeObservation", "RescaleObservation", "RescaleAction", "ClipAction")
        if isinstance(env, changes) and not rescaled and getattr(env, space) != getattr(env.env, space):
            return True
        env = env.env
    return False


def _fit(names: Names, space: spaces.Space) -> bool:
    return isinstance(space, spaces.Box) and space.shape == (len(names),) and len(set(names)) == len(names)


def _known(env: gym.Env, which: int) -> Names | None:
    name = "" if env.spec is None else env.spec.name
    if not type(env).__module__.startswith("gymnasium."):
        return None
    found = next((names[which] for pattern, names in _KNOWN.items() if re.fullmatch(pattern, name)), ())
    return tuple(found) or None


# MuJoCo ------------------------------------------------------------------------------------------------------------------


def _state_names(env: Any) -> Names | None:
    known = _known(env, 0)
    if known is not None or not hasattr(env, "model") or not isinstance(getattr(env, "observation_structure", None), dict):
        return known
    structure = dict(env.observation_structure)
    positions, velocities = _joint_names(env.model)
    skipped = structure.pop("skipped_qpos", 0)
    bodies = [env.model.body(index).name or f"body {index}" for index in range(1, env.model.nbody)]
    parts: dict[str, Callable[[], Iterator[str]]] = {
        "qpos": lambda: iter(positions[skipped:]),
        "qvel": lambda: iter(velocities),
        "cinert": lambda: (f"inertia {body} {index}" for body in bodies for index in range(10)),
        "cvel": lambda: (f"velocity {body} {axis}" for body in bodies for axis in _of_six()),
        "cfrc_ext": lambda: (f"contact {body} {axis}" for body in bodies for axis in _of_six()),
        "qfrc_actuator": lambda: (name.replace("vel ", "actuator force ", 1) for name in velocities[6:]),
    }
    names: list[str] = []
    for part, count in structure.items():
        if count and part not in parts:
            return None
        of_part = list(parts[part]()) if count else []
        if len(of_part) != count:
            return None
        names += of_part
    return tuple(names)


def _of_six() -> tuple[str, ...]:
    return ("rotation x", "rotation y", "rotation z", "x", "y", "z")


def _joint_names(model: Any) -> tuple[list[str], list[str]]:
    """Of each component of ``qpos`` and of ``qvel``."""
    positions, velocities = [], []
    for index in range(model.njnt):
        name, kind = model.joint(index).name or f"joint {index}", int(model.jnt_type[index])
        if kind >= 2:  # a slide or a hinge
            positions.append(name)
            velocities.append(f"vel {name}")
            continue
        parts, n_positions = (_FREE, 7) if kind == 0 else (_BALL, 4)
        positions += [f"{name} {part}" for part in parts[:n_positions]]
        velocities += [f"vel {name} {part.removeprefix('vel ')}" for part in parts[n_positions:]]
    return positions, velocities


def _action_names(env: Any) -> Names | None:
    known = _known(env, 1)
    if known is not None or not hasattr(env, "model") or not hasattr(env.model, "actuator_trnid"):
        return known
    model = env.model
    names = []
    for index in range(model.nu):
        joint = int(model.actuator_trnid[index, 0])
        drives_joint = int(model.actuator_trntype[index]) == 0
        kind = "control" if not drives_joint else "force" if int(model.jnt_type[joint]) == 2 else "torque"
        name = model.actuator(index).name or (model.joint(joint).name if drives_joint else f"actuator {index}")
        names.append(f"{kind} {name}")
    return tuple(names)
