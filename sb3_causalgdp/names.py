"""The environment's own names of what it shows and takes."""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecFrameStack, VecTransposeImage

from sb3_causalgdp.offline.observations import key_names

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
    Names of the components of an observation and of the actions: the attributes ``state_names`` and ``action_names`` of
    the environment or of one of its wrappers; else the keys of a dictionary, also of a flattened one; else the joints and
    actuators of MuJoCo's models; else those that Gymnasium documents for its own environments. A wrapper that changes
    observations hides what lies below, unless it has the attribute, or says by ``added_state_names`` and
    ``added_action_names`` what it appends.

    :param env: The environment, or several of one kind
    :return: Of the states and of the actions; None for those that were not found
    """
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecFrameStack | VecTransposeImage):
            return None, None
        env = env.venv
    if isinstance(env, VecEnv) and not isinstance(env, DummyVecEnv):
        found = _told_by(env)
    else:
        found = _of_one(env.envs[0] if isinstance(env, DummyVecEnv) else env)
    states, actions = found
    # A key may have the name of an action
    return states, None if states and actions and set(states) & set(actions) else actions


def _told_by(venv: VecEnv) -> tuple[Names | None, Names | None]:
    """What environments in other processes say, else what Gymnasium makes of the same id, without wrappers around it there."""
    told = [
        _checked(_as_names(venv.get_attr(attribute)[0]), space) if venv.has_attr(attribute) else None
        for attribute, space in (("state_names", venv.observation_space), ("action_names", venv.action_space))
    ]
    states, actions = told[0] or _checked(key_names(venv.observation_space), venv.observation_space), told[1]
    spec = next(iter(venv.get_attr("spec")), None) if venv.has_attr("spec") else None
    is_gymnasiums = spec is not None and str(spec.entry_point).startswith("gymnasium.")
    if spec is None or not is_gymnasiums or (states and actions):
        return states, actions
    like_them = gym.make(spec.id)
    own = _of_one(like_them)
    like_them.close()
    return states or _checked(own[0], venv.observation_space), actions or _checked(own[1], venv.action_space)


def _of_one(env: gym.Env | None) -> tuple[Names | None, Names | None]:
    if env is None:
        return None, None
    states, actions = (_names_in(env, attribute) for attribute in ("state_names", "action_names"))
    told = states is not None, actions is not None
    states = _checked(states, env.observation_space) or _with_added(env, "state_names")
    actions = _checked(actions, env.action_space) or _with_added(env, "action_names")
    if states is None and not told[0]:
        states = _names_of_keys(env)
    if states is None and not told[0] and not _is_changed(env, "state_names"):
        states = _state_names(env.unwrapped)
    if actions is None and not told[1] and not _is_changed(env, "action_names"):
        actions = _action_names(env.unwrapped)
    return _checked(states, env.observation_space), _checked(actions, env.action_space)


def _names_in(env: gym.Env, attribute: str) -> Names | None:
    return _as_names(env.get_wrapper_attr(attribute)) if env.has_wrapper_attr(attribute) else None


def _with_added(env: gym.Env, attribute: str) -> Names | None:
    """What is below a wrapper that appends components and says their names, and these."""
    space = attribute.replace("names", "space").replace("state", "observation")
    while isinstance(env, gym.Wrapper):
        added = getattr(env, f"added_{attribute}", ())
        if added:
            below = _of_one(env.env)[attribute == "action_names"]
            return None if below is None else _different((*below, *added))
        if getattr(env, space) != getattr(env.env, space) and not _keeps_numbers(env):
            return None
        env = env.env
    return None


def _different(names: Names) -> Names:
    """Two wrappers of one kind append the same names."""
    found: list[str] = []
    for name in names:
        n_before = sum(one == name or one.startswith(f"{name} #") for one in found)
        found.append(f"{name} #{n_before + 1}" if n_before else name)
    return tuple(found)


def _as_names(value: Any) -> Names | None:
    names = value() if callable(value) else value
    return None if names is None or isinstance(names, str) else tuple(str(name) for name in names)


def _names_of_keys(env: gym.Env) -> Names | None:
    """Of a dictionary, which may be flattened."""
    while not isinstance(env.observation_space, spaces.Dict):
        if not (isinstance(env, gym.Wrapper) and (_keeps_numbers(env) or env.observation_space == env.env.observation_space)):
            return None
        env = env.env
    known = {} if _is_changed(env, "state_names") else _known_keys(env.unwrapped)
    return key_names(env.observation_space, known)


def _known_keys(env: gym.Env) -> dict[str, tuple[str, ...]]:
    if env.spec is None or not (type(env).__module__.startswith("gymnasium_robotics.") and "PointMaze" in env.spec.name):
        return {}
    points = {key: (f"{name} x", f"{name} y") for key, name in (("achieved_goal", "achieved"), ("desired_goal", "goal"))}
    return {"observation": ("x", "y", "vel x", "vel y"), **points}


def _is_changed(env: gym.Env, attribute: str) -> bool:
    """Whether a wrapper gives or takes something else than the environment inside."""
    space = "observation_space" if attribute == "state_names" else "action_space"
    changes = gym.ObservationWrapper if attribute == "state_names" else gym.ActionWrapper
    while isinstance(env, gym.Wrapper):
        if isinstance(env, changes) and not _keeps_numbers(env) and getattr(env, space) != getattr(env.env, space):
            return True
        env = env.env
    return False


def _keeps_numbers(env: gym.Env) -> bool:
    """Whether they are the same ones in the same order, and at most scaled."""
    names = ("NormalizeObservation", "RescaleObservation", "RescaleAction", "ClipAction", "FlattenObservation")
    return type(env).__name__ in names


def _checked(names: Names | None, space: spaces.Space) -> Names | None:
    if names is None or len(set(names)) != len(names) or "reward" in names or not isinstance(space, spaces.Box | spaces.Dict):
        return None
    return names if space.is_np_flattenable and spaces.flatdim(space) == len(names) else None


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
