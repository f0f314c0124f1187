"""Saving and loading models, all or nothing, and training checkpoints."""

import difflib
import io
import os
import pathlib
import warnings
from collections.abc import Collection, Iterable, Mapping
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import open_path, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_causalgdp.arguments import CONSTRUCTOR_ARGUMENTS, POLICY_ARGUMENTS, check_arguments
from sb3_causalgdp.checkpoints import TrainingCheckpointCallback, resume, save_checkpoint
from sb3_causalgdp.checkpoints.callback_states import all_callbacks
from sb3_causalgdp.checkpoints.checkpoint import bookkeeping_of
from sb3_causalgdp.divergence import ParametersError, TrainingDivergedError, check_optimizer_state, first_not_finite
from sb3_causalgdp.export import export_policy
from sb3_causalgdp.files import write_bytes
from sb3_causalgdp.knowledge import DiscoveringAlgorithm
from sb3_causalgdp.offline.pretraining import callback_list
from sb3_causalgdp.policies import CausalGDPPolicy, CnnPolicy, MultiInputPolicy
from sb3_causalgdp.saving.archives import errors_of, named, one_line
from sb3_causalgdp.saving.models import KNOWN, LARGE, append_entries, plain_entries, read_parameters, read_values
from sb3_causalgdp.saving.plain import Known

NETWORKS = ("policy", "actor", "critic", "world_model")

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="SavedAlgorithm")


# What models did before there were these arguments, and still do
FIRST_VALUES: dict[str, Any] = {
    "target_policy_noise": 0.0,
    "pessimism": 1.0,
    "causal_abstraction": False,
    "exploration_optimism": -1.0,
}


class SavedAlgorithm(DiscoveringAlgorithm):
    """
    An algorithm whose files are either whole or refused, and run nothing that they bring.

    :param args: As for :class:`~sb3_causalgdp.offline.algorithm.OfflineToOnlineAlgorithm`
    :param kwargs: As for :class:`~sb3_causalgdp.offline.algorithm.OfflineToOnlineAlgorithm`
    """

    MOST_RESTORES = 3

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self._resumed_at_gradient_step: int | None = None

    def set_parameters(self, load_path_or_dict, exact_match: bool = True, device: th.device | str = "auto") -> None:
        """
        Load parameters from a zip-file or a nested dictionary, all or nothing.

        :param load_path_or_dict: Path of a saved model, or what ``get_parameters`` gave
        :param exact_match: Whether the parameters of each module, and each of their parameters, have to be there
        :param device: Device on which the code should run
        :raises ValueError: If one is NaN or infinite, unknown or missing, or an optimizer's state does not fit its parameters;
            of a file also if it is not whole
        :raises RuntimeError: If a network is another one
        """
        if not isinstance(load_path_or_dict, dict):
            params = read_parameters(load_path_or_dict, device)
            try:
                self.set_parameters(params, exact_match, device)
            except Exception as error:
                raise ParametersError(f"{named(load_path_or_dict)} cannot be loaded: {one_line(error)}") from error
            return
        params = load_path_or_dict
        before = deepcopy(self.get_parameters())
        self._check_parameters(params)
        try:
            super().set_parameters(params, exact_match, device)
        except Exception as error:
            super().set_parameters(before)  # type: ignore[arg-type]
            if isinstance(error, ValueError):
                raise ParametersError(f"Nothing was loaded: {error}") from error
            raise
        finally:
            # Optimizers have other tensors now
            self._updates.fast.forget_recordings()

    def _check_parameters(self, params: Mapping[str, Any]) -> None:
        for name, state in params.items():
            owner = recursive_getattr(self, name, None)
            if isinstance(owner, th.optim.Optimizer):
                check_optimizer_state(owner, state, name)
            found = self.policy.first_not_finite(state) if owner is self.policy else first_not_finite(state, name)
            if found is not None:
                raise ParametersError(f"Nothing was loaded: {found[0]} holds {found[1]}, and all parameters have to be finite")

    def _refuse_to_save_nan(self) -> None:
        """
        :raises TrainingDivergedError: If a parameter or an optimizer's state is NaN or infinite
        """
        for name, state in self.get_parameters().items():
            found = self.policy.first_not_finite(state) if name == "policy" else first_not_finite(state, name)
            if found is not None:
                raise TrainingDivergedError(*found, self._n_updates)

    def export(
        self,
        path: str | os.PathLike[str],
        guided: bool | None = None,
        deterministic: bool = True,
        vec_normalize: VecNormalize | str | None = "auto",
    ) -> None:
        """
        Write what ``predict`` computes to a file that runs without this package, from the environment's observations to its
        actions: best of the candidates and guidance, normalisation of observations and scaling of actions are in it.

        :param path: The file; its suffix says of which kind: ``.onnx``, ``.pt`` (TorchScript) or ``.pt2`` (``torch.export``)
        :param guided: Whether actions are steered by the causal guidance, None for what ``predict`` does now
        :param deterministic: Whether the noise is fixed; if not, it is an input beside the observation
        :param vec_normalize: Normalises the observations in the file. ``"auto"`` is the model's environment where it is one;
            None leaves them as the policy takes them
        :raises ValueError: If the suffix is unknown, there is no guidance yet, or the policy cannot be traced
        :raises ImportError: If a package for ONNX is missing
        :raises RuntimeError: If the file gives other actions than ``predict``
        """
        self._warn_if_untrained("exported")
        normalizer = self._vec_normalize_env if isinstance(vec_normalize, str) else vec_normalize
        export_policy(self.policy, path, self.transition_variables, guided, deterministic, normalizer)

    def _warn_if_untrained(self, what: str) -> None:
        if self._n_updates == 0 and self.world_model.n_batches == 0:
            warnings.warn(f"The model has not been trained: what is {what} is the policy that it started with.", stacklevel=3)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all the attributes of the object and the model parameters in a zip-file; a file is replaced only once the new one
        is complete. What needs no pickle, which is all that is not yours, is read again without one, see :meth:`load`.

        :param path: Path to the file where the rl agent should be saved
        :param exclude: Name of parameters that should be excluded in addition to the default ones
        :param include: Name of parameters that might be excluded but should be included anyway
        :raises TrainingDivergedError: If a parameter or an optimizer's state is NaN or infinite; nothing is written then
        """
        self._refuse_to_save_nan()
        exclude, include = set(exclude or ()), set(include or ())
        without = exclude.union(self._excluded_save_params()) - include
        values = {name: value for name, value in vars(self).items() if name not in without and name not in NETWORKS}
        written, entries = plain_entries(values, self._known_classes())
        large = written.intersection(LARGE)
        archive = io.BytesIO()
        super().save(archive, exclude | large, include - large)
        append_entries(archive, entries)
        is_path = isinstance(path, str | os.PathLike)
        write_bytes(path if is_path else open_path(path, "w"), ".zip", archive.getbuffer())

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        trusted: bool = False,
        **kwargs: Any,
    ) -> SelfAlgorithm:
        """
        Load the model from a zip-file. ``load`` re-creates the model from scratch, it does not update it in-place: for that
        use ``set_parameters``.

        Nothing that the file brings is run, and what asks for very large networks, buffers or numbers of steps is refused,
        unless it is trusted. It has to be where it holds what you brought yourself, such as a schedule that is a lambda, or is
        of a version that pickled all.

        :param path: Path to the file (or a file-like) where to load the agent from
        :param env: The new environment to run the loaded model on, or its id (can be None if you only need prediction from a
            trained model)
        :param device: Device on which the code should be run
        :param custom_objects: What is taken in place of the attributes of these names, which are not read
        :param print_system_info: Whether to print system info from the saved model and the current system info
        :param force_reset: Force call to ``reset()`` before training to avoid unexpected behavior
        :param trusted: Whether the file may bring Python objects that could run code
        :param kwargs: Extra arguments to change the model when loading
        :return: The model
        :raises ValueError: If the file is not whole, or not trusted and needs to be, or does not fit the environment
        """
        if custom_objects is not None and not isinstance(custom_objects, dict):
            raise ValueError(f"custom_objects must be a dict or None, got {type(custom_objects).__name__}")
        # Wrong arguments are no fault of the file
        check_arguments(CONSTRUCTOR_ARGUMENTS, kwargs)
        given = {**(custom_objects or {}), **{name: value for name, value in kwargs.items() if name != "policy_kwargs"}}
        # SB3's constructor takes an id, and its load does not
        env = None if env is None else maybe_make_env(env, verbose=0)
        file = open_path(path, "r", suffix="zip")
        try:
            with errors_of(path, "cannot be loaded"):
                saved = read_values(file, cls._known_classes(), given, trusted, cls)
            _check_known(kwargs, saved.named)
            with errors_of(path, "cannot be loaded"):
                values = {**saved.plain, **given}
                # SB3 replaces only what its own entry names
                more = {name: value for name, value in values.items() if name in LARGE and name not in saved.named}
                more |= {name: value for name, value in FIRST_VALUES.items() if name not in saved.named}
                if "target_policy_noise" not in saved.named:
                    more["_has_first_defaults"] = True
                if "exploration_optimism" not in saved.named:
                    more["_has_first_acting"] = True
                model = super().load(
                    file,
                    env,
                    device,
                    custom_objects=values,
                    print_system_info=print_system_info,
                    force_reset=force_reset,
                    **{**more, **kwargs},
                )
                if not trusted:
                    model._check_loaded()
                return model
        finally:
            if file is not path:
                file.close()

    def _check_loaded(self) -> None:
        """
        :raises ValueError: If what a file says of the causal structure is something else, or not about this model
        """
        if not isinstance(self.causal_graph_history, list):
            raise ValueError(f"causal_graph_history must be a list, got {type(self.causal_graph_history).__name__}")
        for graph in (self._causal_graph, *self.causal_graph_history):
            if graph is not None and getattr(graph, "variables", None) != self.transition_variables:
                raise ValueError(f"its causal graph is of other variables: {str(graph)[:80]}")
        statistics = self.causal_statistics
        fresh = self._new_statistics()
        of_same = all(getattr(statistics, name, None) == getattr(fresh, name, None) for name in ("variables", "n_variables"))
        if type(statistics) is not type(fresh) or not of_same:
            raise ValueError(
                f"causal_statistics must be {type(fresh).__name__} of the model's variables, got {str(statistics)[:80]}"
            )

    @classmethod
    def _known_classes(cls) -> Known:
        """What a file may name."""
        return KNOWN + Known([], {*cls.policy_aliases.values(), CausalGDPPolicy, CnnPolicy, MultiInputPolicy})

    def save_checkpoint(self, path: str | pathlib.Path, callback: BaseCallback | None = None) -> pathlib.Path:
        """
        Write all that the training is in one piece: weights, optimizers, replay buffer and preloaded transitions, statistics,
        graphs, counters, random number generators, and the state of the environment. :meth:`resume` goes on from it, bit for
        bit where it was written between two rollouts, as :class:`~sb3_causalgdp.TrainingCheckpointCallback` does.

        :param path: A folder, to which only new transitions are added, or a file with the suffix ``.zip``
        :param callback: The callbacks of the training, to save what they counted
        :return: The file, or the checkpoint's folder inside the folder
        :raises ValueError: If the folder holds checkpoints of another training
        """
        return save_checkpoint(self, path, callback)

    @classmethod
    def resume(
        cls: type[SelfAlgorithm],
        path: str | pathlib.Path,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        trusted: bool = False,
    ) -> SelfAlgorithm:
        """
        Make the model of an interrupted training, with its replay buffer and the state of its environment, from the newest
        whole checkpoint. ``model.learn(model.remaining_timesteps, reset_num_timesteps=False)`` does the rest.

        :param path: Folder of checkpoints, one of them, or a zip file
        :param env: Environment that is made as the first one was, or its id; None where :meth:`pretrain` goes on
        :param device: Device on which the code should be run
        :param trusted: Whether the files may name Python objects that could run code
        :return: The model
        :raises FileNotFoundError: If there is no checkpoint
        :raises ValueError: If none is whole, or the environment is another one
        """
        model = resume(cls, path, env, device, trusted)
        stage = bookkeeping_of(model)
        if stage.of_pretraining and not stage.was_complete:
            model._resumed_at_gradient_step = model.n_pretrain_steps
        return model

    @property
    def remaining_timesteps(self) -> int:
        """Environment steps that ``learn()`` was to take and has not taken yet."""
        return max(0, self._total_timesteps - self.num_timesteps)

    def learn(
        self: SelfAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfAlgorithm:
        n_restores = 0
        while True:
            try:
                return super().learn(
                    total_timesteps=total_timesteps,
                    callback=callback,
                    log_interval=log_interval,
                    tb_log_name=tb_log_name,
                    reset_num_timesteps=reset_num_timesteps,
                    progress_bar=progress_bar,
                )
            except TrainingDivergedError as error:
                if n_restores == self.MOST_RESTORES or not self._restore_checkpoint(callback, error):
                    raise
                n_restores += 1
                total_timesteps, reset_num_timesteps = self.remaining_timesteps, False

    def _restore_checkpoint(self, callback: MaybeCallback, error: TrainingDivergedError) -> bool:
        """After a divergence, go back to the newest checkpoint of a callback that is told to; whether there is one."""
        wanted = (one for top in callback_list(callback) for one in all_callbacks(top))
        folders = [
            one.folder for one in wanted if isinstance(one, TrainingCheckpointCallback) and one.on_divergence == "restore"
        ]
        try:
            restored = [type(self).resume(folder, self.env, self.device) for folder in folders[:1]]
        except FileNotFoundError:
            restored = []
        if not restored:
            return False
        logger = self._logger
        vars(self).update(vars(restored[0]))
        self._logger = logger
        # They were made for the other object
        self._updates = type(self._updates)(self)
        # The same ones would lead to the same end
        self.set_random_seed(int(np.random.SeedSequence().generate_state(1)[0] >> 1))
        warnings.warn(f"{error} It goes on from {folders[0]} after {self.num_timesteps} steps, with other random numbers.")
        return True


def _check_known(kwargs: Iterable[str], named: Collection[str]) -> None:
    """A misspelt argument would become an attribute that nothing reads."""
    known = {*CONSTRUCTOR_ARGUMENTS, *named, *LARGE}
    for name in kwargs:
        if name in POLICY_ARGUMENTS and name not in known:
            raise TypeError(f"load() got {name!r}, an argument of the policy: those are chosen when the model is made")
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f", did you mean {close[0]!r}?" if close else ""
            raise TypeError(f"load() got an unexpected keyword argument {name!r}{hint}")
