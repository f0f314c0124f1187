"""What each update minimises: one small function a loss, on tensors alone."""

from collections.abc import Sequence
from typing import NamedTuple

import torch as th
import torch.nn.functional as F

from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.diffusion.bounds import bounded, outside
from sb3_causalgdp.diffusion.guidance import Guidance, GuidanceRule, guidance_shift
from sb3_causalgdp.diffusion.samplers import Denoiser, bind
from sb3_causalgdp.diffusion.schedules import NoiseSchedule

# So small that only zeros are smaller
SMALLEST_SCALE = 1e-20
# Of the level of Q: differences below are rounding
SMALLEST_DIFFERENCE = 1e-5


class DenoisingTerms(NamedTuple):
    """
    What one noise prediction is judged by.

    :param loss: Mean over the batch and the action's components
    :param clean_actions: Clipped to [-1, 1] with a gradient that leads back inside, shape ``(batch, d)``: one step stands for
        the whole chain in the policy improvement of EDP (Kang et al., 2023, equation 9)
    :param outside: Mean squared distance of the clean actions from their bounds before they are clipped
    """

    loss: th.Tensor
    clean_actions: th.Tensor
    outside: th.Tensor


def td_target(
    next_q_values: Sequence[th.Tensor],
    rewards: th.Tensor,
    dones: th.Tensor,
    discounts: th.Tensor | float,
    n_backup_actions: int = 1,
    pessimism: th.Tensor | float = 1.0,
) -> th.Tensor:
    """
    ``y = r + gamma (1 - done) Q'(s', a')``, where Q' is between the mean of the critics and the smallest (clipped double
    Q-learning, Fujimoto et al., 2018). What critics disagree by adds up over the steps of the discounted horizon.

    With several actions per next state, each critic first takes the best of them (``max_q_backup``, Diffusion-QL).

    :param next_q_values: Target Q-values of each critic, each of shape ``(batch * n_backup_actions, 1)``
    :param rewards: Shape ``(batch, 1)``
    :param dones: 1 where the episode terminated, a truncation bootstraps, shape ``(batch, 1)``
    :param discounts: gamma, or gamma^n of n-step returns, shape ``(batch, 1)``
    :param n_backup_actions: Number of actions per next state
    :param pessimism: 0 for the mean of the critics, 1 for the smallest
    :return: Shape ``(batch, 1)``
    """
    best = th.stack([values.view(-1, n_backup_actions).amax(dim=1) for values in next_q_values])
    value = th.lerp(best.mean(dim=0), best.amin(dim=0), pessimism)
    return rewards + (1.0 - dones) * discounts * value.unsqueeze(1)


def critic_loss(q_values: Sequence[th.Tensor], target: th.Tensor) -> th.Tensor:
    """
    :param q_values: Q-values of each critic, each of shape ``(batch, 1)``
    :param target: TD target, shape ``(batch, 1)``
    :return: Sum over the critics of the mean squared TD errors
    """
    return th.stack([F.mse_loss(values, target) for values in q_values]).sum()


def quantile_td_target(
    next_quantiles: Sequence[th.Tensor],
    rewards: th.Tensor,
    dones: th.Tensor,
    discounts: th.Tensor | float,
    n_backup_actions: int = 1,
    n_kept: int = 1,
) -> th.Tensor:
    """
    ``r + gamma (1 - done) z``, where z are the smallest quantiles of all critics together (TQC, Kuznetsov et al., 2020).

    With several actions per next state, that counts whose quantiles have the largest mean.

    :param next_quantiles: Of each critic, each of shape ``(batch * n_backup_actions, n_quantiles)``
    :param rewards: Shape ``(batch, 1)``
    :param dones: 1 where the episode terminated, a truncation bootstraps, shape ``(batch, 1)``
    :param discounts: gamma, or gamma^n of n-step returns, shape ``(batch, 1)``
    :param n_backup_actions: Number of actions per next state
    :param n_kept: How many quantiles of a critic count
    :return: Shape ``(batch, n_critics * n_kept)``
    """
    smallest = th.cat(list(next_quantiles), dim=1).sort(dim=1).values[:, : len(next_quantiles) * n_kept]
    if n_backup_actions > 1:
        smallest = smallest.view(-1, n_backup_actions, smallest.shape[1])
        best = smallest.mean(dim=2, keepdim=True).argmax(dim=1, keepdim=True)
        smallest = smallest.take_along_dim(best, dim=1).squeeze(1)
    return rewards + (1.0 - dones) * discounts * smallest


def quantile_critic_loss(quantiles: Sequence[th.Tensor], target: th.Tensor) -> th.Tensor:
    """
    :param quantiles: Of each critic, each of shape ``(batch, n_quantiles)``
    :param target: What they are compared with, shape ``(batch, n_target_quantiles)``
    :return: sb3-contrib's quantile Huber loss, the mean over critics and pairs of quantiles
    """
    from sb3_contrib.common.utils import quantile_huber_loss

    return quantile_huber_loss(th.stack(list(quantiles), dim=1), target.unsqueeze(1), sum_over_quantiles=False)


def denoising_loss(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    features: th.Tensor,
    actions: th.Tensor,
    guidance: Guidance | None = None,
    rule: GuidanceRule | None = None,
    continuous: bool = False,
    weights: th.Tensor | None = None,
    gate: th.Tensor | None = None,
) -> DenoisingTerms:
    """
    ``E || eps_theta(a^k, k, s) - eps_cg ||^2``: the noise really injected, shifted by the guidance (stop-gradient).

    :param denoiser: Predicts the noise
    :param schedule: Noise schedule
    :param features: What the denoiser is conditioned on, shape ``(batch, features_dim)``
    :param actions: Clean actions, shape ``(batch, d)``
    :param guidance: What shifts the target, None for the plain denoising loss
    :param rule: How the guidance enters, needed with a guidance
    :param continuous: Whether times are drawn from all between the first and the last diffusion step, for samplers that take
        other steps than the schedule's (denoising score matching in continuous time, Song et al., 2021, equation 7)
    :param gate: 0 for components of the actions that are not modelled, 1 for the others, shape ``(d,)``; None models all
    :param weights: Of the actions in the loss, like those of :func:`advantage_weights`, shape ``(batch, 1)``; None for equal
        ones
    :return: The loss, and what the same noise prediction says of the clean actions
    """
    noisy, noise, step = _noised(schedule, actions if gate is None else actions * gate, continuous, gate)
    predict_noise = bind(denoiser, features)
    predicted = predict_noise(noisy, step)
    clean_action = schedule.clean_estimate(noisy, predicted, step)
    if guidance is not None and rule is not None:
        noise = noise - guidance_shift(guidance, rule, predict_noise, schedule, noisy, predicted.detach(), step)
    if gate is not None:
        predicted, noise, clean_action = predicted * gate, noise * gate, clean_action * gate
    loss = F.mse_loss(predicted, noise) if weights is None else (weights * (predicted - noise).square()).mean()
    beyond = outside(clean_action)
    if gate is not None:
        # Means over the components that are modelled
        share = gate.numel() / gate.sum().clamp(min=1.0)
        loss, beyond = share * loss, share * beyond
    return DenoisingTerms(loss, bounded(clean_action), beyond)


def _noised(
    schedule: NoiseSchedule, actions: th.Tensor, continuous: bool, gate: th.Tensor | None = None
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Noisy actions, their noise and their diffusion steps, drawn anew."""
    if continuous:
        step = th.rand(len(actions), device=actions.device) * (schedule.n_steps - 1)
    else:
        step = th.randint(schedule.n_steps, (len(actions),), device=actions.device)
    noise = th.randn_like(actions) if gate is None else th.randn_like(actions) * gate
    return schedule.add_noise(actions, noise, step), noise, step


def trust_region_loss(
    denoiser: th.nn.Module, schedule: NoiseSchedule, features: th.Tensor, actions: th.Tensor, continuous: bool = False
) -> th.Tensor:
    """
    The denoising loss of a behaviour model at another policy's actions, which is small where the behaviour is dense (diffusion
    trusted Q-learning, Chen et al., 2024, https://arxiv.org/abs/2405.19690, equation 7). The model itself does not follow.

    :param denoiser: Of the behaviour model
    :param schedule: Noise schedule
    :param features: What the denoiser is conditioned on, shape ``(batch, features_dim)``; no gradient flows into it
    :param actions: The other policy's, with a gradient, shape ``(batch, d)``
    :param continuous: As in :func:`denoising_loss`
    :return: Scalar
    """
    noisy, noise, step = _noised(schedule, actions, continuous)
    fixed = {name: parameter.detach() for name, parameter in denoiser.named_parameters()}
    return F.mse_loss(th.func.functional_call(denoiser, fixed, (noisy, step, features.detach())), noise)


def expectile_loss(values: th.Tensor, targets: th.Tensor, expectile: float) -> th.Tensor:
    """
    ``E[|expectile - 1(Q < V)| (Q - V)^2]`` (IQL, Kostrikov et al., 2022, https://arxiv.org/abs/2110.06169, equation 5).

    :param values: V(s), shape ``(batch, 1)``
    :param targets: Q(s, a) of the batch's actions, shape ``(batch, 1)``
    :param expectile: 0.5 gives their mean, 1 their maximum
    :return: Scalar
    """
    difference = targets - values
    weight = th.where(difference > 0.0, expectile, 1.0 - expectile)
    return (weight * difference.square()).mean()


def advantage_weights(advantages: th.Tensor, temperature: float, largest: float = 100.0) -> th.Tensor:
    """
    ``exp(temperature A / E|A|)``, at most ``largest``, over their mean (advantage-weighted regression, as in IQL, equation 7).
    The papers' advantages are of normalised rewards; these are in units of their own size.

    :param advantages: Q(s, a) - V(s), shape ``(batch, 1)``
    :param temperature: 0 weighs all actions alike
    :param largest: Bound of the weights
    :return: Shape ``(batch, 1)``, 1 in the mean
    """
    size = advantages.abs().mean().clamp(min=SMALLEST_SCALE)
    weights = (temperature * advantages / size).exp().clamp(max=largest)
    return weights / weights.mean()


def improved_actions(actions: th.Tensor, gradient: th.Tensor, step: float) -> th.Tensor:
    """
    Actions a step further along the gradient of Q (critic-guided self-imitation).

    :param actions: In [-1, 1], shape ``(batch, d)``
    :param gradient: Of Q by them, shape ``(batch, d)``
    :param step: Its length for each component, in the root of their mean square
    :return: In [-1, 1], shape ``(batch, d)``
    """
    direction = gradient / gradient.norm(dim=1, keepdim=True).clamp(min=SMALLEST_SCALE)
    return (actions + step * actions.shape[1] ** 0.5 * direction).clamp(-1.0, 1.0)


def improvement_weights(before: th.Tensor, after: th.Tensor) -> th.Tensor:
    """
    ``relu(Q(s, a*) - Q(s, a))`` over its mean: what did not become better is not imitated (QVPO, Ding et al., 2024,
    https://arxiv.org/abs/2405.16173, equation 11, with the actor's own action as the baseline).

    :param before: Q at the actor's actions, shape ``(batch, 1)``
    :param after: Q at the improved ones, shape ``(batch, 1)``
    :return: Shape ``(batch, 1)``
    """
    risen = th.relu(after - before)
    return risen / risen.mean().clamp(min=SMALLEST_SCALE)


def q_loss(values: th.Tensor, others: th.Tensor, of_data: th.Tensor | None = None) -> th.Tensor:
    """
    ``-E[Q_i(s, G_theta(s; z))]`` over a scale: one critic is climbed, another one sets the scale.

    Without ``of_data`` the scale is ``E|Q_j|`` (Diffusion-QL). It grows with the returns and with every reward that does not
    depend on the action, and the Q term loses its weight. With ``of_data`` the scale is the mean of
    ``|Q_j(s, G_theta(s; z)) - Q_j(s, a)|``: what the choice of the action makes a difference of.

    :param values: Q_i at the actor's actions, shape ``(batch, 1)``
    :param others: Q_j at the same actions, shape ``(batch, 1)``; no gradient flows through it
    :param of_data: Q_j at the actions of the batch, shape ``(batch, 1)``; no gradient flows through it
    :return: Scalar
    """
    level = others.detach().abs().mean()
    if of_data is None:
        return -values.mean() / level.clamp(min=SMALLEST_SCALE)
    difference = (others - of_data).detach().abs().mean()
    return -values.mean() / th.maximum(difference, SMALLEST_DIFFERENCE * level).clamp(min=SMALLEST_SCALE)


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
