"""Gaussian models of the next state and of the reward, each output of which sees only what causes it."""

import math
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_causalgdp.causal.masked_blocks import ALL, ActionResponse, Chosen, ManyMaskedBlocks, MaskedBlocks

SMALLEST_STD = 1e-12
ROUNDINGS = 8.0 * th.finfo(th.float32).eps


def _mean(values: th.Tensor, known: th.Tensor | None) -> th.Tensor:
    """Over the batch, of the rows that are known."""
    if known is None:
        return values.mean(dim=0)
    return known @ values / known.sum().clamp(min=1.0)


def moves(std: th.Tensor, mean: th.Tensor) -> th.Tensor:
    """
    Whether a variable moves by more than rounding. What does not is measured in units of 1: a quotient by rounding says
    nothing and is of any size. What moves by less than 1e-12 counts as that: squares of its noise would leave float32.

    :param std: Standard deviations in float32
    :param mean: Means, of the same shape
    :return: Boolean, of the same shape
    """
    return std > SMALLEST_STD + ROUNDINGS * mean.abs()


def _drawn(mask: th.Tensor) -> th.Tensor:
    # Exact at 0 and 1: a uniform number is below 1 and not below 0
    return (th.rand_like(mask) < mask).to(mask.dtype)


class MaskedWorldModel(nn.Module):
    """
    ``p(s' | s, a) = N(f(C_ss * s, C_as * a), diag Sigma_s)`` and ``p(r | s', a) = N(g(U_sr * s', U_ar * a), Sigma_r)``.

    Both models live in standardised units: states and rewards are divided by running standard deviations, and the transition
    model predicts the change of the state, in units of its running standard deviation, on top of a residual path that is
    itself masked (``C_ss[j, j] * s_j``). The covariances are diagonal and learned. All masks are 1 until
    :meth:`set_masks` is called.

    What it costs, in multiply-adds per sample with n states, d actions, L layers and w units per block:
    ``n w (n + d) + (L - 1) n w^2 + n w`` for the transition model. A block has ``w = max(8, net_arch[0] / sqrt(n))`` units (a
    multiple of 8), so that the hidden layers of all blocks cost as much as those of one network of the width that ``net_arch``
    names. With 256 units and 4 layers: HalfCheetah (n=17, d=6) w=64, 0.24 M; Humanoid (n=348, d=17) w=16, 2.3 M, against 0.23
    M of one of its Q networks (3 x 256), and 100 M of n separate networks of full width. Only m blocks and m + d inputs are
    computed after ``model_only``.

    :param state_dim: Number of state variables n
    :param action_dim: Number of action components d
    :param net_arch: Hidden layers, all of one size, ``[128, 128]`` if None: on HalfCheetah a third layer lowers the error of
        the predicted change from 4.5 to 4.1 % of its variance, for half as much time again. The paper's table has
        ``[128, 128, 128]`` to ``[256] * 4``
    :raises ValueError: If the layers differ in size or there is none
    """

    # Running statistics stop averaging over the whole past after this many batches, so that they follow the policy
    STATISTICS_WINDOW = 1_000
    INPUT_BOUND = 10.0
    MANY_STATES = 64  # from where ManyMaskedBlocks are faster
    MODELLED_STEP = 8  # their number is a multiple: compiled graphs and recordings have a fixed one
    LOG_STD_BOUNDS = (-5.0, 2.0)

    state_to_state: th.Tensor
    action_to_state: th.Tensor
    state_to_reward: th.Tensor
    action_to_reward: th.Tensor
    n_batches: th.Tensor
    state_mean: th.Tensor
    state_variance: th.Tensor
    change_variance: th.Tensor
    reward_mean: th.Tensor
    reward_variance: th.Tensor
    state_unit_square: th.Tensor
    """Running variance of the states, 1 for those that do not move, shape ``(n,)``."""
    reward_unit_square: th.Tensor
    """Running variance of the rewards, 1 if they do not move, shape ``()``."""
    columns: th.Tensor
    """Indices of inputs: those of the modelled states first, the actions next, shape ``(n + d,)``."""

    def __init__(self, state_dim: int, action_dim: int, net_arch: list[int] | None = None) -> None:
        super().__init__()
        net_arch = [128, 128] if net_arch is None else list(net_arch)
        if not net_arch or len(set(net_arch)) > 1 or min(net_arch) < 1:
            raise ValueError(f"world_model_net_arch must be a list of equal positive sizes, like [128, 128], got {net_arch}")
        self.state_dim = state_dim
        self.action_dim = action_dim
        width, depth = net_arch[0], len(net_arch)
        # A multiple of 8, for which the batched products of small matrices are fastest
        block_width = min(width, max(8, 8 * round(width / math.sqrt(state_dim) / 8)))
        blocks = ManyMaskedBlocks if state_dim >= self.MANY_STATES else MaskedBlocks
        self.transition = blocks(state_dim + action_dim, state_dim, block_width, depth)
        self.reward = MaskedBlocks(state_dim + action_dim, 1, width, depth)
        self.transition_log_std = nn.Parameter(th.zeros(state_dim))
        self.reward_log_std = nn.Parameter(th.zeros(()))
        buffers = {
            "state_to_state": th.ones(state_dim, state_dim),
            "action_to_state": th.ones(state_dim, action_dim),
            "state_to_reward": th.ones(state_dim),
            "action_to_reward": th.ones(action_dim),
            "n_batches": th.zeros(()),
            "state_mean": th.zeros(state_dim),
            "state_variance": th.ones(state_dim),
            "change_variance": th.ones(state_dim),
            "reward_mean": th.zeros(()),
            "reward_variance": th.ones(()),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value)
        # They follow from the others: once for an update, not each time that they are needed
        self.register_buffer("state_unit_square", th.ones(state_dim), persistent=False)
        self.register_buffer("reward_unit_square", th.ones(()), persistent=False)
        # One tensor that stays in its place, which recordings of updates read
        self.register_buffer("columns", th.arange(state_dim + action_dim), persistent=False)
        self.n_modelled = state_dim
        self.modelled_indices: np.ndarray | None = None
        """Of the modelled states, None for all."""

    def set_masks(
        self,
        state_to_state: th.Tensor,
        action_to_state: th.Tensor,
        state_to_reward: th.Tensor,
        action_to_reward: th.Tensor,
    ) -> None:
        """
        Write the masks, in [0, 1].

        :param state_to_state: C_ss, shape ``(n, n)``; row j says which s_i cause s'_j
        :param action_to_state: C_as, shape ``(n, d)``; row j says which a_i cause s'_j
        :param state_to_reward: U_sr, shape ``(n,)``
        :param action_to_reward: U_ar, shape ``(d,)``
        :raises ValueError: If a mask has the wrong shape or leaves [0, 1]
        """
        masks = {
            "state_to_state": state_to_state,
            "action_to_state": action_to_state,
            "state_to_reward": state_to_reward,
            "action_to_reward": action_to_reward,
        }
        for name, mask in masks.items():
            buffer = getattr(self, name)
            if mask.shape != buffer.shape:
                raise ValueError(f"{name} must have the shape {tuple(buffer.shape)}, got {tuple(mask.shape)}")
            if not bool(((mask >= 0.0) & (mask <= 1.0)).all()):
                raise ValueError(f"{name} must hold values in [0, 1], got values from {mask.min()} to {mask.max()}")
        for name, mask in masks.items():
            getattr(self, name).copy_(mask)

    @th.no_grad()
    def model_only(self, states: th.Tensor) -> th.Tensor:
        """
        Say of which states the next value is learned, and reckoned with by the guidance; all at first. The others cost
        nothing then, and :meth:`predict_next_state` says of them what was known when they were left out.

        :param states: Boolean, shape ``(n,)``; a few more are modelled, up to a multiple of 8
        :return: Which states are modelled that were not before, boolean, shape ``(n,)``
        """
        before = self.modelled_states
        n_wanted = math.ceil(int(states.sum()) / self.MODELLED_STEP) * self.MODELLED_STEP
        self.n_modelled = min(n_wanted, self.state_dim)
        first = th.argsort(~states.cpu(), stable=True)
        chosen, others = first[: self.n_modelled].sort().values, first[self.n_modelled :].sort().values
        actions = th.arange(self.state_dim, self.state_dim + self.action_dim)
        self.columns.copy_(th.cat([chosen, actions, others]))
        self.modelled_indices = None if self.n_modelled == self.state_dim else chosen.numpy()
        return self.modelled_states & ~before

    @property
    def modelled_states(self) -> th.Tensor:
        """Which states are modelled, boolean, shape ``(n,)``."""
        modelled = th.zeros(self.state_dim, dtype=th.bool, device=self.columns.device)
        modelled[self.columns[: self.n_modelled]] = True
        return modelled

    def _modelled(self) -> Chosen:
        if self.n_modelled == self.state_dim:
            return ALL
        return Chosen(self.columns[: self.n_modelled], self.columns[: self.n_modelled + self.action_dim])

    def _set_units(self) -> None:
        for square, variance, mean in (
            (self.state_unit_square, self.state_variance, self.state_mean),
            (self.reward_unit_square, self.reward_variance, self.reward_mean),
        ):
            square.copy_(th.where(moves(variance.sqrt(), mean), variance, 1.0))

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        with th.no_grad():
            self._set_units()

    @th.no_grad()
    def update_statistics(
        self, state: th.Tensor, next_state: th.Tensor, reward: th.Tensor, known: th.Tensor | None = None
    ) -> None:
        """
        Move the running means and variances towards those of a batch.

        :param state: Shape ``(batch, n)``
        :param next_state: Shape ``(batch, n)``
        :param reward: Shape ``(batch,)``
        :param known: 1 for the transitions that count and 0 for the others, shape ``(batch,)``; None if all count
        """
        if len(state) < 2:
            return
        # Nothing is told by fewer than two transitions
        counts = 1.0 if known is None else (known.sum() >= 2.0).float()
        self.n_batches += counts
        weight = counts / self.n_batches.clamp(1.0, self.STATISTICS_WINDOW)
        for values, mean, variance in (
            (state, self.state_mean, self.state_variance),
            (reward, self.reward_mean, self.reward_variance),
        ):
            batch_mean = _mean(values, known)
            difference = batch_mean - mean
            spread = _mean((values - batch_mean).square(), known)
            variance.lerp_(spread + (1.0 - weight) * difference.square(), weight)
            mean.lerp_(batch_mean, weight)
        self._set_units()
        # About 0, not about its mean: the residual path leaves the mean change to the network
        self.change_variance.lerp_(_mean((next_state - state).square(), known), weight)

    @property
    def state_std(self) -> th.Tensor:
        """Unit of the states: their running standard deviation, 1 for those that do not move, shape ``(n,)``."""
        return self.state_unit_square.sqrt()

    @property
    def reward_scale(self) -> th.Tensor:
        """Unit of the rewards: their running standard deviation, 1 if they do not move, shape ``()``."""
        return self.reward_unit_square.sqrt()

    @property
    def residual_std(self) -> th.Tensor:
        """Standard deviation of what the residual path leaves, ``s'_j - C_ss[j, j] s_j``, standardised, shape ``(n,)``."""
        gate = self.state_to_state.diagonal()
        change = (self.change_variance / self.state_std.square()).clamp(max=4.0)
        # With equal variances of s and s': var(s' - c s) = (1 - c)^2 + c var(s' - s)
        return ((1.0 - gate).square() + gate * change).sqrt().clamp(min=1e-4)

    def _network_input(self, state: th.Tensor, action: th.Tensor, of: Chosen = ALL) -> tuple[th.Tensor, th.Tensor]:
        """Of the chosen states, standardised, and the inputs of the networks."""
        standardised = (of.outputs(state, 1) - of.outputs(self.state_mean)) / of.outputs(self.state_std)
        return standardised, th.cat([standardised.clamp(-self.INPUT_BOUND, self.INPUT_BOUND), action], dim=1)

    def _transition_mask(self, of: Chosen = ALL) -> th.Tensor:
        mask = of.inputs(th.cat([of.outputs(self.state_to_state), of.outputs(self.action_to_state)], dim=1), 1)
        if of is ALL and self.n_modelled < self.state_dim:
            # What is modelled has learned from what is modelled alone
            mask[self.columns[: self.n_modelled].unsqueeze(1), self.columns[self.n_modelled + self.action_dim :]] = 0.0
        return mask

    def _reward_mask(self, of: Chosen = ALL) -> th.Tensor:
        mask = of.inputs(th.cat([self.state_to_reward, self.action_to_reward]), 0)
        if of is ALL and self.n_modelled < self.state_dim:
            mask[self.columns[self.n_modelled + self.action_dim :]] = 0.0
        return mask.unsqueeze(0)

    def _bounded(self, log_std: th.Tensor) -> th.Tensor:
        return log_std.clamp(*self.LOG_STD_BOUNDS)

    def predict_next_state(self, state: th.Tensor, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param state: s, shape ``(batch, n)``
        :param action: a in [-1, 1], shape ``(batch, d)``
        :return: Mean, shape ``(batch, n)``, and standard deviation, shape ``(n,)``, of s'
        """
        return self._next_state(state, action, self._transition_mask())

    def _next_state(
        self, state: th.Tensor, action: th.Tensor, mask: th.Tensor, of: Chosen = ALL
    ) -> tuple[th.Tensor, th.Tensor]:
        """Of the chosen states."""
        state_std = of.outputs(self.state_std)
        standardised, inputs = self._network_input(state, action, of)
        residual_std = of.outputs(self.residual_std)
        change = residual_std * self.transition(inputs, mask, of)
        mean = of.outputs(self.state_to_state.diagonal()) * standardised + change
        std = self._bounded(of.outputs(self.transition_log_std)).exp() * residual_std * state_std
        return of.outputs(self.state_mean) + state_std * mean, std

    def predict_reward(self, next_state: th.Tensor, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param next_state: s', shape ``(batch, n)``
        :param action: a in [-1, 1], shape ``(batch, d)``
        :return: Mean, shape ``(batch,)``, and standard deviation, shape ``()``, of r
        """
        return self._reward(next_state, action, self._reward_mask())

    def _reward(
        self, next_state: th.Tensor, action: th.Tensor, mask: th.Tensor, of: Chosen = ALL
    ) -> tuple[th.Tensor, th.Tensor]:
        _, inputs = self._network_input(next_state, action, of)
        mean, scale = self.reward(inputs, mask, Chosen(None, of.input_indices)).squeeze(1), self.reward_scale
        return self.reward_mean + scale * mean, self._bounded(self.reward_log_std).exp() * scale

    def negative_log_likelihood(
        self,
        state: th.Tensor,
        action: th.Tensor,
        next_state: th.Tensor,
        reward: th.Tensor,
        sample_masks: bool = False,
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Of one-step transitions, in standardised units, without the constant.

        :param state: Shape ``(batch, n)``
        :param action: Shape ``(batch, d)``
        :param next_state: Shape ``(batch, n)``
        :param reward: Shape ``(batch,)``
        :param sample_masks: Whether the masks are probabilities, and which edges are there is drawn anew for the whole
            batch. A weight behind a mask cannot grow to make up for it then, and with the masks themselves in its place, as in
            every prediction, the model's derivative by a cause is about the probability times what it is through the edge. The
            residual path keeps the masks
        :return: That of the transition model, per modelled variable, shape ``(batch,)``, and that of the reward model,
            ``(batch,)``
        """
        of = self._modelled()
        transition_mask, reward_mask = self._transition_mask(of), self._reward_mask(of)
        if sample_masks:
            transition_mask, reward_mask = _drawn(transition_mask), _drawn(reward_mask)
        next_mean, next_std = self._next_state(state, action, transition_mask, of)
        reward_mean, reward_std = self._reward(next_state, action, reward_mask, of)
        log_std = self._bounded(of.outputs(self.transition_log_std))
        transition = 0.5 * ((of.outputs(next_state, 1) - next_mean) / next_std).square() + log_std
        reward_term = 0.5 * ((reward - reward_mean) / reward_std).square() + self._bounded(self.reward_log_std)
        return transition.mean(dim=1), reward_term

    @th.no_grad()
    def action_response(self, state: th.Tensor, action: th.Tensor, of_all: bool = True) -> ActionResponse:
        """
        Predict the next state and the reward under ``do(a)``, with their Jacobians by the action.

        :param state: s, shape ``(batch, n)``
        :param action: a in [-1, 1], shape ``(batch, d)``
        :param of_all: Whether the response is about all states, or about the modelled ones alone
        :return: See :class:`ActionResponse`
        """
        of = ALL if of_all else self._modelled()
        state_std, reward_scale = of.outputs(self.state_std), self.reward_scale
        standardised, inputs = self._network_input(state, action, of)
        residual_std = of.outputs(self.residual_std)
        actions = slice(standardised.shape[1], None)
        noise_std = self._bounded(of.outputs(self.transition_log_std)).exp()
        # In standard deviations from the start: Humanoid's Jacobians fill megabytes, and each pass over them takes time
        change, jacobian = self.transition.forward_and_jacobian(
            inputs, self._transition_mask(of), actions, (1.0 / noise_std).unsqueeze(1), of
        )
        next_standardised = of.outputs(self.state_to_state.diagonal()) * standardised + residual_std * change
        reward_inputs = th.cat([next_standardised.clamp(-self.INPUT_BOUND, self.INPUT_BOUND), action], dim=1)
        reward, reward_gradient = self.reward.forward_and_jacobian(
            reward_inputs, self._reward_mask(of), slice(None), reward_scale, Chosen(None, of.input_indices)
        )
        reward_gradient = reward_gradient.squeeze(1)
        by_next_state, by_action = reward_gradient.split([standardised.shape[1], self.action_dim], dim=1)
        by_next_state = by_next_state * (next_standardised.abs() <= self.INPUT_BOUND) / state_std
        next_state = of.outputs(self.state_mean) + state_std * next_standardised
        if of.output_indices is not None:
            next_state = state.index_copy(1, of.output_indices, next_state)
        return ActionResponse(
            next_state=next_state,
            next_state_std=noise_std * residual_std * state_std,
            standardised_jacobian=jacobian,
            reward=self.reward_mean + reward_scale * reward.squeeze(1),
            reward_std=self._bounded(self.reward_log_std).exp() * reward_scale,
            reward_by_next_state=by_next_state,
            reward_by_action=by_action,
            states=of,
        )
