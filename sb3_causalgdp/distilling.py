"""From a model that denoises to a policy that acts in one pass."""

import numpy as np
import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, is_vecenv_wrapped

from sb3_causalgdp.arguments import (
    DISTILLATION_ARGUMENTS,
    check_arguments,
)
from sb3_causalgdp.distillation import distil, visited
from sb3_causalgdp.offline.algorithm import OfflineToOnlineAlgorithm
from sb3_causalgdp.policies import CausalGDPPolicy
from sb3_causalgdp.updates import Updates


class DistilledAlgorithm(OfflineToOnlineAlgorithm):
    """An algorithm whose policy can be distilled."""

    policy: CausalGDPPolicy
    _updates: Updates

    def distil(
        self,
        n_observations: int = 20_000,
        gradient_steps: int = 20_000,
        batch_size: int = 256,
        learning_rate: float = 1e-3,
        env: GymEnv | str | None = None,
        n_rounds: int = 3,
    ) -> CausalGDPPolicy:
        """
        Make a policy that acts in one pass, for robots that must act at once: a perceptron that does what this model's
        policy does without noise, guidance included, on the observations of the replay buffer and the preloaded transitions.
        With an environment, it then acts there itself and learns what this model would do where it gets to (DAgger).

        :param n_observations: Number of observations that the policy is asked for, drawn as batches are
        :param gradient_steps: How many the perceptron is trained for
        :param batch_size: Observations for each
        :param learning_rate: Of its optimizer, falling to 0
        :param env: Where the perceptron acts between rounds of training, not the environment that is learned from; its
            observations as they are before ``VecNormalize``. None for no such rounds
        :param n_rounds: How many, each with half as many observations and gradient steps more
        :return: The policy, with ``predict`` and ``save``; this model goes on as before
        :raises ValueError: If an argument is out of range, there are no transitions, the environment has other spaces or is
            the one that is learned from, or the policy acts in one pass already
        """
        check_arguments(DISTILLATION_ARGUMENTS, locals())
        if self.actor.one_pass is not None:
            raise ValueError("distil() needs a policy that denoises, got one that acts in one pass")
        buffers = [buffer for buffer in (self.replay_buffer, self.offline_buffer) if buffer is not None]
        if sum(buffer.size() for buffer in buffers) == 0:
            raise ValueError("distil() needs transitions, got none: call learn(), preload() or load_replay_buffer()")
        self._warn_if_untrained("distilled")
        own_env = self._env_to_visit(env)
        numpy_state, rows = np.random.get_state(), 500
        with th.random.fork_rng():
            counts = [min(rows, n_observations - first) for first in range(0, n_observations, rows)]
            observations = [self._updates.batches.sample(count).observations for count in counts]
            student = distil(
                self.policy,
                observations,
                gradient_steps,
                batch_size,
                learning_rate,
                visit=None
                if own_env is None
                else lambda policy: visited(policy, own_env, max(1, n_observations // 2), self._vec_normalize_env),
                n_rounds=n_rounds,
            )
        np.random.set_state(numpy_state)
        return student

    def _env_to_visit(self, env: GymEnv | str | None) -> VecEnv | None:
        """As ``distil`` steps it: vectorised, with this model's spaces and no statistics of its own."""
        if env is None:
            return None
        wrapped = self._wrap_env(maybe_make_env(env, verbose=0), verbose=0, monitor_wrapper=False)
        if is_vecenv_wrapped(wrapped, VecNormalize):
            raise ValueError("env of distil() must give observations as they are, got one with VecNormalize")
        if self.env is not None and _innermost(wrapped) & _innermost(self.env):
            raise ValueError("env of distil() must not be the environment that is learned from: make a second one")
        check_for_correct_spaces(wrapped, self.observation_space, self.action_space)
        if self.seed is not None:
            wrapped.seed(self.seed)
        return wrapped


def _innermost(env: VecEnv) -> set[int]:
    """Identities of the environments below all wrappers, as far as they are in this process."""
    return {id(env.unwrapped), *(id(one.unwrapped) for one in getattr(env.unwrapped, "envs", ()))}
