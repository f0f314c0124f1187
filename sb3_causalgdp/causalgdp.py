"""CausalGDP: what happens when."""

import io
import math
import pathlib
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from copy import deepcopy
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.save_util import load_from_zip_file, open_path, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, get_parameters_by_name, polyak_update, update_learning_rate

from sb3_causalgdp.acceleration.cuda_graphs import UpdateGraphs, why_not_recorded
from sb3_causalgdp.acceleration.device_replay import DeviceReplay
from sb3_causalgdp.acceleration.gradients import Gradients, check_compile, compiled, gradients_of, without_checks
from sb3_causalgdp.arguments import (
    CONSTRUCTOR_ARGUMENTS,
    POLICY_ARGUMENTS,
    check_action_space,
    check_arguments,
    check_keywords,
    counts_episodes,
)
from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.causal import (
    ActionEffects,
    CausalGraph,
    Counterfactual,
    InterventionalDistribution,
    Statistics,
    StructuralModel,
    TransitionVariables,
    make_discovery,
    make_statistics,
)
from sb3_causalgdp.causal.interventions import ActionRule
from sb3_causalgdp.causal.world_model import MaskedWorldModel, moves
from sb3_causalgdp.checkpoints import TrainingCheckpointCallback, begin_training, resume, save_checkpoint
from sb3_causalgdp.checkpoints.checkpoint import all_callbacks, bookkeeping_of, end_last_episodes, fresh_seed
from sb3_causalgdp.checks import first_not_finite_index, fits_float32, is_finite
from sb3_causalgdp.divergence import ParametersError, TrainingDivergedError, check_optimizer_state, first_not_finite
from sb3_causalgdp.files import saved_when_done
from sb3_causalgdp.losses import DenoisingTerms, critic_loss, denoising_loss, q_loss, quantile, td_target, world_model_loss
from sb3_causalgdp.offline.algorithm import OfflineToOnlineAlgorithm, callback_list
from sb3_causalgdp.offline.preload import normalised_parts
from sb3_causalgdp.offline.replay import concatenate_samples, deal_rows, rows_of
from sb3_causalgdp.policies import CausalGDPPolicy, CnnPolicy, DiffusionActor, MlpPolicy, MultiInputPolicy, q_values
from sb3_causalgdp.saving.archives import errors_of
from sb3_causalgdp.saving.models import KNOWN, LARGE, append_entries, plain_entries, read_values
from sb3_causalgdp.saving.plain import Known
from sb3_causalgdp.structural import StatePolicy, actions_of, make_structural_model, states_of

NETWORKS = ("policy", "actor", "critic", "world_model")
COMPILED = ("_td_target", "_critic_gradients", "_world_model_gradients", "_actor_gradients")

SelfCausalGDP = TypeVar("SelfCausalGDP", bound="CausalGDP")


class StepPlan(NamedTuple):
    """What one gradient step does beside updating the critics."""

    trains_world_model: bool
    trains_actor: bool
    guided: bool
    """Whether the denoising term is steered."""
    climbed: int
    """The critic whose value the actor climbs."""
    running_weight: float
    """Share of the batch's statistics that enters the running ones."""

    @property
    def trains_others(self) -> bool:
        """Whether it trains more than the critics."""
        return self.trains_world_model or self.trains_actor


class CausalGDP(OfflineToOnlineAlgorithm):
    """
    Causality-Guided Diffusion Policy (CausalGDP).

    Paper: "CausalGDP: Causality-Guided Diffusion Policies for Reinforcement Learning" (Xiao, Hu, Ye and Yue). The actor, its
    loss and the critics are those of Diffusion-QL (https://arxiv.org/abs/2208.06193); without guidance
    (``guidance=None`` or ``guidance_scale=0``) and with ``actor_update="chain"`` the algorithm is Diffusion-QL.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gymnasium, can be str); actions must be a bounded Box
    :param learning_rate: Learning rate of the actor, and of the critics unless ``critic_learning_rate`` is given; it can be a
        function of the current progress remaining (from 1 to 0)
    :param buffer_size: Size of the replay buffer
    :param learning_starts: How many steps of the model to collect transitions for before learning starts, with random actions
        or, after :meth:`pretrain`, the policy's
    :param batch_size: Minibatch size for each gradient update
    :param tau: The soft update coefficient ("Polyak update", between 0 and 1) of the target critics and of the actor's moving
        average
    :param gamma: The discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: The action noise type (None by default), on top of ``exploration_noise``
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``).
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer at a cost of more complexity.
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the Q-value network; the
        world model still learns from single steps.
    :param critic_learning_rate: Learning rate of the critics, a number or a schedule; None takes ``learning_rate``
    :param world_model_learning_rate: Learning rate of the world model, a number or a schedule
    :param eta: Weight of the Q term in the policy loss (the paper's table: 0.005 to 5)
    :param denoising_weight: Weight of the denoising term in the policy loss: 1 is Diffusion-QL's, for fixed datasets; online,
        where it pulls towards the actions of older policies, it has to be small
    :param actor_update: Which action the Q term of the policy loss judges. ``one_step``: the clean action that the noise
        prediction of the denoising term gives already (EDP, https://arxiv.org/abs/2305.20081), half the cost of an update;
        ``chain``: the end of the whole chain, through which the gradient then flows (Diffusion-QL)
    :param q_scale: What the Q term is divided by. ``value``: by the mean absolute Q (Diffusion-QL), which grows with the
        returns; ``advantage``: by how much the Q of the policy's actions differs from that of the replayed ones, in the mean
    :param bound_penalty: Weight, in the policy loss, of the mean squared distance of clean actions from [-1, 1] before they
        are clipped, so that none goes so far that it finds no way back
    :param policy_delay: The actor is updated once every so many gradient steps, as in TD3. Where a call of :meth:`train` makes
        many steps, the TD targets of those from one update of the actor to the next are computed at once
    :param world_model_delay: The world model is updated once every so many gradient steps
    :param max_q_backup: Whether the TD target takes the best of ten sampled actions (Diffusion-QL, for AntMaze)
    :param max_grad_norm: Bound of the gradient norms of the actor and of the critics, None for no bound
    :param diffusion_steps: Number of diffusion steps K
    :param noise_schedule: ``vp`` (Diffusion-QL), ``linear`` (DDPM) or ``cosine``
    :param sampler: ``ddpm``, ``ddim``, ``euler_maruyama``, ``heun`` or ``dpm_solver``
    :param ddim_eta: Noise of DDIM, from 0 (deterministic) to 1 (DDPM)
    :param n_action_candidates: Number of sampled actions of which a prediction takes the best by the smallest target Q
    :param exploration_noise: Standard deviation of the Gaussian noise of non-deterministic predictions, for actions in [-1, 1]
    :param guidance: ``posterior`` (the gradient of log p(y | a^k), with the uncertainty of the clean action in it), ``score``
        (the paper's plain gradient), ``normalized`` (unit length), or None
    :param guidance_target: What is wished for: ``return`` (one standard deviation of Q more than predicted) or ``reward`` (r*,
        the running 0.99 quantile of the rewards)
    :param guidance_covariance: ``tweedie``, ``isotropic`` or ``unit_gaussian``, for ``guidance="posterior"``
    :param guidance_scale: lambda_k: one number, or one for each diffusion step from k = 1 to K
    :param state_guidance_scale: gamma_t of the paper, scales the precision of the next state
    :param outcome_guidance_scale: beta_t of the paper, scales the precision of the reward or return
    :param causal_discovery: Name of the discovery method, a key of ``sb3_causalgdp.causal.DISCOVERY_METHODS``: ``partial_r2``
        also finds what is nonlinear, ``notears`` is the paper's linear method; or a callable like
        :class:`~sb3_causalgdp.causal.discovery.DiscoveryMethod`
    :param causal_discovery_kwargs: Arguments of the named discovery method
    :param causal_refresh_freq: Rediscover the graph and rewrite the masks every so many environment steps
    :param causal_half_life: Half-life, in transitions, of the statistics from which the graph is found; None forgets nothing
    :param causal_window: Number of newest transitions from which the graph is found (the paper's temporal window); None takes
        all
    :param sample_masks: How the world model trains on its masks. True: as probabilities, which edges are there is drawn anew
        for each batch, so that an improbable edge carries little. False: as factors of the inputs, which what is learned
        behind them makes up for unless they are 0
    :param offline_dataset: Id of a Minari dataset, or path of a saved replay buffer or of arrays, that is preloaded when
        training starts and no transitions are there; so a loaded model, whose buffer is empty, loads it again
    :param pretrain_steps: Gradient steps of :meth:`pretrain` before the first step of ``learn()``; those that were made
        before count, so that an interrupted run does the rest
    :param offline_fraction: Share of a batch that comes from preloaded transitions once ``learn()`` has collected others
        (symmetric sampling of RLPD, https://arxiv.org/abs/2302.02948); it can be a function of the current progress remaining
        (from 1 to 0)
    :param reward_transform: What is done to the rewards of preloaded transitions, and then to the environment's too: a key of
        :data:`~sb3_causalgdp.offline.rewards.REWARD_TRANSFORMS`; only a model with preloaded transitions transforms them
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments to be passed to the policy on creation, see
        :class:`~sb3_causalgdp.policies.CausalGDPPolicy`
    :param compile: Whether to compile with ``torch.compile``, or its ``mode``: one graph for the loss and the gradients of
        each network, with the world model and the guidance in it. The first updates then take a minute or two; the numbers
        are the same up to rounding. Saved models do not depend on it. Needs PyTorch 2.13 and, on a CPU, a C++ compiler
    :param cuda_graph: Whether gradient steps behind the first hundred are recorded as CUDA graphs and replayed, with
        ``compile`` or without: on a GPU the launches of their kernels, and not their work, are what takes time. The numbers
        are those of the plain steps. ``"auto"`` is True on a GPU, unless an optimizer cannot be recorded or ``compile`` makes
        CUDA graphs itself
    :param torch_threads: PyTorch's number of CPU threads during updates; None leaves it as it is. ``"auto"`` is 1 where
        observations are vectors, whose networks are so small that threads only wait for each other, and otherwise None
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for debug
        messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: CausalGDPPolicy
    actor: DiffusionActor
    actor_target: DiffusionActor
    critic: ContinuousCritic
    critic_target: ContinuousCritic
    world_model: MaskedWorldModel

    # Share of a batch's statistic that enters the running reward quantile and the running standard deviation of Q
    RUNNING_WEIGHT = 0.01
    REWARD_QUANTILE = 0.99
    N_BACKUP_ACTIONS = 10
    GRAPHS_IN_HISTORY = 32
    MOST_ROWS_PER_DRAW = 16_384
    MOST_RESTORES = 3

    def __init__(
        self,
        policy: str | type[CausalGDPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        critic_learning_rate: float | Schedule | None = None,
        world_model_learning_rate: float | Schedule = 1e-3,
        eta: float = 1.0,
        denoising_weight: float = 0.05,
        actor_update: str = "one_step",
        q_scale: str = "value",
        bound_penalty: float = 0.1,
        policy_delay: int = 2,
        world_model_delay: int = 2,
        max_q_backup: bool = False,
        max_grad_norm: float | None = None,
        diffusion_steps: int = 5,
        noise_schedule: str = "vp",
        sampler: str = "ddpm",
        ddim_eta: float = 0.0,
        n_action_candidates: int = 10,
        exploration_noise: float = 0.2,
        guidance: str | None = "posterior",
        guidance_target: str = "return",
        guidance_covariance: str = "unit_gaussian",
        guidance_scale: float | Sequence[float] = 1.0,
        state_guidance_scale: float = 0.01,
        outcome_guidance_scale: float = 1.0,
        causal_discovery: str | Callable[..., CausalGraph] = "partial_r2",
        causal_discovery_kwargs: dict[str, Any] | None = None,
        causal_refresh_freq: int = 1_000,
        causal_half_life: float | None = None,
        causal_window: int | None = None,
        sample_masks: bool = True,
        offline_dataset: str | None = None,
        pretrain_steps: int = 0,
        offline_fraction: float | Schedule = 0.5,
        reward_transform: str = "none",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        compile: bool | str = False,
        cuda_graph: bool | str = "auto",
        torch_threads: int | str | None = "auto",
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        # SB3 keeps them, and looks at them late or not at all
        check_arguments(CONSTRUCTOR_ARGUMENTS, locals())
        if isinstance(policy, str) and policy not in self.policy_aliases:
            raise ValueError(f"policy must be one of {list(self.policy_aliases)} or a class, got {policy!r}, which is unknown")
        if env is None and _init_setup_model:
            raise ValueError("env must be an id or an environment, got None: from_dataset() needs none")
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
            offline_dataset=offline_dataset,
            pretrain_steps=pretrain_steps,
            offline_fraction=offline_fraction,
            reward_transform=reward_transform,
        )
        self.critic_learning_rate = critic_learning_rate
        self.world_model_learning_rate = world_model_learning_rate
        self.eta = eta
        self.denoising_weight = denoising_weight
        self.actor_update = actor_update
        self.q_scale = q_scale
        self.bound_penalty = bound_penalty
        self.policy_delay = policy_delay
        self.world_model_delay = world_model_delay
        self.max_q_backup = max_q_backup
        self.max_grad_norm = max_grad_norm
        self.diffusion_steps = diffusion_steps
        self.noise_schedule = noise_schedule
        self.sampler = sampler
        self.ddim_eta = ddim_eta
        self.n_action_candidates = n_action_candidates
        self.exploration_noise = exploration_noise
        self.guidance = guidance
        self.guidance_target = guidance_target
        self.guidance_covariance = guidance_covariance
        self.guidance_scale = guidance_scale
        self.state_guidance_scale = state_guidance_scale
        self.outcome_guidance_scale = outcome_guidance_scale
        self.causal_discovery = causal_discovery
        self.causal_discovery_kwargs = causal_discovery_kwargs or {}
        self.causal_refresh_freq = causal_refresh_freq
        self.causal_half_life = causal_half_life
        self.causal_window = causal_window
        self.sample_masks = sample_masks
        self.compile = compile
        self.cuda_graph = cuda_graph
        self.torch_threads = torch_threads
        # What is known of the causal structure, saved with the model
        self.causal_statistics: Statistics | None = None
        self._statistics_made_by: list[Any] | None = None
        self._causal_graph: CausalGraph | None = None
        self.causal_graph_history: list[CausalGraph] = []
        self._steps_since_refresh = 0
        # Positions of the replay buffer that were ever written, and how many of them the statistics have seen
        self._stored_position = 0
        self._fed_position = 0
        # The same of the preloaded transitions, and which these were
        self._fed_offline_position = 0
        self._fed_marks: list[str] = []
        self._device_replays: dict[str, tuple[ReplayBuffer, DeviceReplay | None]] = {}
        self._resumed_at_gradient_step: int | None = None

        check_compile(self.compile, self.device)
        if _init_setup_model:
            self._setup_model()
            self._check_cuda_graph()

    def _setup_model(self) -> None:
        self._check_arguments()
        policy_kwargs = self.policy_kwargs
        # The policy gets our arguments too, but they must not enter the user's own dictionary
        self.policy_kwargs = {**self._own_policy_kwargs(), **policy_kwargs, **check_arguments(POLICY_ARGUMENTS, policy_kwargs)}
        try:
            super()._setup_model()
        except MemoryError as error:
            raise ValueError(f"buffer_size={self.buffer_size} does not fit into memory: {error}") from error
        finally:
            self.policy_kwargs = policy_kwargs
        if self.num_timesteps > 0 and self.seed is not None:
            # A loaded model would live through the random numbers and start states of its first steps again
            self.set_random_seed(fresh_seed(self))
        self._create_aliases()
        self._setup_compile()
        self._setup_cuda_graphs()
        self._setup_discovery()
        # Running mean and running var
        self.actor_batch_norm_stats = get_parameters_by_name(self.actor, ["running_"])
        self.critic_batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.actor_batch_norm_stats_target = get_parameters_by_name(self.actor_target, ["running_"])
        self.critic_batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])

    def _setup_compile(self) -> None:
        for name in COMPILED:
            function = getattr(type(self), name).__get__(self)
            setattr(self, name, compiled(function, self.compile, self.device) if self.compile else function)

    def _setup_cuda_graphs(self) -> None:
        recorded = self.cuda_graph and self._why_not_recorded() is None
        self._update_graphs = UpdateGraphs(self._optimizers()) if recorded else None

    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [_optimizer_of(module) for module in (self.actor, self.critic, self.world_model)]

    def _why_not_recorded(self) -> str | None:
        return why_not_recorded(self.device, self.compile, self._optimizers())

    def _check_cuda_graph(self) -> None:
        reason = self._why_not_recorded() if self.cuda_graph is True else None
        if reason is not None:
            raise ValueError(reason)

    def _setup_discovery(self) -> None:
        try:
            self.discovery = make_discovery(self.causal_discovery, **self.causal_discovery_kwargs)
        except (TypeError, ValueError) as error:
            raise ValueError(f"causal_discovery_kwargs: {error}") from error
        action_names = tuple(f"action[{index}]" for index in range(self.actor.action_dim))
        self.transition_variables = TransitionVariables(self.policy.state_names(), action_names)
        method = self.causal_discovery
        # A callable that was saved is not the same object when it is loaded
        name = method if isinstance(method, str) else getattr(method, "__qualname__", type(method).__qualname__)
        forgetting = (self.causal_half_life, self.causal_window)
        made_by = [name, self.causal_discovery_kwargs, *forgetting]  # a list, as it comes back from the zip
        if self.causal_statistics is None or self._statistics_made_by != made_by:
            # Another method, which load() may have brought, gathers anew from the replay buffer
            self.causal_statistics = self._new_statistics()
            self._statistics_made_by = made_by
            self._fed_position = self._fed_offline_position = 0
            self._fed_marks = []

    def _check_arguments(self) -> None:
        """Those that are attributes by now, perhaps brought by ``load()``, which become what is to be stored."""
        attributes = {"stats_window_size": "_stats_window_size"}
        names = {name: attributes.get(name, name) for name in CONSTRUCTOR_ARGUMENTS if name not in ("policy", "env", "device")}
        given = {name: getattr(self, attribute) for name, attribute in names.items() if hasattr(self, attribute)}
        for name, value in check_arguments(CONSTRUCTOR_ARGUMENTS, given).items():
            if value is not given[name]:
                setattr(self, names[name], value)
        if not issubclass(self.policy_class, CausalGDPPolicy):
            raise ValueError(f"policy must be a subclass of CausalGDPPolicy, got {self.policy_class.__name__}")
        check_keywords("policy_kwargs", self.policy_kwargs, self.policy_class)
        check_action_space(self.action_space)
        self._check_together()

    def _check_together(self) -> None:
        """Arguments that are right alone, and not with the others."""
        n_positions = self.buffer_size // self.n_envs
        if counts_episodes(self.train_freq) and self.n_envs > 1:
            raise ValueError(f"train_freq must be in steps with {self.n_envs} environments, got {self.train_freq!r}")
        if self.replay_buffer_class is None and self.n_steps > 1:
            if isinstance(self.observation_space, spaces.Dict) or self.optimize_memory_usage:
                what = "optimize_memory_usage" if self.optimize_memory_usage else "a Dict of observations"
                raise ValueError(f"n_steps must be 1 with {what}, got {self.n_steps}")
            if self.n_steps > n_positions:
                raise ValueError(f"n_steps must be at most {n_positions}, buffer_size / n_envs, got {self.n_steps}")
        if self.optimize_memory_usage and n_positions < 2:
            raise ValueError(f"buffer_size must be at least 2 n_envs with optimize_memory_usage, got {self.buffer_size}")
        if self.replay_buffer_class is not None or self.n_steps == 1:
            check_keywords("replay_buffer_kwargs", self.replay_buffer_kwargs, self.replay_buffer_class or ReplayBuffer)

    def _new_statistics(self) -> Statistics:
        try:
            return make_statistics(self.discovery, self.transition_variables, self.causal_half_life, self.causal_window)
        except ValueError as error:
            raise ValueError(f"causal_half_life and causal_window: {error}") from error

    def _own_policy_kwargs(self) -> dict[str, Any]:
        names = (
            "diffusion_steps noise_schedule sampler ddim_eta n_action_candidates exploration_noise guidance guidance_target "
            "guidance_covariance guidance_scale state_guidance_scale outcome_guidance_scale"
        ).split()
        return {**{name: getattr(self, name) for name in names}, "discount": self.gamma}

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target
        self.world_model = self.policy.world_model
        networks = (self.actor, self.actor_target, self.critic, self.critic_target, self.world_model)
        # Once, because to visit all modules takes a hundredth of a gradient step
        self._parameters: dict[th.nn.Module, list[th.Tensor]] = {network: [*network.parameters()] for network in networks}

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        rate = self.critic_learning_rate
        self.critic_lr_schedule = None if rate is None else FloatSchedule(rate)
        self.world_model_lr_schedule = FloatSchedule(self.world_model_learning_rate)

    def _update_learning_rates(self) -> None:
        self._update_learning_rate(self.actor.optimizer)
        progress = self._current_progress_remaining
        critic_lr_schedule = self.critic_lr_schedule or self.lr_schedule
        update_learning_rate(self.critic.optimizer, critic_lr_schedule(progress))
        update_learning_rate(_optimizer_of(self.world_model), self.world_model_lr_schedule(progress))

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Again, for models that were loaded: those that are not trained need no compiler and no GPU
        check_compile(self.compile, self.device)
        self._check_cuda_graph()
        callbacks = callback_list(callback)
        n_own = sum(isinstance(one, CausalWorldModelCallback) for top in callbacks for one in all_callbacks(top))
        if n_own > 1:
            raise ValueError(f"At most one CausalWorldModelCallback can be passed, got {n_own}")
        if n_own == 0:
            # In front of the others, so that evaluations and checkpoints see the new masks
            callbacks = [CausalWorldModelCallback(), *callbacks]
        # Behind the others, which have then counted the step that a checkpoint of pretrain() is about
        callbacks = sorted(callbacks, key=lambda one: isinstance(one, TrainingCheckpointCallback))
        all_of_them = super()._init_callback(CallbackList(callbacks), progress_bar)
        begin_training(self, all_of_them)
        return all_of_them

    def causal_graph(self) -> CausalGraph:
        """
        :return: What causes what, as last discovered; every edge is open before the first discovery
        """
        return self._causal_graph or CausalGraph.fully_connected(self.transition_variables)

    def set_causal_graph(self, graph: CausalGraph) -> None:
        """
        Write a causal graph into the masks of the world model and let it steer the sampling. The graphs of up to 32 moments of
        the training are in ``causal_graph_history``, saved on request: ``save(path, include=["causal_graph_history"])``.

        :param graph: The graph, on this model's variables
        :raises ValueError: If the graph is about other variables
        """
        if graph.variables != self.transition_variables:
            raise ValueError(
                f"The graph is about {graph.variables.names}, but this model's variables are {self.transition_variables.names}"
            )
        arrays = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
        masks = [th.as_tensor(mask, dtype=th.float32, device=self.device) for mask in arrays]
        self.world_model.set_masks(*masks)
        self.policy.set_attention(masks)
        self.policy.guidance_ready.fill_(1.0)
        self._causal_graph = graph
        self.causal_graph_history.append(graph)
        if len(self.causal_graph_history) > self.GRAPHS_IN_HISTORY:
            # Every second one goes, so that what is left spans the whole training; the newest stays
            self.causal_graph_history = self.causal_graph_history[::-2][::-1]

    def structural_model(self) -> StructuralModel:
        """
        The world model as a structural causal model in the environment's own units, on which interventions, effects and
        counterfactuals are computed.

        With ``VecNormalize``, set its environment first (``set_env``): the model's statistics are read from it.

        :return: The structural model; later training changes its answers
        :raises RuntimeError: If the world model has not been trained
        """
        return make_structural_model(self.policy, self.transition_variables, self._vec_normalize_env)

    def intervene(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        action: npt.ArrayLike,
        interventions: Mapping[str, npt.ArrayLike],
        n_samples: int | None = None,
    ) -> InterventionalDistribution:
        """
        The distribution of the next state and of the reward under do(...), like
        ``model.intervene(obs, action, {"action[0]": 0.5, "obs[3]'": 1.0})``.

        :param observation: One observation or a batch, as the environment gives it: not normalised by ``VecNormalize``
        :param action: The action of each, within the bounds of the action space
        :param interventions: Values by name (see ``model.transition_variables.names``), in the environment's units
        :param n_samples: Samples of the next state for the reward's uncertainty, None for the delta method
        :return: See :meth:`~sb3_causalgdp.causal.StructuralModel.intervene`
        """
        model = self.structural_model()
        return model.intervene(self._states_of(observation), actions_of(self.policy, action), interventions, n_samples)

    def effect_of_actions(
        self,
        observations: np.ndarray | dict[str, np.ndarray],
        actions: npt.ArrayLike,
        delta: npt.ArrayLike | None = None,
    ) -> ActionEffects:
        """
        How strongly each action component moves the reward, direct and through the next state, and each next state variable.

        :param observations: A batch of observations, as the environment gives them: not normalised by ``VecNormalize``
        :param actions: The action of each, within the bounds of the action space
        :param delta: Change of the action, in the environment's units; None for the derivative
        :return: Averages over the observations, see :meth:`~sb3_causalgdp.causal.StructuralModel.effect_of_actions`
        """
        model = self.structural_model()
        return model.effect_of_actions(self._states_of(observations), actions_of(self.policy, actions), delta)

    def counterfactual(
        self,
        trajectory: tuple[Any, npt.ArrayLike, npt.ArrayLike],
        changes: Mapping[str, npt.ArrayLike | ActionRule],
        follow_policy: bool = False,
    ) -> Counterfactual:
        """
        What would have happened in a recorded episode had other actions been taken, under the same noise, like
        ``model.counterfactual((observations, actions, rewards), {"action[0]": 0.0})``.

        :param trajectory: T + 1 observations, T actions and T rewards of one episode, as the environment gives them: not
            normalised by ``VecNormalize``
        :param changes: For each changed action component a number, T values or a function, see
            :meth:`~sb3_causalgdp.causal.StructuralModel.counterfactual`
        :param follow_policy: Whether this model's policy reacts to the counterfactual states with the components that are not
            changed, its deviation from the recorded actions being replayed; by default they stay as recorded
        :return: States, actions, rewards and noise, in the environment's units
        """
        model = self.structural_model()
        observations, actions, rewards = trajectory
        recorded = (self._states_of(observations), actions_of(self.policy, actions), rewards)
        policy = StatePolicy(self.policy, self._vec_normalize_env) if follow_policy else None
        return model.counterfactual(recorded, changes, policy)

    def _states_of(self, observation: Any) -> np.ndarray:
        return states_of(self.policy, observation, self._vec_normalize_env)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        if self._waits_for_episode():
            return
        self._trained_normalised = normalised_parts(self._vec_normalize_env)
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        with _threads(self._n_threads()):
            losses = self._gradient_steps(gradient_steps, batch_size)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if losses:
            self._log_losses(losses)

    def _log_losses(self, losses: list[tuple[list[str], th.Tensor]]) -> None:
        names = [name for step_names, _ in losses for name in step_names]
        # One transfer from the device for all of them
        values = th.cat([step_values for _, step_values in losses]).tolist()
        if not math.isfinite(sum(values)):
            self._check_losses(list(zip(names, values, strict=True)))
        by_name: dict[str, list[float]] = {name: [] for name in names}
        for name, value in zip(names, values, strict=True):
            by_name[name].append(value)
        for name, of_steps in by_name.items():
            self.logger.record(f"train/{name}", sum(of_steps) / len(of_steps))

    def _check_losses(self, losses: list[tuple[str, float]]) -> None:
        """
        :param losses: Of each step, with their names; each step has one of the critics
        :raises TrainingDivergedError: With the first that is NaN or infinite
        """
        last = self._n_updates
        first = last - sum(name == "critic_loss" for name, _ in losses) + 1
        delays = {"critic_loss": 1, "world_model_transition_loss": self.world_model_delay}
        delays["world_model_reward_loss"] = self.world_model_delay
        steps: dict[str, Iterator[int]] = {}
        found = []
        for place, (name, value) in enumerate(losses):
            delay = delays.get(name, self.policy_delay)
            step = next(steps.setdefault(name, (step for step in range(first, last + 1) if step % delay == 0)))
            if not math.isfinite(value):
                found.append((step, place, name, value))
        if found:
            step, _, name, value = min(found)
            raise TrainingDivergedError(name, value, step)

    def _gradient_steps(self, gradient_steps: int, batch_size: int) -> list[tuple[list[str], th.Tensor]]:
        """The losses of each step, their names and their values."""
        losses: list[tuple[list[str], th.Tensor]] = []
        known_kinds: set[Hashable] = set()
        guided = self.policy.is_guided  # once, because a GPU has to be waited for
        if self._update_graphs is not None:
            self._update_graphs.update_learning_rates()
        for n_steps, replay_data in self._batches(gradient_steps, batch_size):
            plans = tuple(self._next_plan(guided) for _ in range(n_steps))
            batches = [replay_data]
            if isinstance(self.replay_buffer, NStepReplayBuffer):
                batches += [self._sample(batch_size, one_step=True) for plan in plans if plan.trains_others]
            # What compiled graphs depend on does not change within this call, so that one look at it is enough; the weights of
            # running averages are outside of them
            kind = tuple(plan._replace(running_weight=0.0) for plan in plans)
            looked_at = kind in known_kinds and self._update_graphs is None
            with without_checks() if self.compile and looked_at else nullcontext():
                losses_of_steps = self._run_gradient_steps(plans, batches)
            known_kinds.add(kind)
            names = [name for name, values in losses_of_steps.items() for _ in values]
            # A copy, because the next steps may overwrite them
            losses.append((names, th.cat(list(losses_of_steps.values()))))
        return losses

    def _next_plan(self, guided: bool) -> StepPlan:
        self._n_updates += 1
        trains_actor = self._n_updates % self.policy_delay == 0
        return StepPlan(
            trains_world_model=self._n_updates % self.world_model_delay == 0,
            trains_actor=trains_actor,
            guided=guided,
            climbed=int(np.random.randint(len(self.critic.q_networks))) if trains_actor else 0,
            # The first batches are averaged, so that the start value is forgotten at once
            running_weight=max(1.0 / self._n_updates, self.RUNNING_WEIGHT),
        )

    def _run_gradient_steps(self, plans: tuple[StepPlan, ...], batches: list[Any]) -> dict[str, th.Tensor]:
        if self._update_graphs is None:
            return self._steps_up_to_actor_update(plans, *batches)
        # All that the steps depend on and that may change while it trains
        weights = (self.eta, self.denoising_weight, self.bound_penalty, self.q_scale, self.tau, self.gamma, self.max_grad_norm)
        scales = (self.policy.state_guidance_scale, self.policy.outcome_guidance_scale)
        kind = (plans, weights, scales, len(batches[0].rewards))
        return self._update_graphs.run(kind, partial(self._steps_up_to_actor_update, plans), batches)

    def _steps_up_to_actor_update(self, plans: Sequence[StepPlan], replay_data: Any, *one_step: Any) -> dict[str, th.Tensor]:
        """
        Gradient steps of which only the last may train the actor. The TD targets of all are computed at once, with the target
        networks as they are before the first.

        :param plans: What each step updates
        :param replay_data: Batches of the critics, one behind the other, and of the others unless they have their own
        :param one_step: A batch for each step that trains more than the critics, where returns are of several steps
        :return: Losses by name, one for each step that has it
        """
        if self.compile:
            # What a CUDA graph returned is overwritten from here on
            th.compiler.cudagraph_mark_step_begin()
        # The critics and the world model know nothing of each other
        beside_critics = nullcontext if self._update_graphs is None else self._update_graphs.branch()
        next_actions, target = self._td_target(replay_data)
        batch_size = len(target) // len(plans)
        of_others = iter(one_step)
        losses: dict[str, list[th.Tensor]] = {}
        for index, plan in enumerate(plans):
            rows = slice(index * batch_size, (index + 1) * batch_size)
            own = next(of_others, None) if plan.trains_others else None
            of_critics = rows_of(replay_data, rows), next_actions[rows], target[rows]
            for name, loss in self._gradient_step(plan, *of_critics, own, beside_critics).items():
                losses.setdefault(name, []).append(loss)
        return {name: th.stack(values) for name, values in losses.items()}

    def _gradient_step(
        self,
        plan: StepPlan,
        replay_data: Any,
        next_actions: th.Tensor,
        target: th.Tensor,
        one_step: Any,
        beside_critics: Callable[[], AbstractContextManager[None]],
    ) -> dict[str, th.Tensor]:
        """
        :param plan: What is updated
        :param replay_data: Batch of the critics, and of the others unless they have their own
        :param next_actions: Of the actor's moving average in the next states, shape ``(batch, d)``
        :param target: TD target, shape ``(batch, 1)``
        :param one_step: Batch of the world model and the actor where returns are of several steps, else None
        :param beside_critics: Makes the context in which the world model is updated
        :return: Losses by name
        """
        losses = self._update_critics(replay_data, target, plan.running_weight)
        transitions = replay_data if one_step is None else one_step
        if plan.trains_world_model:
            with beside_critics():
                losses.update(self._update_world_model(transitions, plan.running_weight))
        if plan.trains_actor:
            if one_step is not None:
                with th.no_grad():
                    next_actions = self.actor_target.sample(self.actor_target.features(one_step.next_observations))
            losses.update(self._update_actor(transitions, next_actions, plan))
        self._update_targets()
        return losses

    def _n_threads(self) -> int | None:
        if self.torch_threads != "auto":
            return self.torch_threads  # type: ignore[return-value]
        return None if self.policy.has_image_state else 1

    def _batches(self, gradient_steps: int, batch_size: int) -> Iterator[tuple[int, Any]]:
        """The batches of the next gradient steps, one behind the other, and of how many: of those up to the next update of the
        actor. They are drawn many at a time."""
        most_at_once = 1 if self.policy.has_image_state else max(1, self.MOST_ROWS_PER_DRAW // batch_size)
        for first in range(0, gradient_steps, most_at_once):
            n_left = min(most_at_once, gradient_steps - first)
            drawn, begin = deal_rows(self._sample(n_left * batch_size), n_left), 0
            while n_left > 0:
                n_steps = min(self.policy_delay - self._n_updates % self.policy_delay, n_left)
                end = begin + n_steps * batch_size
                yield n_steps, rows_of(drawn, slice(begin, end))
                begin, n_left = end, n_left - n_steps

    def _sample(self, batch_size: int, one_step: bool = False) -> Any:
        """A batch from the replay buffer, from the preloaded transitions, or from both."""
        assert self.replay_buffer is not None
        n_offline = self._n_offline(batch_size)
        parts = ((self.replay_buffer, batch_size - n_offline), (self.offline_buffer, n_offline))
        draw = self._draw_one_step if one_step else self._draw
        return concatenate_samples([draw(buffer, count) for buffer, count in parts if buffer is not None and count > 0])

    def _draw(self, replay_buffer: ReplayBuffer, batch_size: int) -> Any:
        if self._vec_normalize_env is None:
            on_device = self._device_replay(replay_buffer)
            if on_device is not None:
                return on_device.sample(batch_size)
        return replay_buffer.sample(batch_size, env=self._vec_normalize_env)

    def _device_replay(self, replay_buffer: ReplayBuffer) -> DeviceReplay | None:
        """The copy on the device of one of the two buffers; made anew when it was replaced."""
        name = "offline" if replay_buffer is self.offline_buffer else "online"
        known = self._device_replays.get(name)
        if known is None or known[0] is not replay_buffer:
            covered = DeviceReplay.covers(replay_buffer, self.device)
            known = (replay_buffer, DeviceReplay(replay_buffer, self.device) if covered else None)
            self._device_replays[name] = known
        return known[1]

    def _draw_one_step(self, replay_buffer: ReplayBuffer, batch_size: int) -> Any:
        # The n-step buffer gives n-step rewards and observations, which are wrong for a one-step world model
        indices = np.random.randint(0, replay_buffer.size(), size=batch_size)
        return ReplayBuffer._get_samples(replay_buffer, indices, env=self._vec_normalize_env)

    def _update_critics(self, replay_data, target: th.Tensor, running_weight: float) -> dict[str, th.Tensor]:
        target_std, loss, gradients = self._critic_gradients(replay_data, target)
        self._step(self.critic, gradients)
        with th.no_grad():
            self.policy.return_std.lerp_(target_std, running_weight)
        return {"critic_loss": loss}

    def _critic_gradients(self, replay_data, target: th.Tensor) -> tuple[th.Tensor, th.Tensor, Gradients]:
        target_std, target_mean = th.std_mean(target, correction=0)
        target_std = th.where(moves(target_std, target_mean), target_std, 1.0)
        loss = critic_loss(self.critic(replay_data.observations, replay_data.actions), target)
        return target_std, loss.detach(), gradients_of(self.critic, loss)

    def _td_target(self, replay_data) -> tuple[th.Tensor, th.Tensor]:
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
        n_actions = self.N_BACKUP_ACTIONS if self.max_q_backup else 1
        next_observations = replay_data.next_observations
        with th.no_grad():
            actor_features = self.actor_target.features(next_observations).repeat_interleave(n_actions, dim=0)
            next_actions = self.actor_target.sample(actor_features)
            critic_features = self.critic_target.extract_features(next_observations, self.critic_target.features_extractor)
            next_q_values = q_values(self.critic_target, critic_features.repeat_interleave(n_actions, dim=0), next_actions)
            target = td_target(next_q_values, replay_data.rewards, replay_data.dones, discounts, n_actions)
        return next_actions[::n_actions], target

    def _update_world_model(self, transitions, running_weight: float) -> dict[str, th.Tensor]:
        state = self.policy.causal_state(transitions.observations)
        next_state = self.policy.causal_state(transitions.next_observations)
        rewards = transitions.rewards.flatten()
        with th.no_grad():
            self.policy.reward_target.lerp_(quantile(rewards, self.REWARD_QUANTILE), running_weight)
        # The memory efficient buffer does not keep the last observation of an episode
        known = 1.0 - transitions.dones.flatten() if self.optimize_memory_usage else None
        transition, reward, gradients = self._world_model_gradients(state, transitions.actions, next_state, rewards, known)
        self._step(self.world_model, gradients)
        return {"world_model_transition_loss": transition, "world_model_reward_loss": reward}

    def _world_model_gradients(
        self, state: th.Tensor, action: th.Tensor, next_state: th.Tensor, rewards: th.Tensor, known: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor, Gradients]:
        self.world_model.update_statistics(state, next_state, rewards, known)
        transition, reward = world_model_loss(self.world_model, state, action, next_state, rewards, known, self.sample_masks)
        return transition.detach(), reward.detach(), gradients_of(self.world_model, transition + reward)

    def _update_actor(self, transitions, next_actions: th.Tensor, plan: StepPlan) -> dict[str, th.Tensor]:
        losses, gradients = self._actor_gradients(transitions, next_actions, plan.climbed, plan.guided)
        self._step(self.actor, gradients)
        return losses

    def _actor_gradients(
        self, transitions, next_actions: th.Tensor, climbed: int, guided: bool
    ) -> tuple[dict[str, th.Tensor], Gradients]:
        denoising, q_term = self._actor_losses(transitions, next_actions, climbed, guided)
        loss = self.denoising_weight * denoising.loss + self.eta * q_term + self.bound_penalty * denoising.outside
        losses = {"actor_loss": loss, "denoising_loss": denoising.loss, "q_loss": q_term, "bound_loss": denoising.outside}
        return {name: value.detach() for name, value in losses.items()}, gradients_of(self.actor, loss)

    def _actor_losses(
        self, transitions, next_actions: th.Tensor, climbed: int, guided: bool
    ) -> tuple[DenoisingTerms, th.Tensor]:
        observations = transitions.observations
        features = self.actor.features(observations)
        guidance = rule = None
        if guided:
            rule = self.policy.guidance_rule
            state, next_state = self.policy.causal_state(observations), self.policy.causal_state(transitions.next_observations)
            if self.optimize_memory_usage:
                # In place of an episode's last observation, which this buffer does not keep
                with th.no_grad():
                    predicted, _ = self.world_model.predict_next_state(state, transitions.actions)
                next_state = th.where(transitions.dones > 0.0, predicted, next_state)
            guidance = self.policy.make_guidance(state, next_state, next_actions, climbed)
        denoising = denoising_loss(
            self.actor.denoiser,
            self.actor.schedule,
            features,
            transitions.actions,
            guidance,
            rule,
            self.actor.is_continuous,
        )
        actions = denoising.clean_actions if self.actor_update == "one_step" else self.actor.sample(features)
        return denoising, self._q_term(observations, actions, transitions.actions, climbed)

    def _q_term(self, observations, actions: th.Tensor, of_data: th.Tensor, climbed: int) -> th.Tensor:
        other = (climbed + 1) % len(self.critic.q_networks)
        climbed_network, other_network = slice(climbed, climbed + 1), slice(other, other + 1)
        replayed = None
        with th.no_grad():
            features = self.critic.extract_features(observations, self.critic.features_extractor)
            (others,) = q_values(self.critic, features, actions, other_network)
            if self.q_scale == "advantage":
                (replayed,) = q_values(self.critic, features, of_data, other_network)
        (values,) = q_values(self.critic, features, actions, climbed_network)
        return q_loss(values, others, replayed)

    def _step(self, module: th.nn.Module, gradients: Gradients) -> None:
        parameters = self._parameters[module]
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        if self.max_grad_norm is not None and module is not self.world_model:
            th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        _optimizer_of(module).step()
        for parameter in parameters:
            # A CUDA graph may write over what it returned
            parameter.grad = None

    @th.no_grad()
    def _update_targets(self) -> None:
        # All parameters in one call, as SB3's polyak_update does one by one
        online = self._parameters[self.critic] + self._parameters[self.actor]
        targets = self._parameters[self.critic_target] + self._parameters[self.actor_target]
        th._foreach_lerp_(targets, online, self.tau)
        # Copy running stats, see SB3's GH issue #996
        polyak_update(self.critic_batch_norm_stats, self.critic_batch_norm_stats_target, 1.0)
        polyak_update(self.actor_batch_norm_stats, self.actor_batch_norm_stats_target, 1.0)

    def learn(
        self: SelfCausalGDP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CausalGDP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCausalGDP:
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
        self._create_aliases()
        self._setup_compile()
        self._setup_cuda_graphs()
        # The same ones would lead to the same end
        self.set_random_seed(int(np.random.SeedSequence().generate_state(1)[0] >> 1))
        warnings.warn(f"{error} It goes on from {folders[0]} after {self.num_timesteps} steps, with other random numbers.")
        return True

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args,
        **kwargs,
    ) -> tuple[int, BaseCallback]:
        if self.replay_buffer is not None and (reset_num_timesteps or self._last_obs is None):
            # SB3 resets the environments
            end_last_episodes(self.replay_buffer)
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        self._check_finite(self._last_obs if self._vec_normalize_env is None else self._last_original_obs, "observation")
        return result

    def preload(self: SelfCausalGDP, source: Any, *args, **kwargs) -> SelfCausalGDP:
        first = 0 if self.offline_buffer is None else self.offline_buffer.size()
        super().preload(source, *args, **kwargs)
        assert self.offline_buffer is not None
        # Rows that are there already may have other rewards now
        self._device_replays.pop("offline", None)
        if self._offline_marks[-1] in self._fed_marks and self._fed_offline_position == first:
            # A loaded model, whose statistics know these rows
            self._fed_offline_position = self.offline_buffer.size()
        return self

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True, *, trusted: bool = False
    ) -> None:
        super().load_replay_buffer(path, truncate_last_traj, trusted=trusted)
        assert self.replay_buffer is not None
        if self.replay_buffer is not self.offline_buffer:
            # A buffer that was saved later than the model, or by another
            self._stored_position = max(self._stored_position, self.replay_buffer.size())
        self._fed_offline_position = 0
        if self.offline_buffer is not None and all(mark in self._fed_marks for mark in self._offline_marks):
            self._fed_offline_position = self.offline_buffer.size()

    def _fitting(self, buffer: ReplayBuffer, name: str) -> ReplayBuffer:
        fitting = super()._fitting(buffer, name)
        if fitting is not buffer:
            # The newest rows are no longer at the newest positions: the few that the statistics have not seen are lost to them
            self._fed_position = self._stored_position
        return fitting

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        try:
            action, buffer_action = super()._sample_action(learning_starts, action_noise, n_envs)
        except TrainingDivergedError as error:
            raise TrainingDivergedError(error.quantity, error.value, self._n_updates) from None
        if not is_finite(buffer_action):
            # The policy's own actions are looked at in predict()
            raise ValueError(f"action_noise gave an action of NaN at step {self.num_timesteps}: {action_noise}")
        return action, buffer_action

    def _store_transition(self, replay_buffer, buffer_action, new_obs, reward, dones, infos) -> None:
        # Before anything is written: one NaN would spread from the buffer to every network and to the graph
        normalizer = self._vec_normalize_env
        # What is stored: infinity was clipped in what was normalised
        self._check_finite(new_obs if normalizer is None else normalizer.old_obs, "observation")
        self._check_finite(reward if normalizer is None else normalizer.old_reward, "reward")
        for info, done in zip(infos, dones, strict=True):
            if done and info.get("terminal_observation") is not None:
                self._check_finite(info["terminal_observation"], "terminal observation")
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._stored_position += 1

    def _check_finite(self, values, name: str) -> None:
        if isinstance(values, dict):
            for key, part in values.items():
                self._check_finite(part, f"{name}[{key!r}]")
        elif not fits_float32(np.asarray(values)):
            values = np.atleast_1d(values)
            where = first_not_finite_index(values)
            what = f"{name} that is infinite in float32" if np.isfinite(values[where]) else f"NaN or infinite {name}"
            raise ValueError(
                f"The environment returned a {what} at step {self.num_timesteps}, index {list(where)}: "
                f"{values[where]}. Nothing of this step was stored; see VecCheckNan to find its origin."
            )

    def set_parameters(self, load_path_or_dict, exact_match: bool = True, device: th.device | str = "auto") -> None:
        """
        Load parameters from a zip-file or a nested dictionary, all or nothing.

        :param load_path_or_dict: Path of a saved model, or what ``get_parameters`` gave
        :param exact_match: Whether the parameters of each module, and each of their parameters, have to be there
        :param device: Device on which the code should run
        :raises ValueError: If one is NaN or infinite, unknown or missing, or an optimizer's state does not fit its parameters
        :raises RuntimeError: If a network is another one
        """
        params = load_path_or_dict
        if not isinstance(params, dict):
            _, params, _ = load_from_zip_file(params, device=device, load_data=False)
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
            self._setup_cuda_graphs()

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
        with saved_when_done(path, ".zip") as file:
            if isinstance(file, pathlib.Path):
                file.write_bytes(archive.getbuffer())
            else:
                open_path(file, "w").write(archive.getbuffer())

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfCausalGDP],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        trusted: bool = False,
        **kwargs: Any,
    ) -> SelfCausalGDP:
        """
        Load the model from a zip-file. ``load`` re-creates the model from scratch, it does not update it in-place: for that
        use ``set_parameters``.

        Nothing that the file brings is run, and what asks for very large networks, buffers or numbers of steps is refused,
        unless it is trusted. It has to be where it holds what you brought yourself, such as a schedule that is a lambda, or is
        of a version that pickled all.

        :param path: Path to the file (or a file-like) where to load the agent from
        :param env: The new environment to run the loaded model on (can be None if you only need prediction from a trained
            model)
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
        given = {**(custom_objects or {}), **{name: value for name, value in kwargs.items() if name != "policy_kwargs"}}
        file = open_path(path, "r", suffix="zip")
        try:
            with errors_of(path, "cannot be loaded"):
                saved = read_values(file, cls._known_classes(), given, trusted, cls)
                values = {**saved.plain, **given}
                # SB3 replaces only what its own entry names
                more = {name: value for name, value in values.items() if name in LARGE and name not in saved.named}
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
        return KNOWN + Known([], {*cls.policy_aliases.values(), *CausalGDP.policy_aliases.values()})

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
        cls: type[SelfCausalGDP],
        path: str | pathlib.Path,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        trusted: bool = False,
    ) -> SelfCausalGDP:
        """
        Make the model of an interrupted training, with its replay buffer and the state of its environment, from the newest
        whole checkpoint. ``model.learn(model.remaining_timesteps, reset_num_timesteps=False)`` does the rest.

        :param path: Folder of checkpoints, one of them, or a zip file
        :param env: Environment that is made as the first one was; None where :meth:`pretrain` goes on
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

    def _excluded_save_params(self) -> list[str]:
        return super()._excluded_save_params() + [  # noqa: RUF005
            "actor",
            "actor_target",
            "critic",
            "critic_target",
            "world_model",
            "_parameters",
            *COMPILED,
            "discovery",
            "_fed_offline_position",
            "_checkpoints",
            "_resumed_at_gradient_step",
            "_device_replays",
            "_update_graphs",
            "causal_graph_history",
            "actor_batch_norm_stats",
            "critic_batch_norm_stats",
            "actor_batch_norm_stats_target",
            "critic_batch_norm_stats_target",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer", "world_model.optimizer"]
        return state_dicts, []


def _optimizer_of(module: th.nn.Module) -> th.optim.Optimizer:
    optimizer = module.optimizer
    assert isinstance(optimizer, th.optim.Optimizer)
    return optimizer


@contextmanager
def _threads(n_threads: int | None) -> Iterator[None]:
    """PyTorch's number of CPU threads, for a while."""
    before = th.get_num_threads()
    if n_threads in (None, before):
        yield
        return
    th.set_num_threads(n_threads)  # type: ignore[arg-type]
    try:
        yield
    finally:
        th.set_num_threads(before)
