"""
What is known of the policy as it is: by the paper's theory, divergence by guidance (Theorem 1) and step size (Proposition 1);
and why it may not learn: its critics' errors, its dead units and its gradients.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_causalgdp.diffusion.guidance import guidance_shift
from sb3_causalgdp.diffusion.samplers import bind
from sb3_causalgdp.networks import smallest_q
from sb3_causalgdp.policies import CausalGDPPolicy
from sb3_causalgdp.prediction import act_in_torch, candidate_noise

MOST_UNKNOWN = 0.15  # so that the first steps of 200 count at a discount of 0.99
NO_ACTIVATIONS = (nn.Linear, nn.BatchNorm1d, nn.LayerNorm, nn.Dropout, nn.Embedding, nn.Identity)


@th.no_grad()
def step_divergences(policy: CausalGDPPolicy, observations: PyTorchObs) -> th.Tensor:
    """
    KL divergence of each guided step of the denoising chain from the plain one, ``||mu_cg - mu||^2 / (2 sigma_k^2)``.

    :param policy: A policy whose guidance is on
    :param observations: A batch of observations
    :return: The divergences, at least 0, from k = K down to 1, shape ``(K, batch)``
    """
    divergences: list[th.Tensor] = []
    features = policy.actor.features(observations)
    guidance = policy.acting_guidance(policy.causal_state(observations), policy.actor.denoise(features))
    policy.actor.denoise(features, None, guidance, policy.guidance_rule, divergences)
    return th.stack(divergences)


def guidance_divergence(policy: CausalGDPPolicy, observations: PyTorchObs) -> float:
    """
    KL(pi_cg || pi) along the chain, the mean over a batch: the sum over k of ``||mu_cg - mu||^2 / (2 sigma_k^2)``.

    :param policy: A policy whose guidance is on
    :param observations: A batch of observations
    :return: The divergence, at least 0; Theorem 1 bounds the change of the return by its square root
    """
    return float(step_divergences(policy, observations).sum(dim=0).mean())


class Choice(NamedTuple):
    """
    What the critics say of a policy's deterministic actions, in the mean over a batch.

    :param q_value: The smallest target Q of the actions
    :param guidance_advantage: How much of it the guidance brings: less that of the best candidates before they are guided; 0
        without guidance
    :param candidate_spread: Standard deviation of an observation's candidates, for actions in [-1, 1]; 0 where there is one
    """

    q_value: float
    guidance_advantage: float
    candidate_spread: float


@th.no_grad()
def choice(policy: CausalGDPPolicy, observations: PyTorchObs) -> Choice:
    """
    :param policy: A policy in evaluation mode
    :param observations: A batch of observations
    :return: What the critics say of its actions; no random number is drawn
    """
    actor, critic = policy.acting_actor(deterministic=True), policy.critic_target
    features = actor.features(observations)
    n_candidates, n_observations = policy.n_action_candidates, len(features)
    noise = candidate_noise(policy, n_observations, deterministic=True)
    candidates = actor.sample(features.repeat_interleave(n_candidates, dim=0), noise)
    critic_features = critic.extract_features(observations, critic.features_extractor)
    repeated = critic_features.repeat_interleave(n_candidates, dim=0)
    values = smallest_q(critic, repeated, candidates).view(-1, n_candidates)
    unguided = values.amax(dim=1).mean()
    spread = candidates.view(n_observations, n_candidates, -1).std(dim=1, correction=0).mean()
    actions = act_in_torch(policy, observations, features, noise, deterministic=True)
    value = smallest_q(critic, critic_features, actions).mean()
    advantage = float(value - unguided) if policy.is_guided else 0.0
    return Choice(float(value), advantage, float(spread))


def discounted_returns(rewards: np.ndarray, dones: np.ndarray, timeouts: np.ndarray, discount: float) -> np.ndarray:
    """
    What was really obtained from each step on.

    :param rewards: Of consecutive steps of several environments, shape ``(T, n_envs)``
    :param dones: Whether the episode ended there, the same shape
    :param timeouts: Whether it was only cut there, the same shape
    :param discount: Discount factor
    :return: The same shape; NaN where more than 15 % of the weight of what follows is behind the episode's cut, or to come
    """
    returns, following = np.zeros(rewards.shape), np.zeros(rewards.shape[1])
    # How much of the return lies behind what is known
    unknown = np.ones(rewards.shape[1])
    for step in range(len(rewards) - 1, -1, -1):
        ended = dones[step] > 0.0
        unknown = np.where(ended, np.where(timeouts[step] > 0.0, 1.0, 0.0), unknown) * discount
        following = rewards[step] + discount * np.where(ended, 0.0, following)
        returns[step] = np.where(unknown <= MOST_UNKNOWN, following, np.nan)
    return returns


@th.no_grad()
def dead_units(policy: CausalGDPPolicy, observations: PyTorchObs) -> dict[str, float]:
    """
    Shares of hidden units that give the same for all observations (Sokar et al., 2023, https://arxiv.org/abs/2302.12902).

    :param policy: A policy in evaluation mode
    :param observations: A batch of observations
    :return: Of the ``actor`` and the ``critic``; a network without hidden units is left out
    """
    features = policy.actor.features(observations)
    noise = candidate_noise(policy, len(features), deterministic=True)[:, : len(features)]
    actions = policy.actor.sample(features, noise)
    critic = policy.critic_target
    inputs = th.cat([critic.extract_features(observations, critic.features_extractor), actions], dim=1)
    calls: dict[str, list[tuple[nn.Module, tuple[Any, ...]]]] = {
        "actor": [(policy.actor.denoiser, (noise[0], policy.actor.schedule.n_steps - 1, features))],
        "critic": [(network, (inputs,)) for network in critic.q_networks],
    }
    shares = {}
    for name, networks in calls.items():
        is_dead = th.cat([_constant_units(network, arguments) for network, arguments in networks])
        if len(is_dead) > 0:
            shares[name] = float(is_dead.float().mean())
    return shares


def _constant_units(network: nn.Module, arguments: tuple[Any, ...]) -> th.Tensor:
    """Which outputs of the activations do not vary over the batch, boolean, one for each unit."""
    found: list[th.Tensor] = []

    def look(module: nn.Module, inputs: Any, output: Any) -> None:
        if isinstance(output, th.Tensor) and output.dim() == 2:
            found.append(output.amax(dim=0) - output.amin(dim=0) <= 0.0)

    activations = [module for module in network.modules() if not isinstance(module, NO_ACTIVATIONS) and _is_leaf(module)]
    handles = [module.register_forward_hook(look) for module in activations]
    try:
        network(*arguments)
    finally:
        for handle in handles:
            handle.remove()
    return th.cat(found) if found else th.zeros(0, dtype=th.bool)


def _is_leaf(module: nn.Module) -> bool:
    return next(module.children(), None) is None


def gradient_norm(optimizer: th.optim.Optimizer) -> float | None:
    """
    :param optimizer: Of one network
    :return: Root mean square of the norm of its gradients over about the last ``1 / (1 - beta_2)`` updates (a thousand), which
        Adam keeps anyway; None for other optimizers, and before the first update
    """
    total = None
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            state = optimizer.state.get(parameter, {})
            if "exp_avg_sq" not in state:
                return None
            square = state["exp_avg_sq"].sum() / (1.0 - group["betas"][1] ** state["step"])
            total = square if total is None else total + square
    return None if total is None else math.sqrt(float(total))


@dataclass(frozen=True)
class StepSizeBound:
    """
    Proposition 1 on a batch, in diffusion time, which runs from 0 to 1.

    :param step_size: Step of the sampler, 1 / K
    :param bound: ``delta / L_sum``, the smallest over the diffusion steps
    :param guidance_bound: ``delta / (g^2 lambda_k L_G)``, what the guidance alone allows
    :param guidance_lipschitz: The largest Lipschitz constant ``lambda_k L_G`` of the guidance
    """

    step_size: float
    bound: float
    guidance_bound: float
    guidance_lipschitz: float

    @property
    def guidance_exceeds(self) -> bool:
        """
        Whether the guidance alone breaks the bound. The drift and the score of the diffusion itself are no cause for alarm:
        DDPM and DDIM integrate them exactly, which the Euler scheme of Proposition 1 does not.
        """
        return self.step_size > self.guidance_bound


@th.no_grad()
def step_size_bound(policy: CausalGDPPolicy, observations: PyTorchObs, delta: float = 1.0) -> StepSizeBound:
    """
    ``delta / (L_f + g^2 (L_s + lambda_k L_G))`` with the Lipschitz constants of drift, score and guidance.

    The guidance is added to the score, so it comes with g^2, in which this differs from the paper's equation. Constants are
    estimated on the batch, from the largest change of score and guidance under a small random change of the noisy action.

    :param policy: A policy whose guidance is on
    :param observations: A batch of observations
    :param delta: The paper's delta, in (0, 1]
    :return: The bounds
    """
    actor, schedule, rule = policy.actor, policy.actor.schedule, policy.guidance_rule
    assert rule is not None
    features = actor.features(observations)
    predict_noise = bind(actor.denoiser, features)
    actions = actor.sample(features)
    guidance = policy.acting_guidance(policy.causal_state(observations), actions)
    bound = guidance_bound = math.inf
    largest = 0.0
    for step in range(schedule.n_steps):
        steps = th.full((len(actions),), step, device=actions.device)
        noisy = schedule.add_noise(actions, th.randn_like(actions), steps)
        change = 0.1 * th.nn.functional.normalize(th.randn_like(actions), dim=1)
        noises, shifts = [], []
        for point in (noisy, noisy + change):
            noises.append(predict_noise(point, step))
            shifts.append(guidance_shift(guidance, rule, predict_noise, schedule, point, noises[-1], step))
        # Both are minus a score times sqrt(1 - alpha_bar)
        spread = math.sqrt(1.0 - schedule.alpha_bar_list[step]) * 0.1
        score_lipschitz = float((noises[1] - noises[0]).norm(dim=1).max()) / spread
        guidance_lipschitz = float((shifts[1] - shifts[0]).norm(dim=1).max()) / spread
        rate = -math.log1p(-schedule.beta_list[step]) * schedule.n_steps
        bound = min(bound, delta / (0.5 * rate + rate * (score_lipschitz + guidance_lipschitz)))
        guidance_bound = min(guidance_bound, delta / (rate * max(guidance_lipschitz, 1e-12)))
        largest = max(largest, guidance_lipschitz)
    return StepSizeBound(1.0 / schedule.n_steps, bound, guidance_bound, largest)
