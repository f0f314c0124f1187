"""How a policy acts: on the best of several candidates, steered once more; in numpy where that is faster."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_causalgdp.acceleration.acting import NumpyActing, OnePassActing
from sb3_causalgdp.checks import first_not_finite_index, fits_float32
from sb3_causalgdp.networks import hoped_q

Policy = Any  # a CausalGDPPolicy, whose file imports this one

# Older versions of PyTorch do not tell
_is_exporting: Callable[[], bool] = getattr(th.compiler, "is_exporting", lambda: False)


def act(policy: Policy, observation: PyTorchObs, deterministic: bool) -> th.Tensor:
    """
    :param policy: The policy
    :param observation: Observations as SB3 gives them to policies
    :param deterministic: Whether the candidates' noise is the same at every call
    :return: Actions in [-1, 1], without exploration noise, shape ``(batch, d)``
    :raises RuntimeError: If PyTorch traces or exports it
    """
    if is_traced():
        raise RuntimeError(
            "The policy cannot be traced or exported by PyTorch, which would take its actions for constants: "
            "use model.export('policy.onnx') or policy.export, also for .pt (TorchScript) and .pt2 (torch.export)"
        )
    acting = _numpy_acting(policy, observation)
    if isinstance(acting, OnePassActing):
        assert isinstance(observation, th.Tensor)
        return th.from_numpy(acting(policy, observation.float().flatten(1).numpy(), deterministic))
    if acting is not None:
        assert isinstance(observation, th.Tensor)
        noise = candidate_noise(policy, len(observation), deterministic).cpu().numpy()
        of_choice = choice_noise(policy, len(observation), deterministic)
        draws = (noise, None if of_choice is None else of_choice.cpu().numpy())
        actions = acting(policy, observation.float().flatten(1).cpu().numpy(), *draws, deterministic, policy.is_guided)
        return th.as_tensor(actions, device=observation.device)
    with th.no_grad():
        actor = policy.acting_actor(deterministic)
        features = actor.features(observation)
        if actor.one_pass is not None:
            return actor.sample(features)
        drawn = candidate_noise(policy, len(features), deterministic)
        of_choice = choice_noise(policy, len(features), deterministic)
        return act_in_torch(policy, observation, features, drawn, deterministic, of_choice=of_choice)


def is_traced() -> bool:
    """
    :return: Whether PyTorch is recording what is computed for another program: numpy and gradients would leave no trace
    """
    return th.jit.is_tracing() or _is_exporting()


def _numpy_acting(policy: Policy, observation: PyTorchObs) -> NumpyActing | OnePassActing | None:
    """The fast path for few rows, where it covers this policy; made anew when the networks were moved or replaced."""
    if policy.training or not isinstance(observation, th.Tensor):
        return None
    if len(observation) * policy.n_action_candidates > NumpyActing.MOST_ROWS:
        return None
    if policy._acting is not None and not policy._acting.is_current(policy):
        policy._acting = None
    kind = NumpyActing if policy.actor.one_pass is None else OnePassActing
    if policy._acting is None and kind.covers(policy):
        policy._acting = kind(policy)
    return policy._acting


def act_in_torch(
    policy: Policy,
    observation: PyTorchObs,
    features: th.Tensor,
    noise: th.Tensor,
    deterministic: bool,
    guided: bool | None = None,
    of_choice: th.Tensor | None = None,
) -> th.Tensor:
    """
    :param policy: The policy
    :param observation: Observations as SB3 gives them to policies
    :param features: The features of these, by the actor that acts
    :param noise: Of the candidates, see :func:`candidate_noise`
    :param deterministic: Whether it plays, and does not explore
    :param guided: Whether to steer, None for what the policy says now
    :param of_choice: Noise of the choice among candidates, see :func:`choice_noise`
    :return: Actions in [-1, 1], shape ``(batch, d)``
    """
    actor = policy.acting_actor(deterministic)
    critic_features = policy.critic_target.extract_features(observation, policy.critic_target.features_extractor)
    candidates = actor.sample(features.repeat_interleave(policy.n_action_candidates, dim=0), noise)
    best = _chosen_candidate(policy, critic_features, candidates, policy.acting_optimism(deterministic), of_choice)
    action = candidates[best]
    if not (policy.is_guided if guided is None else guided):
        return action
    # From the same noise, the guided chain ends at the best candidate, moved by the guidance
    guidance = policy.acting_guidance(policy.causal_state(observation), action, actor)
    return actor.sample(features, noise[:, best], guidance, policy.guidance_rule)


def fixed_noise(n_steps: int, n_candidates: int, action_dim: int) -> th.Tensor:
    """
    Noise of deterministic predictions.

    :param n_steps: Number of the sampler's steps
    :param n_candidates: Number of candidates N
    :param action_dim: Size of an action
    :return: None for the first candidate, the same at every call for the others, shape ``(n_steps, N, d)``
    """
    noise = th.randn((n_steps, n_candidates, action_dim), generator=th.Generator().manual_seed(0))
    noise[:, 0] = 0.0
    return noise


def candidate_noise(policy: Policy, n_observations: int, deterministic: bool) -> th.Tensor:
    """
    :param policy: The policy
    :param n_observations: Number of observations
    :param deterministic: Whether it is the same at every call
    :return: Noise of each observation's candidates, shape ``(n_steps, n_observations * N, d)``
    """
    fixed = policy.candidate_noise
    if deterministic:
        return fixed if n_observations == 1 else fixed.repeat(1, n_observations, 1)
    n_steps, n_candidates, action_dim = fixed.shape
    return th.randn(n_steps, n_observations * n_candidates, action_dim, device=fixed.device)


def draws_candidates(policy: Policy, deterministic: bool) -> bool:
    """
    :param policy: The policy
    :param deterministic: Whether it plays, and does not explore
    :return: Whether one of the candidates is drawn, in place of the best
    """
    return not deterministic and policy.exploration_temperature > 0.0 and policy.n_action_candidates > 1


def choice_noise(policy: Policy, n_observations: int, deterministic: bool) -> th.Tensor | None:
    """
    Noise with which the candidate of the largest Q is one drawn by a softmax of Q (Gumbel-max).

    :param policy: The policy
    :param n_observations: Number of observations
    :param deterministic: Whether it plays, and does not explore
    :return: Of Gumbel's distribution, shape ``(n_observations, N)``; None where the best is taken
    """
    if not draws_candidates(policy, deterministic):
        return None
    uniform = th.rand(n_observations, policy.n_action_candidates, device=policy.candidate_noise.device)
    return -(-uniform.clamp(1e-7, 1.0 - 1e-7).log()).log()


def _chosen_candidate(
    policy: Policy, critic_features: th.Tensor, actions: th.Tensor, optimism: float, of_choice: th.Tensor | None
) -> th.Tensor:
    """Row of the candidate with the largest target Q, as :func:`hoped_q` says it, or of one drawn, for each observation."""
    n_candidates = policy.n_action_candidates
    first = th.arange(0, actions.shape[0], n_candidates, device=actions.device)
    if n_candidates == 1:
        return first
    repeated = critic_features.repeat_interleave(n_candidates, dim=0)
    values = hoped_q(policy.critic_target, repeated, actions, optimism).view(-1, n_candidates)
    if of_choice is not None:
        spread = values.std(dim=1, keepdim=True, correction=0)
        values = values + policy.exploration_temperature * spread * of_choice
    return first + values.argmax(dim=1)


def check_observation(observation: Any, space: spaces.Space) -> None:
    """
    :param observation: What a user gives ``predict``
    :param space: The observation space
    :raises ValueError: If it is NaN or infinite in float32, with its row and index
    """
    if isinstance(observation, np.ndarray):
        if not fits_float32(observation):
            _refuse(observation, space)
        return
    for key, values in observation.items() if isinstance(observation, dict) else ((None, observation),):
        if isinstance(values, (list, np.ndarray)) and not fits_float32(np.asarray(values)):
            _refuse(np.asarray(values), space, key)


def _refuse(values: np.ndarray, space: spaces.Space, key: str | None = None) -> None:
    own_space = space if key is None else space[key]  # type: ignore[index]
    index = first_not_finite_index(values)
    value = np.atleast_1d(values)[index]
    n_axes = len(own_space.shape or ())
    row = f"row {index[0]}, " if values.ndim > n_axes else ""
    name = "The observation" if key is None else f"observation[{key!r}]"
    raise ValueError(f"{name} is {value} at {row}index {list(index[len(index) - n_axes :])}: it must be finite in float32")
