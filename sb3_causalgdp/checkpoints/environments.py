"""The state of environments: read, and put into others that were made in the same way."""

import gc
import random
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_causalgdp.checkpoints.pickles import CODE, classes_in, from_bytes, to_bytes

State = dict[str, Any]
AGENT = "_checkpoint_agent"
# Of a VecEnv that holds the environments: all the rest is made anew
OF_BASE = ("_seeds", "_options", "reset_infos", "buf_obs", "buf_dones", "buf_rews", "buf_infos", "actions")
# Not state: made anew with the environment, or only looked at
MADE_ANEW = ("env", "venv", "class_attributes", "metadata", "spec", "render_mode", AGENT)
WINDOWS = ("clock", "isopen", "mujoco_renderer", "screen", "surf", "viewer", "window")


def environment_state(env: VecEnv) -> State:
    """
    :param env: Environments of a training
    :return: Their state, that of their wrappers and random number generators; ``problems`` says what of it cannot be had
    """
    layers = list(_layers(env, "venv"))
    names = [tuple(vars(layer)) for layer in layers[:-1]] + [OF_BASE]
    wrappers, problems = _read(layers, names)
    state: State = {"classes": _classes(layers), "wrappers": wrappers, "n_envs": env.num_envs, "environments": []}
    for read in _in_each(layers[-1], "read"):
        state["environments"].append(read)
        problems += read["problems"]
    if not state["environments"]:
        problems.append(f"the environments in a {type(layers[-1]).__name__}")
    state["problems"] = sorted(set(problems))
    return state


def restore_environment(env: VecEnv, state: State, trusted: bool = False) -> None:
    """
    :param env: Environments that were made as the others
    :param state: What :func:`environment_state` said of the others, without problems
    :param trusted: Whether to make whatever objects the state holds
    :raises ValueError: If these environments are others
    """
    layers = list(_layers(env, "venv"))
    if _classes(layers) != state["classes"] or env.num_envs != state["n_envs"]:
        raise ValueError(
            f"the checkpoint is of {state['n_envs']} environments in {' in '.join(state['classes'])}, "
            f"got {env.num_envs} in {' in '.join(_classes(layers))}"
        )
    _write(layers, state["wrappers"], trusted)
    _in_each(layers[-1], "write", state["environments"], trusted)


class _Agent:
    """Reads and writes the state of the environment that it is an attribute of, maybe in another process."""

    def __call__(self, command: str, *args: Any) -> Any:
        owner = self._owner()
        return _read_one(owner, True) if command == "read" else _write_one(owner, *args)

    def _owner(self) -> gym.Env:
        # SB3's worker calls attributes of its environment, and gives them nothing of it
        for holder in gc.get_referrers(self):
            owners = [holder] if not isinstance(holder, dict) else gc.get_referrers(holder)
            for owner in owners:
                if isinstance(owner, gym.Env) and vars(owner).get(AGENT) is self:
                    return owner
        raise RuntimeError("an environment that was given an attribute does not hold it")


def _in_each(base: VecEnv, command: str, states: list[State] | None = None, trusted: bool = False) -> list[Any]:
    """In every environment, where they can be reached."""
    per_env: list[tuple[Any, ...]] = [()] * base.num_envs if states is None else [(state, trusted) for state in states]
    if isinstance(base, DummyVecEnv):
        one: Callable[..., Any] = _read_one if command == "read" else _write_one
        return [one(env, *args) for env, args in zip(base.envs, per_env, strict=True)]
    if isinstance(base, SubprocVecEnv):
        base.set_attr(AGENT, _Agent())
        return [base.env_method(AGENT, command, *args, indices=[i])[0] for i, args in enumerate(per_env)]
    return []


def _read_one(env: gym.Env, own_process: bool = False) -> State:
    layers = list(_layers(env, "env"))
    values, problems = _read(layers, [tuple(vars(layer)) for layer in layers])
    generators = (random.getstate(), np.random.get_state()) if own_process else None
    return {"classes": _classes(layers), "values": values, "problems": problems, "generators": generators}


def _write_one(env: gym.Env, state: State, trusted: bool) -> None:
    layers = list(_layers(env, "env"))
    if _classes(layers) != state["classes"]:
        raise ValueError(f"the checkpoint is of {' in '.join(state['classes'])}, got {' in '.join(_classes(layers))}")
    _write(layers, state["values"], trusted)
    if state["generators"] is not None:
        random.setstate(state["generators"][0])
        np.random.set_state(state["generators"][1])


# Layers of wrappers ---------------------------------------------------------------------------------------------------------


def _layers(env: Any, inner: str) -> Iterator[Any]:
    yield env
    while isinstance(env, gym.Wrapper | VecEnvWrapper):
        env = getattr(env, inner)
        yield env


def _classes(layers: list[Any]) -> list[str]:
    return [f"{type(layer).__module__}.{type(layer).__qualname__}" for layer in layers]


def _read(layers: list[Any], names: list[tuple[str, ...]]) -> tuple[State, list[str]]:
    """The state of the layers, as bytes, and what of it cannot be had."""
    values = [
        {name: value for name in of_layer if (value := vars(layer).get(name)) is not None and _is_state(name, value)}
        for layer, of_layer in zip(layers, names, strict=True)
    ]
    # None is a state, too
    nothing = [
        [name for name in of_layer if name in vars(layer) and vars(layer)[name] is None and name not in MADE_ANEW]
        for layer, of_layer in zip(layers, names, strict=True)
    ]
    references: dict[int, tuple[Any, ...]] = {id(layer): ("layer", index) for index, layer in enumerate(layers)}
    for index, of_layer in enumerate(values):
        for name, value in of_layer.items():
            if _is_filled_in_place(value):
                references[id(value)] = ("value", index, name)
    problems: list[str] = []
    try:
        data = to_bytes(values, references)
    except Exception:
        values = [
            {name: value for name, value in of_layer.items() if _can_be_written(value, references, problems, layer, name)}
            for layer, of_layer in zip(layers, values, strict=True)
        ]
        data = to_bytes(values, references)
    in_place = {
        (index, name): _content(value)
        for index, of_layer in enumerate(values)
        for name, value in of_layer.items()
        if _is_filled_in_place(value)
    }
    # Spaces that belong to the class, and not to the object
    shared = [[_generators_of(getattr(layer, name, None)) for name in SPACES] for layer in layers]
    return {"values": data, "nothing": nothing, "in_place": in_place, "spaces": shared}, problems


def _write(layers: list[Any], state: State, trusted: bool) -> None:
    def resolve(reference: tuple[Any, ...]) -> Any:
        layer = layers[reference[1]]
        return layer if reference[0] == "layer" else vars(layer)[reference[2]]

    allowed = classes_in(*(vars(layer) for layer in layers))
    for layer, values in zip(layers, from_bytes(state["values"], resolve, allowed, trusted), strict=True):
        vars(layer).update(values)
    for layer, names in zip(layers, state["nothing"], strict=True):
        vars(layer).update(dict.fromkeys(name for name in names if _is_state(name, vars(layer).get(name))))
    for (index, name), content in state["in_place"].items():
        _fill(vars(layers[index])[name], content)
    for layer, generators in zip(layers, state["spaces"], strict=True):
        for name, of_space in zip(SPACES, generators, strict=True):
            _set_generators(getattr(layer, name, None), of_space)


def _is_state(name: str, value: Any) -> bool:
    return (
        name not in (*MADE_ANEW, *WINDOWS) and not isinstance(value, (*CODE, EnvSpec, ResultsWriter)) and not _is_model(value)
    )


def _can_be_written(value: Any, references: dict[int, Any], problems: list[str], layer: Any, name: str) -> bool:
    try:
        to_bytes(value, references)
        return True
    except Exception:
        problems.append(f"{type(layer).__name__}.{name} ({type(value).__name__})")
        return False


# What is filled in place, because others hold it, too ------------------------------------------------------------------------

SPACES = ("observation_space", "action_space")


def _is_filled_in_place(value: Any) -> bool:
    return isinstance(value, spaces.Space) or _is_simulation(value)


def _content(value: Any) -> Any:
    return _generators_of(value) if isinstance(value, spaces.Space) else _simulation_state(value)


def _fill(value: Any, content: Any) -> None:
    if isinstance(value, spaces.Space):
        _set_generators(value, content)
    else:
        _set_simulation_state(value, content)


def _subspaces(space: Any) -> Iterator[spaces.Space]:
    if isinstance(space, spaces.Space):
        yield space
        parts = getattr(space, "spaces", ())
        for part in parts.values() if isinstance(parts, dict) else parts:
            yield from _subspaces(part)


def _generators_of(space: Any) -> list[Any]:
    return [None if one._np_random is None else one._np_random.bit_generator.state for one in _subspaces(space)]


def _set_generators(space: Any, states: list[Any]) -> None:
    for one, state in zip(_subspaces(space), states, strict=True):
        if state is not None:
            one.np_random.bit_generator.state = state


# MuJoCo --------------------------------------------------------------------------------------------------------------------


def _is_simulation(value: Any) -> bool:
    return type(value).__name__ == "MjData" and type(value).__module__.startswith("mujoco")


def _is_model(value: Any) -> bool:
    return type(value).__name__ == "MjModel" and type(value).__module__.startswith("mujoco")


def _simulation_state(data: Any) -> State:
    import mujoco

    signature = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(data.model, signature))
    mujoco.mj_getState(data.model, data, state, signature)
    # What rewards read of the step before; arrays of contacts have no fixed size, and are computed anew
    arrays = {name: value.copy() for name in dir(data) if isinstance(value := getattr(data, name), np.ndarray)}
    return {"state": state, "arrays": arrays}


def _set_simulation_state(data: Any, content: State) -> None:
    import mujoco

    mujoco.mj_setState(data.model, data, content["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
    for name, value in content["arrays"].items():
        present = getattr(data, name, None)
        if isinstance(present, np.ndarray) and present.shape == value.shape:
            present[...] = value
