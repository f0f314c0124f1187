"""All that a training is, written in one piece and put back: for any of SB3's off-policy algorithms."""

import copy
import inspect
import io
import random
import uuid
import warnings
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.checkpoints.callback_states import all_callbacks, callback_states, plain_values, set_callback_states
from sb3_causalgdp.checkpoints.environments import environment_state, restore_environment
from sb3_causalgdp.checkpoints.pickles import classes_in, from_bytes, to_bytes
from sb3_causalgdp.checkpoints.store import Checkpoint, open_checkpoint, run_of, write_checkpoint
from sb3_causalgdp.checkpoints.transitions import FOLDER, Log, rest_of, set_rest
from sb3_causalgdp.files import errors_about, replaced_when_done, temporary_folder
from sb3_causalgdp.offline.saved_buffers import BUFFERS, check_columns
from sb3_causalgdp.saving.archives import errors_of
from sb3_causalgdp.saving.models import check_limits
from sb3_causalgdp.saving.numpy_pickles import check_random_state
from sb3_causalgdp.sources.rewards import RewardTransform

SelfAlgorithm = TypeVar("SelfAlgorithm", bound=OffPolicyAlgorithm)

MODEL, STATE = "model.zip", "state.bin"
# Of the model, but not in its zip file, or not as it is
ATTRIBUTES = (
    "_last_obs",
    "_last_original_obs",
    "_last_episode_starts",
    "ep_info_buffer",
    "ep_success_buffer",
    "action_noise",
    "_offline_marks",
    "_fed_offline_position",
    "_is_compiled",
)
# Set by learn() when it starts, in vain where it goes on
SET_BY_LEARN = ("action_noise",)


@dataclass
class Bookkeeping:
    """
    What a model knows of its checkpoints.

    :param run: Name of the training, the same in all of its checkpoints
    :param folder: Where its transitions are
    :param logs: Of its replay buffers
    :param callbacks: States of the callbacks, until those of the resumed training are there
    :param attributes: Of the model, until ``learn()`` has started
    :param fresh: Values of callbacks as they were made: what differs later was counted
    :param of_pretraining: Whether a resumed model was in ``pretrain()``
    :param was_complete: Whether a resumed model had taken all steps of that call
    :param said: Whether it was said what of the environments cannot be saved
    """

    run: str = field(default_factory=lambda: uuid.uuid4().hex[:16])
    folder: Path | None = None
    logs: dict[str, Log] = field(default_factory=dict)
    callbacks: list[dict[str, Any]] = field(default_factory=list)
    attributes: dict[str, Any] = field(default_factory=dict)
    fresh: "WeakKeyDictionary[BaseCallback, dict[str, bytes]]" = field(default_factory=WeakKeyDictionary)
    of_pretraining: bool = False
    was_complete: bool = True
    said: bool = False

    def __reduce__(self) -> tuple[type, tuple]:
        # A model that is saved and loaded is another training
        return type(self), ()


def bookkeeping_of(model: OffPolicyAlgorithm) -> Bookkeeping:
    """
    :param model: A model
    :return: What it knows of its checkpoints
    """
    return vars(model).setdefault("_checkpoints", Bookkeeping())


# Writing ------------------------------------------------------------------------------------------------------------------


def save_checkpoint(
    model: OffPolicyAlgorithm, path: str | Path, callback: BaseCallback | None = None, keep: int | None = 2
) -> Path:
    """
    Write all that a training is: weights, optimizers, replay buffers, statistics, counters, random number generators, and the
    state of environments and callbacks. Between two rollouts, :func:`resume` makes of it a training that goes on bit for bit
    as this one does.

    :param model: The model
    :param path: A folder, to which only new transitions are added, or a file with the suffix ``.zip``
    :param callback: The callbacks of the training, to save what they count
    :param keep: How many of the newest checkpoints to keep in a folder, None for all
    :return: The file, or the checkpoint's folder
    :raises ValueError: If the folder holds checkpoints of another training
    """
    path = Path(path)
    if path.suffix != ".zip":
        return _save_in_folder(model, path, callback, keep)
    with temporary_folder(path.absolute().parent) as folder, errors_about(path):
        logs = bookkeeping_of(model).logs
        bookkeeping_of(model).logs = {}
        try:
            written = _save_in_folder(model, folder, callback, None)
        finally:
            bookkeeping_of(model).logs = logs
        with replaced_when_done(path) as file, zipfile.ZipFile(file, "w") as archive:
            for part in sorted([*written.iterdir(), *(folder / FOLDER).glob("*")]):
                archive.write(part, f"{FOLDER}/{part.name}" if part.parent.name == FOLDER else part.name)
    return path


def check_folder(model: OffPolicyAlgorithm, folder: Path) -> None:
    """
    :param model: A model
    :param folder: Where its checkpoints shall be
    :raises ValueError: If it holds those of another training
    """
    there = run_of(folder)
    if there is not None and there != bookkeeping_of(model).run:
        raise ValueError(
            f"{folder} holds checkpoints of another training: resume({str(folder)!r}) it, or choose another folder"
        )


def _save_in_folder(model: OffPolicyAlgorithm, folder: Path, callback: BaseCallback | None, keep: int | None) -> Path:
    check_folder(model, folder)
    own = bookkeeping_of(model)
    buffers = _buffers_of(model)
    new_logs = {name: _log_of(model, name, buffer, folder) for name, buffer in buffers.items()}
    state = _state_of(model, callback)
    state["rest"] = {name: rest_of(buffer) for name, buffer in buffers.items()}
    content = {
        "run": own.run,
        "algorithm": type(model).__name__,
        "num_timesteps": int(model.num_timesteps),
        "n_updates": int(getattr(model, "_n_updates", 0)),
        "buffers": {name: log.to_json() for name, log in new_logs.items()},
        "pretraining": _is_pretraining(model),
        "complete": model.num_timesteps >= model._total_timesteps,
        "one_buffer": getattr(model, "offline_buffer", None) is model.replay_buffer,
    }
    path = write_checkpoint(folder, {MODEL: _model_zip(model), STATE: to_bytes(state)}, content, keep)
    own.logs, own.folder = new_logs, folder.absolute()
    return path


def _is_pretraining(model: OffPolicyAlgorithm) -> bool:
    return bool(getattr(model, "is_pretraining", False))


def _buffers_of(model: OffPolicyAlgorithm) -> dict[str, Any]:
    buffers = {"online": model.replay_buffer, "offline": getattr(model, "offline_buffer", None)}
    if buffers["offline"] is buffers["online"]:
        del buffers["offline"]
    return {name: buffer for name, buffer in buffers.items() if buffer is not None}


def _log_of(model: OffPolicyAlgorithm, name: str, buffer: Any, folder: Path) -> Log:
    own = bookkeeping_of(model)
    known = own.logs.get(name) if own.folder == folder.absolute() else None
    preloaded = buffer is getattr(model, "offline_buffer", None)
    stored = buffer.size() if preloaded else max(_stored_rows(model), buffer.size())
    # A preload may change the rewards of all
    transform = getattr(model, "_reward_transform", None)
    version = "" if transform in (None, RewardTransform()) else str(transform)
    if preloaded:
        version = f"{len(getattr(model, '_offline_marks', []))} preloaded"
    return (known or Log()).append(buffer, folder / FOLDER, f"{own.run}-{name}", stored, version)


def _stored_rows(model: OffPolicyAlgorithm) -> int:
    return int(getattr(model, "_stored_position", model.num_timesteps // model.n_envs))


def _model_zip(model: OffPolicyAlgorithm) -> bytes:
    stream = io.BytesIO()
    model.save(stream, include=[name for name in ("causal_graph_history",) if hasattr(model, name)])
    return stream.getvalue()


def _state_of(model: OffPolicyAlgorithm, callback: BaseCallback | None) -> dict[str, Any]:
    return {
        "generators": _generators(model),
        "attributes": {name: vars(model)[name] for name in ATTRIBUTES if name in vars(model)},
        "environment": _environment_of(model),
        "callbacks": [] if callback is None else callback_states(callback, bookkeeping_of(model).fresh),
    }


def _environment_of(model: OffPolicyAlgorithm) -> dict[str, Any] | None:
    if model.env is None or _is_pretraining(model):
        return None
    state = environment_state(model.env)
    own = bookkeeping_of(model)
    if state["problems"] and not own.said:
        own.said = True
        warnings.warn(
            f"Checkpoints lack a part of the environments' state, {', '.join(state['problems'])}, which cannot be pickled: a "
            "resumed training begins new episodes, and is not bit for bit the one that was interrupted."
        )
    return state


def _generators(model: OffPolicyAlgorithm) -> dict[str, Any]:
    space = model.action_space._np_random
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state().numpy(),
        "cuda": [state.numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else [],
        "actions": None if space is None else space.bit_generator.state,
    }


# Reading ------------------------------------------------------------------------------------------------------------------


def resume(
    algorithm: type[SelfAlgorithm],
    path: str | Path,
    env: GymEnv | str | None = None,
    device: th.device | str = "auto",
    trusted: bool = False,
) -> SelfAlgorithm:
    """
    Make the model of an interrupted training, which goes on where its newest whole checkpoint is.

    :param algorithm: Class of the model
    :param path: Folder of checkpoints, one of them, or a zip file
    :param env: Environment that was made as the first one, or its id; None where the training needs none
    :param device: Device on which the code should be run
    :param trusted: Whether the file may name Python objects that could run code
    :return: The model
    :raises FileNotFoundError: If there is no checkpoint
    :raises ValueError: If none is whole, or the environment is another one
    """
    env = None if env is None else maybe_make_env(env, verbose=0)
    with open_checkpoint(Path(path)) as checkpoint, errors_of(checkpoint.path, "cannot be resumed"):
        # SB3's own algorithms trust every file
        trust: dict[str, Any] = {"trusted": trusted} if "trusted" in inspect.signature(algorithm.load).parameters else {}
        with checkpoint.read(MODEL) as file:
            model = algorithm.load(io.BytesIO(file.read()), env=env, device=device, force_reset=False, **trust)
        _check(model, checkpoint)
        own = bookkeeping_of(model)
        own.run = checkpoint.manifest["run"]
        own.of_pretraining = checkpoint.manifest["pretraining"]
        own.was_complete = checkpoint.manifest["complete"]
        own.folder = None if checkpoint.path.is_file() else checkpoint.path.absolute().parent
        with checkpoint.read(STATE) as file:
            allowed = classes_in(model.action_noise, model.replay_buffer)
            # What learn() makes of an action noise
            allowed |= {VectorizedActionNoise}
            state = from_bytes(file.read(), allowed=allowed, trusted=trusted)
        _restore(model, checkpoint, state, trusted)
    return model


def _check(model: OffPolicyAlgorithm, checkpoint: Checkpoint) -> None:
    algorithm = checkpoint.manifest["algorithm"]
    if algorithm != type(model).__name__:
        raise ValueError(f"{checkpoint.path} is of {algorithm}, not of {type(model).__name__}")


def _restore(model: OffPolicyAlgorithm, checkpoint: Checkpoint, state: dict[str, Any], trusted: bool) -> None:
    environment = state["environment"]
    if environment is not None and model.env is not None and model.env.num_envs != environment["n_envs"]:
        raise ValueError(f"the checkpoint is of {environment['n_envs']} environments, got {model.env.num_envs}")
    _restore_buffers(model, checkpoint, state["rest"], trusted)
    vars(model).update({name: value for name, value in state["attributes"].items() if name in ATTRIBUTES})
    own = bookkeeping_of(model)
    own.callbacks = state["callbacks"]
    own.attributes = copy.deepcopy({name: value for name, value in state["attributes"].items() if name in SET_BY_LEARN})
    if environment is not None and model.env is not None:
        if environment["problems"]:
            begin_new_episodes(model)
        else:
            restore_environment(model.env, environment, trusted)
    _set_generators(model, state["generators"])


def _restore_buffers(model: Any, checkpoint: Checkpoint, rest: dict[str, Any], trusted: bool) -> None:
    own = bookkeeping_of(model)
    for name, content in checkpoint.manifest["buffers"].items():
        of_buffer = rest[name]
        buffer = model.replay_buffer
        if not trusted:
            check_limits({key: of_buffer[key] for key in ("buffer_size", "n_envs")}, 0)
        if name == "offline" or of_buffer["buffer_size"] != buffer.buffer_size:
            buffer = model._new_buffer(of_buffer["buffer_size"] * of_buffer["n_envs"])
        log = Log.from_json(content, buffer)
        log.fill(buffer, checkpoint.read)
        set_rest(buffer, of_buffer)
        if not trusted and type(buffer) in BUFFERS:
            check_columns(buffer, f"the replay buffer {name!r}")
        own.logs[name] = log
        setattr(model, "offline_buffer" if name == "offline" else "replay_buffer", buffer)
    if checkpoint.manifest["one_buffer"]:
        model.offline_buffer = model.replay_buffer


def begin_new_episodes(model: OffPolicyAlgorithm) -> None:
    """
    Where the state of environments cannot be had: the rows before and behind the gap do not follow each other, and the
    environments do not begin with the start states of the first time.

    :param model: The model
    """
    warnings.warn("The environments begin new episodes: a part of their state could not be saved.")
    model._last_obs = None
    if model.replay_buffer is not None:
        end_last_episodes(model.replay_buffer)
    if model.seed is not None:
        assert model.env is not None
        model.env.seed(fresh_seed(model))


def end_last_episodes(buffer: ReplayBuffer) -> None:
    """
    Mark the newest transitions as the last ones before a timeout, where environments are reset in the middle of an episode:
    returns of several steps and hindsight goals must not reach over the gap.

    :param buffer: A replay buffer
    """
    unfinished = buffer.dones[buffer.pos - 1] == 0
    if buffer.size() == 0 or not unfinished.any():
        return
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            buffer.truncate_last_trajectory()
        return
    buffer.dones[buffer.pos - 1][unfinished] = 1
    if buffer.handle_timeout_termination:
        buffer.timeouts[buffer.pos - 1][unfinished] = 1


def fresh_seed(model: OffPolicyAlgorithm) -> int:
    """
    :param model: A model with a seed
    :return: Another seed, which follows from its own and the number of its steps
    """
    assert model.seed is not None
    return int(np.random.SeedSequence([model.seed, model.num_timesteps]).generate_state(1)[0] >> 1)


def _set_generators(model: OffPolicyAlgorithm, states: dict[str, Any]) -> None:
    random.setstate(states["python"])
    check_random_state(states["numpy"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(th.from_numpy(states["torch"].copy()))
    if th.cuda.is_available() and len(states["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all([th.from_numpy(state.copy()) for state in states["cuda"]])
    if states["actions"] is not None:
        check_random_state(states["actions"])
        model.action_space.np_random.bit_generator.state = states["actions"]


def begin_training(model: OffPolicyAlgorithm, callback: BaseCallback) -> None:
    """
    Look at the callbacks as they are made; where a training is resumed, give them back what they counted.

    :param model: A model whose training has just been set up
    :param callback: All its callbacks
    """
    own = bookkeeping_of(model)
    for one in all_callbacks(callback):
        own.fresh.setdefault(one, {name: to_bytes(value) for name, value in plain_values(one).items()})
    vars(model).update(own.attributes)
    states, own.callbacks, own.attributes = own.callbacks, [], {}
    if own.of_pretraining == _is_pretraining(model):
        set_callback_states(callback, states)
