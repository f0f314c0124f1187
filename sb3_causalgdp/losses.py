"""What each update minimises: one small function a loss, on tensors alone."""

from collections.abc import Sequence

import torch as th
import torch.nn.functional as F

from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.diffusion.guidance import Guidance, GuidanceRule, guidance_shift
from sb3_causalgdp.diffusion.samplers import Denoiser, bind
from sb3_causalgdp.diffusion.schedules import NoiseSchedule


def td_target(
    next_q_values: Sequence[th.Tensor],
    rewards: th.Tensor,
    dones: th.Tensor,
    discounts: th.Tensor | float,
    n_backup_actions: int = 1,
) -> th.Tensor:
    """
    ``y = r + gamma (1 - done) min_i Q'_i(s', a')`` (clipped double Q-learning, Fujimoto et al., 2018).

    With several actions per next state, each critic first takes the best of them (``max_q_backup``, Diffusion-QL).

    :param next_q_values: Target Q-values of each critic, each of shape ``(batch * n_backup_actions, 1)``
    :param rewards: Shape ``(batch, 1)``
    :param dones: 1 where the episode terminated, a truncation bootstraps, shape ``(batch, 1)``
    :param discounts: gamma, or gamma^n of n-step returns, shape ``(batch, 1)``
    :param n_backup_actions: Number of actions per next state
    :return: Shape ``(batch, 1)``
    """
    best = th.stack([values.view(-1, n_backup_actions).amax(dim=1) for values in next_q_values])
    return rewards + (1.0 - dones) * discounts * best.amin(dim=0).unsqueeze(1)


def critic_loss(q_values: Sequence[th.Tensor], target: th.Tensor) -> th.Tensor:
    """
    :param q_values: Q-values of each critic, each of shape ``(batch, 1)``
    :param target: TD target, shape ``(batch, 1)``
    :return: Sum over the critics of the mean squared TD errors
    """
    return th.stack([F.mse_loss(values, target) for values in q_values]).sum()


def denoising_loss(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    features: th.Tensor,
    actions: th.Tensor,
    guidance: Guidance | None = None,
    rule: GuidanceRule | None = None,
) -> tuple[th.Tensor, th.Tensor]:
    """
    ``E || eps_theta(a^k, k, s) - eps_cg ||^2``: the noise really injected, shifted by the guidance (stop-gradient).

    :param denoiser: Predicts the noise
    :param schedule: Noise schedule
    :param features: What the denoiser is conditioned on, shape ``(batch, features_dim)``
    :param actions: Clean actions, shape ``(batch, d)``
    :param guidance: What shifts the target, None for the plain denoising loss
    :param rule: How the guidance enters, needed with a guidance
    :return: Mean over the batch and the action's components; and the clean actions that the same noise prediction gives,
        clipped to [-1, 1], shape ``(batch, d)``: one step stands for the whole chain in the policy improvement of EDP (Kang
        et al., 2023, equation 9)
    """
    step = th.randint(schedule.n_steps, (len(actions),), device=actions.device)
    noise = th.randn_like(actions)
    noisy = schedule.add_noise(actions, noise, step)
    predict_noise = bind(denoiser, features)
    predicted = predict_noise(noisy, step)
    clean_action = schedule.clean_estimate(noisy, predicted, step).clamp(-1.0, 1.0)
    if guidance is not None and rule is not None:
        noise = noise - guidance_shift(guidance, rule, predict_noise, schedule, noisy, predicted.detach(), step)
    return F.mse_loss(predicted, noise), clean_action


def q_loss(values: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """
    ``-E[Q_i(s, G_theta(s; z))] / E|Q_j|``: one critic is climbed, another one sets the scale (Diffusion-QL).

    :param values: Q_i at the actor's actions, shape ``(batch, 1)``
    :param scale: Q_j at the same actions, shape ``(batch, 1)``; no gradient flows through it
    :return: Scalar
    """
    return -values.mean() / scale.detach().abs().mean().clamp(min=1e-20)


def world_model_loss(
    world_model: MaskedWorldModel,
    state: th.Tensor,
    action: th.Tensor,
    next_state: th.Tensor,
    reward: th.Tensor,
    weight: th.Tensor | None = None,
    sample_masks: bool = False,
) -> tuple[th.Tensor, th.Tensor]:
    """
    :param world_model: The masked world model
    :param state: Shape ``(batch, n)``
    :param action: Shape ``(batch, d)``
    :param next_state: Shape ``(batch, n)``
    :param reward: Shape ``(batch,)``
    :param weight: Weights of the transitions, 0 where the next state is not known, shape ``(batch,)``
    :param sample_masks: Whether the masks are probabilities of edges, and which edges are there is drawn
    :return: Negative log likelihoods of the transition model (per variable) and of the reward model, means over the batch
    """
    transition, reward_term = world_model.negative_log_likelihood(state, action, next_state, reward, sample_masks)
    if weight is None:
        return transition.mean(), reward_term.mean()
    total = weight.sum().clamp(min=1.0)
    return (weight * transition).sum() / total, (weight * reward_term).sum() / total


def quantile(values: th.Tensor, share: float) -> th.Tensor:
    """
    As ``torch.quantile``, with linear interpolation, for high quantiles: in a third of its time, because it does not sort all
    values.

    :param values: Shape ``(batch,)``
    :param share: Of the values that are below, in [0, 1]
    :return: Shape ``()``
    """
    position = share * (len(values) - 1)
    below = int(position)
    highest = values.topk(len(values) - below).values
    return highest[-1].lerp(highest[max(len(highest) - 2, 0)], position - below)
