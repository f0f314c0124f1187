"""What actor and critics see of observations and actions: in which units, and what is hidden from them."""

from collections.abc import Mapping
from typing import Any

import torch as th
from torch import nn

from sb3_causalgdp.diffusion import MLPDenoiser
from sb3_causalgdp.extractors import StandardizedExtractor
from sb3_causalgdp.forgetting import forget_inputs, forget_outputs, forget_rows
from sb3_causalgdp.networks import Critic, DiffusionActor
from sb3_causalgdp.steering import SteeredPolicy


class AbstractingPolicy(SteeredPolicy):
    """A policy from whose networks components can be hidden."""

    state_gate: th.Tensor
    action_gate: th.Tensor
    normalize_observations: bool
    causal_abstraction: bool
    n_shown_actions: int
    """Number of action components that are not hidden."""

    @th.no_grad()
    def update_observation_statistics(self) -> None:
        """Let actor, critics and their targets see observations by what the world model knows of them by now."""
        own = self._statistics_of_extractors()
        if own and self.normalize_observations:
            inverse_std = 1.0 / self.world_model.state_std
            if self.causal_abstraction:
                inverse_std *= self.state_gate
            th._foreach_copy_(own, [self.world_model.state_mean, inverse_std] * (len(own) // 2))

    def _statistics_of_extractors(self) -> list[th.Tensor]:
        """Mean and factor of each network."""
        networks = (self.actor, self.actor_target, self.critic, self.critic_target)
        # Networks may share one, and critics that normalise batches are their own targets
        extractors = dict.fromkeys(network.features_extractor for network in networks)
        return [
            tensor for one in extractors if isinstance(one, StandardizedExtractor) for tensor in (one.mean, one.inverse_std)
        ]

    @th.no_grad()
    def show(self, states: th.Tensor, actions: th.Tensor) -> None:
        """
        Say what actor, critics and their targets see. Hidden components of observations are constant for them. Hidden ones of
        actions are 0 in all that the actor gives and the critics are asked, before the exploration noise. What is shown again
        starts with weights of 0, so that no output jumps. The world model leaves out next values that are hidden.

        :param states: Which state variables are shown, boolean, shape ``(n,)``
        :param actions: Which components of the actions are shown, boolean, shape ``(d,)``
        :raises ValueError: If the policy was made without ``causal_abstraction``
        """
        if not self.causal_abstraction:
            raise ValueError("causal_abstraction must be True for a policy that hides components of observations, got False")
        states, actions = states.to(self.device, th.bool), actions.to(self.device, th.bool)
        before, actions_before = self.state_gate > 0.0, self.action_gate > 0.0
        if th.equal(states, before) and th.equal(actions, actions_before):
            return
        self._begin_anew(states & ~before, actions & ~actions_before, before, actions_before)
        self._stop_modelling(~actions & actions_before)
        self.state_gate.copy_(states)
        self.action_gate.copy_(actions)
        self._write_action_gates()
        known, newly = self.world_model.modelled_states, self.world_model.model_only(states)
        optimizer: Any = self.world_model.optimizer
        forget_rows(self.world_model.transition.parameters(), newly, known, optimizer)
        if self.normalize_observations:
            self.update_observation_statistics()
        else:
            for factor in self._statistics_of_extractors()[1::2]:
                factor.copy_(self.state_gate)

    def _write_action_gates(self) -> None:
        self.n_shown_actions = max(1, int(self.action_gate.sum()))
        for network in (self.actor, self.actor_target, self.critic, self.critic_target):
            assert network.action_gate is not None
            network.action_gate.copy_(self.action_gate)

    def _trained_networks(self) -> list[tuple[DiffusionActor | Critic, th.optim.Optimizer | None]]:
        """Actor and critics, each with its optimizer, and their targets, which have none."""
        networks = {network: network.optimizer for network in (self.actor, self.critic)}
        return list({self.actor_target: None, self.critic_target: None, **networks}.items())  # type: ignore[arg-type]

    def _begin_anew(self, states: th.Tensor, actions: th.Tensor, known: th.Tensor, known_actions: th.Tensor) -> None:
        """Of inputs that are shown again, forget what was learned of them."""
        mean, variance = th.zeros_like(self.world_model.state_mean), th.ones_like(self.world_model.state_mean)
        if not self.normalize_observations:
            mean, variance = self.world_model.state_mean, self.world_model.state_std.square()
        # Actions are in [-1, 1]
        unit = th.cat([mean, 0.0 * actions]), th.cat([variance, th.full_like(actions, 1.0 / 3.0, dtype=variance.dtype)])
        inputs, known_inputs = th.cat([states, actions]), th.cat([known, known_actions])
        for network, optimizer in self._trained_networks():
            if isinstance(network, Critic):
                for q_network in network.q_networks:
                    forget_inputs(q_network.children(), inputs, known_inputs, unit, optimizer)
            else:
                layer, _ = _layers_of(network.denoiser)
                times = th.zeros(layer.in_features - len(inputs), dtype=th.bool, device=self.device)
                # Of noisy actions the weights are 0 since they were hidden
                columns = th.cat([th.zeros_like(actions), times, states])
                forget_inputs([layer], columns, th.cat([known_actions, ~times, known]), unit, optimizer)

    def _stop_modelling(self, actions: th.Tensor) -> None:
        """Let the denoisers neither see nor give components of actions."""
        for network, optimizer in self._trained_networks():
            if isinstance(network, DiffusionActor):
                layer, last = _layers_of(network.denoiser)
                others = th.zeros(layer.in_features - len(actions), dtype=th.bool, device=self.device)
                columns = th.cat([actions, others])
                forget_inputs([layer], columns, ~columns, (columns, columns), optimizer)
                forget_outputs(last, actions, optimizer)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """
        As PyTorch's. What was hidden in a policy is shown again in one without ``causal_abstraction``, and one that has it
        hides nothing yet after the parameters of one without.

        :param state_dict: Tensors by name
        :param strict: As PyTorch's
        :param assign: As PyTorch's
        :return: As PyTorch's
        """
        state_dict = dict(state_dict)
        if self.causal_abstraction:
            if strict:
                open_gates = {"state_gate": th.ones_like(self.state_gate), "action_gate": th.ones_like(self.action_gate)}
                state_dict = {**open_gates, **state_dict}
            result = super().load_state_dict(state_dict, strict, assign)
            self._write_action_gates()
            self.world_model.model_only(self.state_gate > 0.0)
            return result
        of_states, of_actions = state_dict.pop("state_gate", None), state_dict.pop("action_gate", None)
        result = super().load_state_dict(state_dict, strict, assign)
        if of_states is not None and of_actions is not None:
            shown, modelled = of_states.to(self.device) > 0.0, of_actions.to(self.device) > 0.0
            with th.no_grad():
                self._begin_anew(~shown, ~modelled, shown, modelled)
                self.update_observation_statistics()
        return result


def _layers_of(denoiser: nn.Module) -> tuple[nn.Linear, nn.Linear]:
    """The first and the last layer of a perceptron."""
    assert isinstance(denoiser, MLPDenoiser)
    last = [denoiser.input_layer, *denoiser.network][-1]
    assert isinstance(last, nn.Linear)
    return denoiser.input_layer, last
