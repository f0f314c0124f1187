"""The gradient of the masked world model's log density by the action: what steers the sampler."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch as th

from sb3_causalgdp.causal.masked_blocks import ActionResponse
from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.checks import check_at_least_zero, register


class OutcomeTerm(NamedTuple):
    """A scalar outcome that is wished for, in units of its standard deviation."""

    error: th.Tensor
    """(target - prediction) / std, shape ``(batch,)``."""
    by_next_state: th.Tensor
    """Partial derivative of the prediction by the next state / std, shape ``(batch, m)``, of what the response is about."""
    by_action: th.Tensor
    """Partial derivative of the prediction by the action, the next state as it is, / std, shape ``(batch, d)``."""


class OutcomeTarget(Protocol):
    """What the guidance wishes for: a prediction, its derivative by the action and the value that it should take."""

    def __call__(self, response: ActionResponse) -> OutcomeTerm:
        """
        :param response: What the world model predicts at the action
        :return: The outcome's error and derivatives
        """
        ...  # pragma: no cover


class RewardTarget:
    """
    The paper's target: the reward should be r*, a high quantile of the rewards seen. Sees one step ahead.

    :param reward: r*, shape ``()``
    """

    def __init__(self, reward: th.Tensor) -> None:
        self.reward = reward

    def __call__(self, response: ActionResponse) -> OutcomeTerm:
        error = (self.reward - response.reward) / response.reward_std
        std = response.reward_std
        return OutcomeTerm(error, response.reward_by_next_state / std, response.reward_by_action / std)


class ReturnTarget:
    """
    The return ``R = r + gamma V(s')``, through the causal model, should be one standard deviation of Q above its prediction.

    Sees as far as the critics do (a one-step value expansion).

    :param value_gradient: Gives dV / ds' at next states, shape ``(batch, n)``
    :param discount: Discount factor gamma
    :param std: Standard deviation of Q, shape ``()``
    """

    def __init__(self, value_gradient: Callable[[th.Tensor], th.Tensor], discount: float, std: th.Tensor) -> None:
        self.value_gradient = value_gradient
        self.discount = discount
        self.std = std

    def __call__(self, response: ActionResponse) -> OutcomeTerm:
        value_gradient = response.states.outputs(self.value_gradient(response.next_state), 1)
        by_next_state = response.reward_by_next_state + self.discount * value_gradient
        return OutcomeTerm(th.ones_like(response.reward), by_next_state / self.std, response.reward_by_action / self.std)


class Judge(Protocol):
    """What a target can be made from: the policy, and what it has measured."""

    discount: float
    return_std: th.Tensor
    """Standard deviation of Q, shape ``()``."""
    reward_target: th.Tensor
    """A high quantile of the rewards seen, shape ``()``."""

    def value_gradient(self, state: th.Tensor, action: th.Tensor, critic: int | None = None) -> th.Tensor:
        """
        :param state: Shape ``(batch, n)``
        :param action: The action that follows, shape ``(batch, d)``
        :param critic: Which Q, None for the smallest
        :return: dQ / ds, shape ``(batch, n)``
        """
        ...  # pragma: no cover


def _return_target(policy: Judge, next_action: th.Tensor, critic: int | None) -> OutcomeTarget:
    return ReturnTarget(lambda state: policy.value_gradient(state, next_action, critic), policy.discount, policy.return_std)


def _reward_target(policy: Judge, next_action: th.Tensor, critic: int | None) -> OutcomeTarget:
    return RewardTarget(policy.reward_target)


GUIDANCE_TARGETS: dict[str, Callable[[Any, th.Tensor, int | None], OutcomeTarget]] = {
    "return": _return_target,
    "reward": _reward_target,
}


def register_guidance_target(name: str, make: Callable[[Any, th.Tensor, int | None], OutcomeTarget]) -> None:
    """
    Let ``guidance_target=name`` be something else to wish for.

    :param name: Its name
    :param make: Takes the policy, the action that would follow in the next state (shape ``(batch, d)``) and which critic is
        climbed (None for the smallest Q of all), and gives an :class:`OutcomeTarget`
    :raises ValueError: If there is another target of that name
    """
    register(GUIDANCE_TARGETS, name, make, "guidance target")


class CausalGuidance:
    """
    ``gamma grad log p(s* | s, do(a)) + beta grad log p(outcome* | s', do(a))`` with its Gauss-Newton curvature.

    It satisfies the protocol of a guidance of the samplers. gamma and beta scale the precisions of the two densities.

    :param world_model: The masked world model
    :param state: s, shape ``(batch, n)``
    :param next_state: The next state s* that is wished for, shape ``(batch, n)``
    :param outcome: The reward or return that is wished for
    :param state_scale: gamma, at least 0
    :param outcome_scale: beta, at least 0
    :raises ValueError: If a state is not of the world model's size, or a scale is negative
    :raises TypeError: If the outcome cannot be called
    """

    def __init__(
        self,
        world_model: MaskedWorldModel,
        state: th.Tensor,
        next_state: th.Tensor,
        outcome: OutcomeTarget,
        state_scale: float = 1.0,
        outcome_scale: float = 1.0,
    ) -> None:
        check_at_least_zero(state_scale=state_scale, outcome_scale=outcome_scale)
        for name, values in (("state", state), ("next_state", next_state)):
            if values.ndim != 2 or values.shape[1] != world_model.state_dim:
                raise ValueError(f"{name} must have the shape (batch, {world_model.state_dim}), got {tuple(values.shape)}")
        if not callable(outcome):
            raise TypeError(f"outcome must be an OutcomeTarget, such as RewardTarget(th.tensor(1.0)), got {outcome!r}")
        self.world_model = world_model
        self.state = state
        self.next_state = next_state
        self.outcome = outcome
        self.state_scale = state_scale
        self.outcome_scale = outcome_scale

    def __call__(self, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param action: Clean actions, shape ``(batch, d)``
        :return: Gradient, shape ``(batch, d)``, and curvature, shape ``(batch, d, d)``
        """
        # Not as a decorator, which cannot be compiled for an object that is made inside the graph
        with th.no_grad():
            return self.at(self.world_model.action_response(self.state, action, of_all=False))

    def at(self, response: ActionResponse) -> tuple[th.Tensor, th.Tensor]:
        """
        :param response: What the world model predicts at the actions
        :return: As for a call with these actions
        """
        outcome = self.outcome(response)
        error = response.states.outputs(self.next_state - response.next_state, 1)
        by_error = error / response.next_state_std.square()
        through, to_next_state = response.through_next_state(outcome.by_next_state, by_error).unbind(dim=1)
        jacobian = outcome.by_action + through
        gradient = self.outcome_scale * outcome.error.unsqueeze(1) * jacobian
        curvature = self.outcome_scale * jacobian.unsqueeze(2) * jacobian.unsqueeze(1)
        if self.state_scale > 0.0:
            by_action = response.standardised_jacobian
            gradient = gradient + self.state_scale * to_next_state
            curvature = curvature + self.state_scale * (by_action.mT @ by_action)
        return gradient, curvature


class LinearisedGuidance:
    """
    A guidance taken at one action and continued linearly, ``v(a) = v(a_0) - P (a - a_0)``: exact where the model is linear.

    The steps of a sampler then share one evaluation of the model. The outcome's target stays where it was at a_0.

    :param guidance: The guidance
    :param action: a_0, shape ``(batch, d)``
    :param response: What the world model predicts at a_0, where that is known already
    """

    def __init__(self, guidance: CausalGuidance, action: th.Tensor, response: ActionResponse | None = None) -> None:
        self.action = action
        self.gradient, self.curvature = guidance(action) if response is None else guidance.at(response)

    def __call__(self, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param action: Clean actions, shape ``(batch, d)``
        :return: Gradient, shape ``(batch, d)``, and curvature, shape ``(batch, d, d)``
        """
        change = (self.curvature @ (action - self.action).unsqueeze(2)).squeeze(2)
        return self.gradient - change, self.curvature
