"""CausalGDP: what happens when."""

import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TrainFreq
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate

from sb3_causalgdp.acceleration.gradients import check_compile
from sb3_causalgdp.arguments import (
    CONSTRUCTOR_ARGUMENTS,
    DIFFUSION_ARGUMENTS,
    GUIDANCE_ARGUMENTS,
    POLICY_ARGUMENTS,
    check_action_space,
    check_arguments,
    check_keywords,
    counts_episodes,
)
from sb3_causalgdp.callbacks.own import with_own
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.checked import CheckedAlgorithm
from sb3_causalgdp.checkpoints import begin_training
from sb3_causalgdp.checkpoints.checkpoint import fresh_seed
from sb3_causalgdp.distilling import DistilledAlgorithm
from sb3_causalgdp.divergence import check_losses
from sb3_causalgdp.offline.preload import normalised_parts
from sb3_causalgdp.offline.pretraining import callback_list
from sb3_causalgdp.policies import CausalGDPPolicy, CnnPolicy, DiffusionActor, MlpPolicy, MultiInputPolicy
from sb3_causalgdp.questions import AskedAlgorithm
from sb3_causalgdp.saving.policies import FIRST_ACTING, with_first_defaults
from sb3_causalgdp.step_plans import StepPlan, dealt
from sb3_causalgdp.updates import Losses, Updates, optimizer_of

SelfCausalGDP = TypeVar("SelfCausalGDP", bound="CausalGDP")
OF_CANDIDATES = ("n_action_candidates", "exploration_optimism", "exploration_temperature")


class CausalGDP(AskedAlgorithm, DistilledAlgorithm, CheckedAlgorithm):
    """
    Causality-Guided Diffusion Policy (CausalGDP).

    Paper: "CausalGDP: Causality-Guided Diffusion Policies for Reinforcement Learning" (Xiao, Hu, Ye and Yue). The actor and
    its loss are those of Diffusion-QL (https://arxiv.org/abs/2208.06193), which is ``preset("diffusion_ql")``; the critics are
    those of CrossQ (https://arxiv.org/abs/1902.05605).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gymnasium, can be str); actions must be a bounded Box
    :param learning_rate: Learning rate of the actor, and of the critics unless ``critic_learning_rate`` is given; it can be a
        function of the current progress remaining (from 1 to 0)
    :param buffer_size: Size of the replay buffer
    :param learning_starts: How many steps of the model to collect transitions for before learning starts, with random actions
        or, after :meth:`pretrain`, the policy's own
    :param batch_size: Minibatch size for each gradient update
    :param tau: The soft update coefficient ("Polyak update", between 0 and 1) of the target critics and of the actor's moving
        average
    :param gamma: The discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: The action noise type (None by default), added on top of ``exploration_noise``
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``).
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer at a cost of more complexity.
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the Q-value network; the
        world model still learns from single steps.
    :param critic_learning_rate: Learning rate of the critics, a number or a schedule; None uses ``learning_rate``
    :param world_model_learning_rate: Learning rate of the world model, a number or a schedule
    :param eta: Weight of the Q term in the policy loss (0.005 to 5 in the paper's table)
    :param denoising_weight: Weight of the denoising term in the policy loss: 1 as in Diffusion-QL for fixed datasets; it must
        be small online, where it pulls towards the actions of older policies
    :param actor_update: Which action the Q term of the policy loss evaluates. ``one_step``: the clean action estimated from
        the denoising term's noise prediction (EDP, https://arxiv.org/abs/2305.20081), at half the cost of an update;
        ``chain``: the end of the whole chain, through which the gradient then flows (Diffusion-QL). Without a Q term:
        ``weighted`` regresses onto the batch's actions, weighted by their advantage (IQL); ``imitation`` onto the actor's own
        actions, moved a step up Q (QVPO). ``trust_region``: a network that acts in one pass climbs Q where the denoiser, which
        models only the data, finds its actions likely (DTQL)
    :param q_scale: What the Q term is divided by. ``value``: the mean absolute Q (Diffusion-QL), which grows with the returns;
        ``advantage``: the mean difference in Q between the policy's actions and the replayed ones
    :param expectile: If given, a network V(s) learns this expectile of Q over the data's actions, and TD targets use it (IQL,
        https://arxiv.org/abs/2110.06169): Q is evaluated at no other action. Required by ``actor_update="weighted"``
    :param advantage_temperature: For ``actor_update="weighted"``: how strongly an action's weight grows with its advantage, in
        units of the batch's mean absolute advantage
    :param improvement_step: For ``actor_update="imitation"``: how far up Q an action is moved, in each component of [-1, 1]
    :param bound_penalty: Weight, in the policy loss, of the mean squared distance of clean actions from [-1, 1] before
        clipping, so that no action drifts so far out that it cannot return
    :param policy_delay: The actor is updated once every this many gradient steps, as in TD3. If a call of :meth:`train` takes
        many steps, the TD targets of all steps up to the next actor update are computed at once
    :param world_model_delay: The world model is updated once every this many gradient steps
    :param pessimism: How far TD targets go from the mean of the critics, 0, to the smallest of them, 1 (clipped double
        Q-learning, as in TD3 and SAC). ``auto`` begins at 0, or at 1 after pretraining, and follows at each refresh of the
        graph: up if critics promise more than was obtained, else down. In :meth:`pretrain` it is always 1
    :param target_policy_noise: Standard deviation of the noise on the actions of TD targets, as in TD3; ``auto`` as for
        ``exploration_noise``
    :param target_noise_clip: Limit on its absolute value
    :param max_q_backup: Whether the TD target takes the best of ten sampled actions (Diffusion-QL, for AntMaze)
    :param max_grad_norm: Limit on the gradient norms of the actor and the critics, None for no limit
    :param diffusion_steps: Number of diffusion steps K
    :param noise_schedule: ``vp`` (Diffusion-QL), ``linear`` (DDPM) or ``cosine``
    :param sampler: ``ddpm``, ``ddim``, ``euler_maruyama``, ``heun`` or ``dpm_solver``
    :param ddim_eta: Noise of DDIM, from 0 (deterministic) to 1 (DDPM)
    :param n_action_candidates: Number of sampled actions from which a prediction takes the best, by the smallest of the
        critics' Q, or see ``exploration_optimism``
    :param exploration_noise: Standard deviation of the Gaussian noise of non-deterministic predictions, for actions in
        [-1, 1]; a number or a function of the current progress remaining (from 1 to 0). ``auto`` is 0.3 divided by the square
        root of the number of action components, without hidden ones, so that all of them together deviate as far in every task
    :param exploration_optimism: By what non-deterministic predictions judge candidates, in [-1, 1]: 1 for the largest of the
        critics' Q, 0 for their mean, -1 for the smallest, by which deterministic ones always do. What the critics disagree
        about is tried then (optimistic exploration, Ciosek et al., 2019, https://arxiv.org/abs/1910.12807)
    :param exploration_temperature: How random the choice among candidates is in non-deterministic predictions: one is drawn
        with a probability proportional to exp(Q / (temperature * standard deviation of the candidates' Q)); 0 for the best
    :param guidance: ``posterior`` (the gradient of log p(y | a^k), which accounts for the uncertainty of the clean action),
        ``score`` (the paper's plain gradient), ``normalized`` (unit length), or None
    :param guidance_target: What to aim for: ``return`` (one standard deviation of Q more than predicted) or ``reward`` (r*,
        the running 0.99 quantile of the rewards)
    :param guidance_covariance: ``tweedie``, ``isotropic`` or ``unit_gaussian``, for ``guidance="posterior"``
    :param guidance_scale: lambda_k: one number, or one per diffusion step from k = 1 to K
    :param state_guidance_scale: The paper's gamma_t, scales the precision of the next state
    :param outcome_guidance_scale: The paper's beta_t, scales the precision of the reward or return
    :param causal_discovery: Name of the discovery method, a key of ``sb3_causalgdp.causal.DISCOVERY_METHODS``: ``partial_r2``
        also finds nonlinear effects, ``notears`` is the paper's linear method; or a callable like
        :class:`~sb3_causalgdp.causal.discovery.DiscoveryMethod`
    :param causal_discovery_kwargs: Arguments of the named discovery method
    :param causal_refresh_freq: Rediscover the graph and update the masks every this many environment steps
    :param causal_half_life: Half-life, in transitions, of the statistics from which the graph is found; None forgets nothing
    :param causal_window: Number of newest transitions from which the graph is found (the paper's temporal window); None uses
        all
    :param sample_masks: How the world model trains with its masks. True: as probabilities; edges are sampled for each batch,
        so that an improbable edge carries little. False: as factors on the inputs, which the next layer learns to undo unless
        they are 0
    :param causal_abstraction: Whether actor and critics see only what, by the graphs found in training, can matter for any
        future reward. Other actions are not modelled: they are the middle of their range plus exploration noise. ``auto`` is
        True unless there are images, features of your own or a denoiser other than the MLP. A dictionary passes arguments to
        :class:`~sb3_causalgdp.causal.RelevanceGate`, plus ``keep_open``, a list of names of states and actions that are never
        hidden
    :param counterfactual_replay: Share of a batch, from 0 to 1, whose transitions exchange parts that, by the graphs found in
        training, do not influence each other: whole components, or what is independent in these states (CoDA,
        https://arxiv.org/abs/2007.02863). Nothing is exchanged before two consecutive graphs can be trusted
    :param state_names: Names of the observation's components in graphs, pictures and answers; None uses the environment's own
        (see :func:`~sb3_causalgdp.names.found_names`) or, if it has none, keys and indices
    :param action_names: The same for the components of the actions
    :param offline_dataset: Id of a Minari dataset, or path of a saved replay buffer or of arrays, to preload when training
        starts, unless there are transitions already; a loaded model, whose buffer is empty, loads it again
    :param pretrain_steps: Gradient steps of :meth:`pretrain` before the first step of ``learn()``; steps made earlier count,
        so that an interrupted run makes only the rest
    :param offline_fraction: Share of a batch that comes from preloaded transitions once ``learn()`` has collected others
        (symmetric sampling of RLPD, https://arxiv.org/abs/2302.02948); it can be a function of the current progress remaining
        (from 1 to 0)
    :param reward_transform: Transformation of the rewards of preloaded transitions, and then of the environment's, too: a key
        of :data:`~sb3_causalgdp.offline.rewards.REWARD_TRANSFORMS`; only a model with preloaded transitions transforms rewards
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments to be passed to the policy on creation, see
        :class:`~sb3_causalgdp.policies.CausalGDPPolicy`
    :param compile: Whether to compile with ``torch.compile``, or its ``mode``: one graph for the loss and the gradients of
        each network, including the world model and the guidance. The first updates then take a minute or two; the numbers are
        the same up to rounding. Saved models do not depend on it. Needs PyTorch 2.13 and, on a CPU, a C++ compiler.
        ``auto`` compiles on a CPU that has them, if a call of ``learn()`` or ``pretrain()`` is to make at least 50,000
        gradient steps, with vectors as observations and no networks of your own
    :param cuda_graph: Whether gradient steps after the first hundred are recorded as CUDA graphs and replayed, with or without
        ``compile``: on a GPU, launching the kernels takes longer than their work. The numbers are those of the plain steps.
        ``"auto"`` is True on a GPU, unless an optimizer cannot be recorded or ``compile`` makes CUDA graphs itself
    :param torch_threads: PyTorch's number of CPU threads during updates; None leaves it unchanged. ``"auto"`` is 1 for vector
        observations, whose networks are so small that threads mostly wait for each other, and None otherwise
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

    # What a gradient step does: a subclass may have its own
    updates_class: ClassVar[type[Updates]] = Updates

    def __init__(
        self,
        policy: str | type[CausalGDPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 1_000,
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
        denoising_weight: float = 0.001,
        actor_update: str = "one_step",
        q_scale: str = "value",
        expectile: float | None = None,
        advantage_temperature: float = 3.0,
        improvement_step: float = 0.1,
        bound_penalty: float = 0.1,
        policy_delay: int = 3,
        world_model_delay: int = 2,
        pessimism: float | str = 0.5,
        target_policy_noise: float | str = "auto",
        target_noise_clip: float = 0.5,
        max_q_backup: bool = False,
        max_grad_norm: float | None = None,
        diffusion_steps: int = 5,
        noise_schedule: str = "vp",
        sampler: str = "ddpm",
        ddim_eta: float = 0.0,
        n_action_candidates: int = 10,
        exploration_noise: float | str | Schedule = "auto",
        exploration_optimism: float = 1.0,
        exploration_temperature: float = 0.0,
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
        causal_abstraction: bool | str | dict[str, Any] = "auto",
        counterfactual_replay: float = 0.0,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        offline_dataset: str | None = None,
        pretrain_steps: int = 0,
        offline_fraction: float | Schedule = 0.5,
        reward_transform: str = "none",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        compile: bool | str = "auto",
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
        self._has_first_defaults = self._has_first_acting = False
        self.critic_learning_rate = critic_learning_rate
        self.world_model_learning_rate = world_model_learning_rate
        self.eta = eta
        self.denoising_weight = denoising_weight
        self.actor_update = actor_update
        self.q_scale = q_scale
        self.expectile = expectile
        self.advantage_temperature = advantage_temperature
        self.improvement_step = improvement_step
        self.bound_penalty = bound_penalty
        self.policy_delay = policy_delay
        self.world_model_delay = world_model_delay
        self.pessimism = pessimism
        self.calibrated_pessimism = 0.0
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        self.max_q_backup = max_q_backup
        self.max_grad_norm = max_grad_norm
        self.diffusion_steps = diffusion_steps
        self.noise_schedule = noise_schedule
        self.sampler = sampler
        self.ddim_eta = ddim_eta
        self.n_action_candidates = n_action_candidates
        self.exploration_noise = exploration_noise
        self.exploration_optimism = exploration_optimism
        self.exploration_temperature = exploration_temperature
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
        self.causal_abstraction = causal_abstraction
        self.counterfactual_replay = counterfactual_replay
        self.state_names = state_names
        self.action_names = action_names
        self.compile = compile
        self._is_compiled = False
        self.cuda_graph = cuda_graph
        self.torch_threads = torch_threads

        check_compile(self.compile, self.device)
        if _init_setup_model:
            self._setup_model()
            self._updates.fast.check_recordable()

    def _setup_model(self) -> None:
        if self._has_first_defaults:
            self.policy_kwargs = with_first_defaults(self.policy_kwargs)
        if self._has_first_acting:
            self.policy_kwargs = {**FIRST_ACTING, **self.policy_kwargs}
        self._check_arguments()
        policy_kwargs = self.policy_kwargs
        # The policy gets our arguments too, but they must not enter the user's own dictionary
        self.policy_kwargs = {**self._own_policy_kwargs(), **policy_kwargs, **check_arguments(POLICY_ARGUMENTS, policy_kwargs)}
        try:
            with warnings.catch_warnings():
                if self.replay_buffer_class is NStepReplayBuffer and self.replay_buffer_kwargs.get("n_steps") == self.n_steps:
                    # SB3 chose both itself before the model was saved, and would say that n_steps is ignored
                    warnings.filterwarnings("ignore", message="`n_steps=")
                super()._setup_model()
        except MemoryError as error:
            raise ValueError(f"buffer_size={self.buffer_size} does not fit into memory: {error}") from error
        finally:
            self.policy_kwargs = policy_kwargs
        if self.num_timesteps > 0 and self.seed is not None:
            # A loaded model would live through the random numbers and start states of its first steps again
            self.set_random_seed(fresh_seed(self))
        if self.pessimism == "auto" and self.policy.n_critics == 1:
            raise ValueError(
                "pessimism must be a number with n_critics=1, got 'auto': one critic is its own mean and smallest"
            )
        if self.pessimism == "auto" and self.policy.n_quantiles is not None:
            raise ValueError(
                "pessimism must be a number with n_quantiles, got 'auto': they are as pessimistic as many are dropped"
            )
        if self.policy.critic.normalizes_batches:
            for name, without in (("max_q_backup", False), ("expectile", None)):
                value = getattr(self, name)
                if value is not without:
                    raise ValueError(
                        f"{name} must be {without} without target critics, got {value}: critic_normalization='layer' has them"
                    )
        self._create_aliases()
        self._setup_discovery()

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

    def _own_policy_kwargs(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in (*OF_CANDIDATES, *DIFFUSION_ARGUMENTS, *GUIDANCE_ARGUMENTS)}
        noise = self.exploration_noise
        own["exploration_noise"] = FloatSchedule(noise)(1.0) if callable(noise) else noise
        networks = {"one_pass": self.actor_update == "trust_region", "value_network": self.expectile is not None}
        asked = {name: True for name, is_asked in networks.items() if is_asked}
        # Arguments of the gate ask for one
        hides = True if isinstance(self.causal_abstraction, dict) else self.causal_abstraction
        return {**own, "discount": self.gamma, "causal_abstraction": hides, **asked}

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target
        self.world_model = self.policy.world_model
        self._updates = self.updates_class(self)

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        rate = self.critic_learning_rate
        self.critic_lr_schedule = None if rate is None else FloatSchedule(rate)
        self.world_model_lr_schedule = FloatSchedule(self.world_model_learning_rate)

    def _update_learning_rates(self) -> None:
        self._update_learning_rate(self.actor.optimizer)
        progress = self._current_progress_remaining
        if callable(self.exploration_noise):
            self.policy.exploration_noise = self.exploration_noise(progress)
        critic_lr_schedule = self.critic_lr_schedule or self.lr_schedule
        update_learning_rate(self.critic.optimizer, critic_lr_schedule(progress))
        update_learning_rate(optimizer_of(self.world_model), self.world_model_lr_schedule(progress))

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Again, for models that were loaded: those that are not trained need no compiler and no GPU
        check_compile(self.compile, self.device)
        self._updates.fast.check_recordable()
        self._compile_if_worth_it()
        callbacks = with_own(self, callback_list(callback), self.causal_refresh_freq)
        all_of_them = super()._init_callback(CallbackList(callbacks), progress_bar)
        begin_training(self, all_of_them)
        return all_of_them

    def _compile_if_worth_it(self) -> None:
        """As ``compile="auto"`` says; a resumed training goes on as it was, to the last bit."""
        begins = self.policy.is_plain and self._updates.fast.expect(self._n_gradient_steps_planned(), self._is_compiled)
        if begins and self.verbose >= 1:
            print("Compiling the updates, which takes a minute or two (compile=False: not)")
        self._is_compiled = self._is_compiled or begins

    def _n_gradient_steps_planned(self) -> int:
        n_steps = self._total_timesteps - self._num_timesteps_at_start
        if self.is_pretraining or self.gradient_steps < 0:
            return n_steps
        if counts_episodes(self.train_freq):
            return 0  # nobody knows how many
        assert isinstance(self.train_freq, TrainFreq)
        return n_steps // (self.train_freq.frequency * self.n_envs) * self.gradient_steps

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        if self._waits_for_episode():
            return
        self._trained_normalised = normalised_parts(self._vec_normalize_env)
        if self.is_pretraining:
            self.calibrated_pessimism = 1.0
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        losses = []
        with self._updates.made_fast(self._gradient_steps) as gradient_steps_of:
            for plans, batches in self._updates.planned(gradient_steps, batch_size):
                of_steps = gradient_steps_of(plans, *batches)
                # A copy, because the next steps may overwrite them
                losses.append(([name for name, values in of_steps.items() for _ in values], th.cat(list(of_steps.values()))))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if losses:
            self._log_losses(losses)

    def _gradient_steps(self, plans: Sequence[StepPlan], replay_data: Any, *one_step: Any) -> Losses:
        """
        Gradient steps of which only the last may train the actor. The next actions of all, and where there are target critics
        the TD targets, are computed at once, with the networks as they are before the first.

        :param plans: What each step updates
        :param replay_data: Batches of the critics, one behind the other, and of the others unless they have their own
        :param one_step: A batch for each step that trains more than the critics, where returns are of several steps
        :return: Losses by name, one for each step that has it
        """
        updates, losses = self._updates, defaultdict(list)
        beside_critics = updates.beside_critics()
        next_actions, for_critics = updates.bootstrap(replay_data)
        for plan, batch in dealt(plans, replay_data, one_step, next_actions, for_critics):
            of_step = updates.update_critics(batch.replay_data, batch.for_critics, plan.running_weight)
            if plan.trains_world_model:
                with beside_critics():
                    of_step |= updates.update_world_model(batch.transitions, plan.running_weight)
            if plan.trains_actor:
                # The denoising loss, steered by the causal guidance, and the Q term
                of_step |= updates.update_actor(batch.transitions, batch.next_actions, plan)
            # Of the critics' targets and of the actor
            updates.update_averages()
            for name, loss in of_step.items():
                losses[name].append(loss)
        return {name: th.stack(values) for name, values in losses.items()}

    def _log_losses(self, losses: list[tuple[list[str], th.Tensor]]) -> None:
        names = [name for step_names, _ in losses for name in step_names]
        # One transfer from the device for all of them
        values = th.cat([step_values for _, step_values in losses]).tolist()
        if not math.isfinite(sum(values)):
            delays = {"critic_loss": 1, "world_model_transition_loss": self.world_model_delay}
            delays["world_model_reward_loss"] = self.world_model_delay
            check_losses(list(zip(names, values, strict=True)), self._n_updates, delays, self.policy_delay)
        by_name: dict[str, list[float]] = {name: [] for name in names}
        for name, value in zip(names, values, strict=True):
            by_name[name].append(value)
        for name, of_steps in by_name.items():
            self.logger.record(f"train/{name}", sum(of_steps) / len(of_steps))

    def learn(
        self: SelfCausalGDP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CausalGDP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCausalGDP:
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _excluded_save_params(self) -> list[str]:
        return super()._excluded_save_params() + [  # noqa: RUF005
            "actor",
            "actor_target",
            "critic",
            "critic_target",
            "world_model",
            "_updates",
            "discovery",
            "_fed_offline_position",
            "_checkpoints",
            "_resumed_at_gradient_step",
            "_is_compiled",
            "causal_graph_history",
            "relevance_gate",
            "trusted_components",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer", "world_model.optimizer"]
        return state_dicts, []
