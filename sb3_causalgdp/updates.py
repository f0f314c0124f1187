"""One gradient step: which networks it trains, on what, and by which of the losses."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_causalgdp.acceleration.fast_steps import FastSteps, n_threads_at_most
from sb3_causalgdp.acceleration.gradients import Gradients, gradients_of
from sb3_causalgdp.batches import Batches
from sb3_causalgdp.causal.world_model import moves
from sb3_causalgdp.diffusion import Guidance
from sb3_causalgdp.losses import (
    advantage_weights,
    critic_loss,
    denoising_loss,
    expectile_loss,
    improved_actions,
    improvement_weights,
    q_loss,
    quantile,
    quantile_critic_loss,
    quantile_td_target,
    td_target,
    trust_region_loss,
    world_model_loss,
)
from sb3_causalgdp.networks import network_outputs, q_values, smallest_q, weights_fixed
from sb3_causalgdp.noise import noise_scale
from sb3_causalgdp.step_plans import StepPlan

Model = Any  # a CausalGDP, whose file imports this one
Losses = dict[str, th.Tensor]


class Learned(NamedTuple):
    """What the denoiser learns."""

    observations: Any
    actions: th.Tensor
    """Clean ones, shape ``(batch, d)``."""
    weights: th.Tensor | None
    """Of the actions, shape ``(batch, 1)``; None where the Q term says what is better."""
    guidance: Guidance | None


class Updates:
    """
    The updates of a model's networks: each computes its loss and the gradients, and makes the optimizer's step. What is
    compiled or recorded of them is known here and in ``acceleration/`` alone.

    :param model: The model, a ``CausalGDP``; its arguments are looked up anew in each step, so that they may change
    """

    # Share of a batch's statistic that enters the running reward quantile and the running standard deviation of Q
    RUNNING_WEIGHT = 0.01
    REWARD_QUANTILE = 0.99
    N_BACKUP_ACTIONS = 10
    COMPILED = ("bootstrap", "critic_gradients", "world_model_gradients", "actor_gradients")

    def __init__(self, model: Model) -> None:
        policy = model.policy
        self.model, self.policy, self.world_model = model, policy, policy.world_model
        self.actor, self.critic = policy.actor, policy.critic
        self.actor_target, self.critic_target = policy.actor_target, policy.critic_target
        self.batches = Batches(model)
        # Tensors, so that a change is no other program
        self.pessimism = th.zeros((), device=model.device)
        self.target_noise = th.full((), self._target_noise_scale(), device=model.device)
        networks = (self.actor, self.actor_target, self.critic, self.critic_target, self.world_model)
        # Once, because to visit all modules takes a hundredth of a gradient step
        self._parameters: dict[th.nn.Module, list[th.Tensor]] = {network: [*network.parameters()] for network in networks}
        pairs = [(self.actor, self.actor_target), (self.critic, self.critic_target)]
        if self.critic_target is self.critic:
            pairs = pairs[:1]
        # Running mean and running var
        self._batch_norm_stats, self._batch_norm_stats_target = (
            [statistic for network in networks for statistic in get_parameters_by_name(network, ["running_"])]
            for networks in zip(*pairs, strict=True)
        )
        self.fast = FastSteps(self.optimizers(), model.compile, model.cuda_graph, model.device)
        for name in self.COMPILED:
            setattr(self, name, self.fast.compiled(getattr(self, name)))

    def _target_noise_scale(self) -> float:
        return noise_scale(self.model.target_policy_noise, self.policy.n_shown_actions)

    def optimizers(self) -> list[th.optim.Optimizer]:
        """
        :return: Those of the actor, the critics and the world model
        """
        return [optimizer_of(module) for module in (self.actor, self.critic, self.world_model)]

    # Which steps, and on what ---------------------------------------------------------------------------------------------

    @contextmanager
    def made_fast(self, gradient_steps: Callable[..., Losses]) -> Iterator[Callable[..., Losses]]:
        """
        :param gradient_steps: Makes the steps of some plans, on the batches that :meth:`planned` gives with them
        :return: Does the same, within this context, in less time; what it returns is overwritten by the next call
        """
        model = self.model
        # All that the steps depend on and that may change while it trains
        weights = (model.eta, model.denoising_weight, model.bound_penalty, model.q_scale)
        of_methods = (model.expectile, model.advantage_temperature, model.improvement_step)
        rates = (model.tau, model.gamma, model.max_grad_norm, model.target_policy_noise, model.target_noise_clip)
        scales = (self.policy.state_guidance_scale, self.policy.outcome_guidance_scale, self.world_model.n_modelled)
        chosen = model.calibrated_pessimism if model.pessimism == "auto" else model.pessimism
        # On a fixed dataset, nothing corrects critics that are too hopeful
        self.pessimism.fill_(1.0 if model.is_pretraining else chosen)
        self.target_noise.fill_(self._target_noise_scale())
        with n_threads_at_most(model.torch_threads, self.policy.has_image_state):
            yield self.fast.made_fast(gradient_steps, (weights, of_methods, rates, scales))

    def planned(self, gradient_steps: int, batch_size: int) -> Iterator[tuple[tuple[StepPlan, ...], list[Any]]]:
        """
        :param gradient_steps: How many are to be made
        :param batch_size: Transitions for each
        :return: The plans of those from one update of the actor to the next, and their batches: the critics', one behind the
            other, and, where returns are of several steps, one of single steps for each plan that trains more than these
        """
        guided = self.policy.is_guided  # once, because a GPU has to be waited for
        for n_steps, replay_data in self.batches.up_to_actor_updates(gradient_steps, batch_size):
            plans = tuple(self._next_plan(guided) for _ in range(n_steps))
            batches = [replay_data]
            if isinstance(self.model.replay_buffer, NStepReplayBuffer):
                batches += [self.batches.sample(batch_size, one_step=True) for plan in plans if plan.trains_others]
            yield plans, batches

    def _next_plan(self, guided: bool) -> StepPlan:
        model = self.model
        model._n_updates += 1
        trains_actor = model._n_updates % model.policy_delay == 0
        return StepPlan(
            trains_world_model=model._n_updates % model.world_model_delay == 0,
            trains_actor=trains_actor,
            guided=guided,
            climbed=int(np.random.randint(len(self.critic.q_networks))) if trains_actor else 0,
            # The first batches are averaged, so that the start value is forgotten at once
            running_weight=max(1.0 / model._n_updates, self.RUNNING_WEIGHT),
        )

    def beside_critics(self) -> Callable[[], AbstractContextManager[None]]:
        """
        :return: Makes contexts, for what knows nothing of the updates of the critics that are launched from here on
        """
        return self.fast.branch()

    # Critics --------------------------------------------------------------------------------------------------------------

    def bootstrap(self, replay_data) -> tuple[th.Tensor | None, th.Tensor]:
        """
        :param replay_data: Sample of a replay buffer
        :return: Actions in the next states, shape ``(batch, d)``, None where a value network is asked; and what critics learn
            from: the TD target, as :meth:`td_target` gives it, or, where they normalise batches, the next actions for which
            they say it themselves in ``critic_gradients``, shape ``(batch, d)``
        """
        n_actions = self.N_BACKUP_ACTIONS if self.model.max_q_backup else 1
        next_observations = replay_data.next_observations
        actor = self.actor if self.critic.normalizes_batches else self.actor_target
        with th.no_grad():
            if self.model.expectile is not None:
                return None, self.td_target([self.critic.value(next_observations)], replay_data)
            actor_features = actor.features(next_observations).repeat_interleave(n_actions, dim=0)
            next_actions = actor.sample(actor_features)
            if self.critic.normalizes_batches:
                return next_actions, self.smoothed(next_actions)
            critic_features = self.critic_target.extract_features(next_observations, self.critic_target.features_extractor)
            critic_features, smoothed = critic_features.repeat_interleave(n_actions, dim=0), self.smoothed(next_actions)
            following = network_outputs(self.critic_target, critic_features, smoothed)
        return next_actions[::n_actions], self.td_target(following, replay_data, n_actions)

    def td_target(self, following: list[th.Tensor], replay_data, n_actions: int = 1) -> th.Tensor:
        """
        :param following: Of the next states, what each critic gives, or the value network alone
        :param replay_data: Sample of a replay buffer
        :param n_actions: Number of actions that are tried in each next state
        :return: What the critics' outputs should be, without a gradient, shape ``(batch, 1)``, or ``(batch, quantiles)``
        """
        with th.no_grad():
            of_batch = (replay_data.rewards, replay_data.dones, self.discounts(replay_data))
            if self.critic.n_quantiles is None or self.model.expectile is not None:
                return td_target(following, *of_batch, n_actions, self.pessimism)
            return quantile_td_target(following, *of_batch, n_actions, self.critic.n_kept)

    def discounts(self, replay_data) -> th.Tensor | float:
        """
        :param replay_data: Sample of a replay buffer
        :return: gamma, or for returns of several steps gamma**n_steps, less where the episode ended early
        """
        return replay_data.discounts if replay_data.discounts is not None else self.model.gamma

    def smoothed(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Shape ``(batch, d)``
        :return: The same with clipped noise, so that no narrow peak of Q becomes a target (TD3)
        """
        if self.model.target_policy_noise == 0.0:
            return actions
        noise, clip = self.target_noise * th.randn_like(actions), self.model.target_noise_clip
        return (actions + noise.clamp(-clip, clip)).clamp(-1.0, 1.0)

    def update_critics(self, replay_data, for_critics: th.Tensor, running_weight: float) -> Losses:
        """
        :param replay_data: Sample of a replay buffer
        :param for_critics: What :meth:`bootstrap` gave
        :param running_weight: Share of the target's standard deviation that enters the running one
        :return: The loss
        """
        with self.critic.batch_statistics():
            target_std, loss, gradients = self.critic_gradients(replay_data, for_critics)
        self.step(self.critic, gradients)
        with th.no_grad():
            self.policy.return_std.lerp_(target_std, running_weight)
        return {"critic_loss": loss}

    def critic_gradients(self, replay_data, for_critics: th.Tensor) -> tuple[th.Tensor, th.Tensor, Gradients]:
        observations, actions = replay_data.observations, replay_data.actions
        if self.critic.normalizes_batches:
            # CrossQ: no target critics, (s, a) and (s', a') in one batch
            outputs, following = self.critic.forward_both(observations, actions, replay_data.next_observations, for_critics)
            target = self.td_target(following, replay_data)
        else:
            outputs, target = self.critic.outputs(observations, actions), for_critics
        has_quantiles = self.critic.n_quantiles is not None
        target_std, target_mean = th.std_mean(target.mean(dim=1) if has_quantiles else target, correction=0)
        target_std = th.where(moves(target_std, target_mean), target_std, 1.0)
        loss = (quantile_critic_loss if has_quantiles else critic_loss)(outputs, target)
        if self.model.expectile is not None:
            with th.no_grad():
                of_data = self.critic_target.smallest(observations, actions)
            loss = loss + expectile_loss(self.critic.value(observations), of_data, self.model.expectile)
        return target_std, loss.detach(), gradients_of(self.critic, loss)

    # World model ----------------------------------------------------------------------------------------------------------

    def update_world_model(self, transitions, running_weight: float) -> Losses:
        """
        :param transitions: Sample of single steps
        :param running_weight: Share of the rewards' quantile that enters the running one
        :return: The losses
        """
        state = self.policy.causal_state(transitions.observations)
        next_state = self.policy.causal_state(transitions.next_observations)
        rewards = transitions.rewards.flatten()
        with th.no_grad():
            self.policy.reward_target.lerp_(quantile(rewards, self.REWARD_QUANTILE), running_weight)
        # The memory efficient buffer does not keep the last observation of an episode
        known = 1.0 - transitions.dones.flatten() if self.model.optimize_memory_usage else None
        transition, reward, gradients = self.world_model_gradients(state, transitions.actions, next_state, rewards, known)
        self.step(self.world_model, gradients)
        self.policy.update_observation_statistics()
        return {"world_model_transition_loss": transition, "world_model_reward_loss": reward}

    def world_model_gradients(
        self, state: th.Tensor, action: th.Tensor, next_state: th.Tensor, rewards: th.Tensor, known: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor, Gradients]:
        world_model, sample_masks = self.world_model, self.model.sample_masks
        world_model.update_statistics(state, next_state, rewards, known)
        transition, reward = world_model_loss(world_model, state, action, next_state, rewards, known, sample_masks)
        return transition.detach(), reward.detach(), gradients_of(world_model, transition + reward)

    # Actor ----------------------------------------------------------------------------------------------------------------

    def update_actor(self, transitions, next_actions: th.Tensor | None, plan: StepPlan) -> Losses:
        """
        :param transitions: Sample of single steps
        :param next_actions: After them, for the guidance's return target, shape ``(batch, d)``; None to sample them
        :param plan: Says which critic is climbed, and whether the denoising term is steered
        :return: The losses
        """
        if next_actions is None:
            with th.no_grad():
                next_actions = self.actor_target.sample(self.actor_target.features(transitions.next_observations))
        losses, gradients = self.actor_gradients(transitions, next_actions, plan.climbed, plan.guided)
        self.step(self.actor, gradients)
        return losses

    def actor_gradients(self, transitions, next_actions: th.Tensor, climbed: int, guided: bool) -> tuple[Losses, Gradients]:
        """
        :param transitions: Sample of single steps
        :param next_actions: After them
        :param climbed: Index of the critic that is climbed
        :param guided: Whether the denoising term is steered
        :return: The losses, the whole and its parts, and the gradients of the whole
        """
        actor, model = self.actor, self.model
        learned = self.imitated if model.actor_update == "imitation" else self.of_data
        observations, of_data, weights, guidance = learned(transitions, next_actions, climbed, guided)
        features = actor.features(observations)
        rule = self.policy.guidance_rule if guided else None
        how = (guidance, rule, actor.is_continuous, weights, actor.action_gate)
        denoising = denoising_loss(actor.denoiser, actor.schedule, features, of_data, *how)
        if weights is None:
            actions = denoising.clean_actions if model.actor_update == "one_step" else actor.sample(features)
            q_term = self.q_term(observations, actions, of_data, climbed)
        else:
            q_term = th.zeros_like(denoising.loss)
        losses = {"denoising_loss": denoising.loss, "q_loss": q_term, "bound_loss": denoising.outside}
        if model.actor_update == "trust_region":
            loss = trust_region_loss(actor.denoiser, actor.schedule, features, actions, actor.is_continuous)
            # The behaviour model shares no weights with the network that acts
            whole = denoising.loss + model.denoising_weight * loss + model.eta * q_term
            losses["trust_region_loss"] = loss
        else:
            whole = model.denoising_weight * denoising.loss + model.eta * q_term + model.bound_penalty * denoising.outside
        losses = {"actor_loss": whole, **losses}
        return {name: value.detach() for name, value in losses.items()}, gradients_of(self.actor, whole)

    def of_data(self, transitions, next_actions: th.Tensor, climbed: int, guided: bool) -> Learned:
        """
        :param transitions: Sample of single steps
        :param next_actions: After them
        :param climbed: Index of the critic that is climbed
        :param guided: Whether the denoising term is steered
        :return: What the denoiser learns: the actions of the batch, all alike or by their advantage
        """
        observations, guidance, weights = transitions.observations, None, None
        if guided:
            state, next_state = self.policy.causal_state(observations), self.policy.causal_state(transitions.next_observations)
            if self.model.optimize_memory_usage:
                # In place of an episode's last observation, which this buffer does not keep
                with th.no_grad():
                    predicted, _ = self.world_model.predict_next_state(state, transitions.actions)
                next_state = th.where(transitions.dones > 0.0, predicted, next_state)
            guidance = self.policy.make_guidance(state, next_state, next_actions, climbed)
        if self.model.actor_update == "weighted":
            with th.no_grad():
                advantages = self.critic_target.smallest(observations, transitions.actions) - self.critic.value(observations)
                weights = advantage_weights(advantages, self.model.advantage_temperature)
        return Learned(observations, transitions.actions, weights, guidance)

    def imitated(self, transitions, next_actions: th.Tensor, climbed: int, guided: bool) -> Learned:
        """
        :param transitions: Sample of single steps
        :param next_actions: After them, where the TD target has sampled the actor already
        :param climbed: Index of the critic that is climbed
        :param guided: Whether the denoising term is steered
        :return: What the denoiser learns: its own actions after the transitions, a step further up
        """
        observations = transitions.next_observations
        with th.no_grad():
            features = self.critic.extract_features(observations, self.critic.features_extractor)
        with th.enable_grad(), weights_fixed(self.critic.q_networks[climbed]):
            actions = next_actions.detach().requires_grad_()
            (values,) = q_values(self.critic, features, actions, slice(climbed, climbed + 1))
            (gradient,) = th.autograd.grad(values.sum(), actions)
        with th.no_grad():
            improved = improved_actions(next_actions, gradient, self.model.improvement_step)
            weights = improvement_weights(*(smallest_q(self.critic, features, one) for one in (next_actions, improved)))
        guidance = self.policy.acting_guidance(self.policy.causal_state(observations), improved) if guided else None
        return Learned(observations, improved, weights, guidance)

    def q_term(self, observations, actions: th.Tensor, of_data: th.Tensor, climbed: int) -> th.Tensor:
        """
        :param observations: Of the batch
        :param actions: The actor's, shape ``(batch, d)``
        :param of_data: The batch's own, shape ``(batch, d)``
        :param climbed: Index of the critic that is climbed; the next one sets the scale
        :return: What the actor minimises of it
        """
        other = (climbed + 1) % len(self.critic.q_networks)
        climbed_network, other_network = slice(climbed, climbed + 1), slice(other, other + 1)
        replayed = None
        with th.no_grad():
            features = self.critic.extract_features(observations, self.critic.features_extractor)
            (others,) = q_values(self.critic, features, actions, other_network)
            if self.model.q_scale == "advantage":
                (replayed,) = q_values(self.critic, features, of_data, other_network)
        with weights_fixed(self.critic.q_networks[climbed]):
            (values,) = q_values(self.critic, features, actions, climbed_network)
        return q_loss(values, others, replayed)

    # Optimizers and averages ----------------------------------------------------------------------------------------------

    def step(self, module: th.nn.Module, gradients: Gradients) -> None:
        """
        :param module: The actor, the critics or the world model
        :param gradients: By its parameters
        """
        parameters = self._parameters[module]
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        if self.model.max_grad_norm is not None and module is not self.world_model:
            th.nn.utils.clip_grad_norm_(parameters, self.model.max_grad_norm)
        optimizer_of(module).step()
        for parameter in parameters:
            # A CUDA graph may write over what it returned
            parameter.grad = None

    @th.no_grad()
    def update_averages(self) -> None:
        """Let the target critics, and the actor's moving average, follow."""
        # All parameters in one call, as SB3's polyak_update does one by one
        online, targets = self._parameters[self.actor], self._parameters[self.actor_target]
        if self.critic_target is not self.critic:
            online, targets = self._parameters[self.critic] + online, self._parameters[self.critic_target] + targets
        th._foreach_lerp_(targets, online, self.model.tau)
        # Copy running stats, see SB3's GH issue #996
        polyak_update(self._batch_norm_stats, self._batch_norm_stats_target, 1.0)


def optimizer_of(module: th.nn.Module) -> th.optim.Optimizer:
    """
    :param module: The actor, the critics or the world model
    :return: Its optimizer
    """
    optimizer = module.optimizer
    assert isinstance(optimizer, th.optim.Optimizer)
    return optimizer
