from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_causalgdp.causal.discovery.evidence import edge_probability
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.degenerate import LimitsFinder
from sb3_causalgdp.causal.statistics.recent_rows import RecentRows, checked_rows
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.causal.world_model import MaskedWorldModel

HELD_OUT = 0.1
ROWS_AT_ONCE = 64
MOST_TEST_ROWS = 512


class _Differences(NamedTuple):
    """Of one target per row: mean and mean absolute difference for each cause; and the model's error."""

    mean: np.ndarray  # (n + 1, n + d)
    absolute: np.ndarray  # (n + 1, n + d)
    residual: np.ndarray  # (n + 1,), mean square


class WorldModelEffects:
    """
    Discovery by a neural world model: how much does its prediction move with each cause?

    In the algorithm's own world model a closed edge has no gradient at all, so it could never open again. This method
    therefore trains a :class:`~sb3_causalgdp.causal.world_model.MaskedWorldModel` of its own, with all masks 1, on the newest
    rows, and goes on with it at each refresh.

    An effect is the mean difference of the predicted next state (or reward), in its standard deviations, when a cause moves
    from half a standard deviation below to half a one above, the others as they are: its size is the mean of the absolute
    difference, its sign that of the mean.

    A mask is the probability ``Phi[ln(q / threshold) / spread]`` of ``q = e^2 / (e^2 + max(residual, smallest_residual))``,
    the share of the effect e in what the other causes leave: a partial R^2 with a cause that is moved on purpose. The residual
    is the model's mean square error, in units of the target's variance, on a tenth of the rows that it was not trained on. It
    is not taken below ``smallest_residual``: in a simulator without noise every effect would be many times as large as the
    residual, and so would the error of the effects. By default the mask is one half at an effect of 0.039 standard deviations.
    Linearly dependent causes share a mask.

    :param gradient_steps: Gradient steps at each refresh, at least 1
    :param first_gradient_steps: Gradient steps when there is no model to go on with, at least 1
    :param batch_size: Rows of a gradient step, at least 2
    :param learning_rate: Adam's, decays to a hundredth within a refresh, positive
    :param net_arch: Hidden layers of the world model, all of one size; ``[128, 128]`` by default
    :param window: Newest rows that are kept where the caller sets no window, at least 20
    :param threshold: Share q at which a mask is one half, in (0, 1)
    :param spread: Uncertainty of the mask in ln q, positive
    :param smallest_residual: Residual that a mask assumes at least, in units of the target's variance, positive
    :param seed: Of the weights, the batches and the held-out rows; torch's global generator is left as it is
    :param on_degenerate: ``"share"`` lets linearly dependent causes share a mask and gives constant ones none, ``"raise"`` is
        an error that names both
    """

    def __init__(
        self,
        gradient_steps: int = 500,
        first_gradient_steps: int = 2_000,
        batch_size: int = 256,
        learning_rate: float = 2e-3,
        net_arch: Sequence[int] | None = None,
        window: int = 20_000,
        threshold: float = 0.03,
        spread: float = 0.5,
        smallest_residual: float = 0.05,
        seed: int = 0,
        on_degenerate: str = "share",
    ) -> None:
        for name, count, least in (
            ("gradient_steps", gradient_steps, 1),
            ("first_gradient_steps", first_gradient_steps, 1),
            ("batch_size", batch_size, 2),
            ("window", window, 20),
        ):
            if not (isinstance(count, int | np.integer) and count >= least):
                raise ValueError(f"{name} must be an integer of at least {least}, got {count!r}")
        for name, number, most in (
            ("learning_rate", learning_rate, np.inf),
            ("threshold", threshold, 1),
            ("spread", spread, np.inf),
            ("smallest_residual", smallest_residual, np.inf),
        ):
            if not (isinstance(number, int | float | np.number) and 0 < number < most):
                raise ValueError(f"{name} must be a number above 0 and below {most}, got {number!r}")
        self.gradient_steps = gradient_steps
        self.first_gradient_steps = first_gradient_steps
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.net_arch = [128, 128] if net_arch is None else list(net_arch)
        self.window = window
        self.threshold = threshold
        self.spread = spread
        self.smallest_residual = smallest_residual
        self.seed = seed
        self._find_limits = LimitsFinder(on_degenerate)
        self.world_model: MaskedWorldModel | None = None
        """The method's own model, all masks 1, of states and rewards less their means at the first graph; None before it."""
        self._origin = np.zeros(0)
        self._refreshes = 0

    def make_statistics(
        self, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
    ) -> RecentRows:
        """
        :param variables: Names and order of the variables
        :param half_life: Number of new rows after which an old row weighs half in the variables' standard deviations
        :param window: Number of newest rows that are kept; None keeps this method's own ``window``
        :return: what this method gathers
        """
        return RecentRows(variables, half_life, window, default_window=self.window)

    def min_rows(self, variables: TransitionVariables) -> int:
        """
        :param variables: Names and order of the variables
        :return: number of rows that a graph needs
        """
        return variables.n_states + variables.n_actions + 10

    def __call__(
        self, statistics: RecentRows, variables: TransitionVariables, previous: CausalGraph | None = None
    ) -> CausalGraph:
        """
        Train the model on, and read the graph off it.

        :param statistics: What :meth:`make_statistics` made, fed with transitions
        :param variables: Names and order of the variables
        :param previous: Not used: the model itself goes on
        :return: the graph; constant variables have no edges
        :raises ValueError: on fewer than n + d + 10 rows, when the arguments are not about the same variables, or on linearly
            dependent or constant causes if ``on_degenerate="raise"``
        """
        rows = checked_rows(statistics, variables, "world_model", self.min_rows(variables))
        if self.world_model is None or (self.world_model.state_dim, self.world_model.action_dim) != _sizes(variables):
            self.world_model = None
            self._origin = _origin_of(rows, variables)
        # In float64: float32 would lose a small motion far from 0
        rows = rows - self._origin
        generator = th.Generator().manual_seed(self.seed + self._refreshes)
        order = th.randperm(len(rows), generator=generator)
        values = th.as_tensor(rows[order.numpy()], dtype=th.float32)
        n_held_out = max(2, int(HELD_OUT * len(values)))
        held_out, training = values[:n_held_out], values[n_held_out:]
        self._train(training, variables, generator)
        self._refreshes += 1
        assert self.world_model is not None
        return self.from_world_model(self.world_model, held_out.numpy(), variables, statistics)

    def from_world_model(
        self,
        world_model: MaskedWorldModel,
        rows: np.ndarray,
        variables: TransitionVariables,
        statistics: RecentRows | None = None,
    ) -> CausalGraph:
        """
        Read the graph off a trained world model. Where its own masks are closed, there is no effect.

        :param world_model: Trained on the same variables; neither trained nor changed here
        :param rows: Transitions, best those that it has not seen, shape (N, 2 n + d + 1)
        :param variables: Names and order of the variables
        :param statistics: Gives the standard deviations; those of the rows by default
        :return: the graph
        """
        if (world_model.state_dim, world_model.action_dim) != (variables.n_states, variables.n_actions):
            raise ValueError(
                f"world_model must have {variables.n_states} states and {variables.n_actions} actions, "
                f"got {world_model.state_dim} and {world_model.action_dim}"
            )
        if statistics is None:
            statistics = RecentRows(variables)
            statistics.update(rows)
            checked_rows(statistics, variables, "world_model", self.min_rows(variables))
        moments = statistics.moments.total()
        deviation = np.where(moments.constant, 0.0, moments.standard_deviation())
        differences = _differences(world_model, np.asarray(rows)[:MOST_TEST_ROWS], variables, deviation)
        n_states = variables.n_states
        limits = self._find_limits(moments.correlation(), variables)
        probability = self._probability(differences)
        masks = [limits.of_dynamics.share(probability[:n_states]), limits.of_reward.share(probability[n_states:])]
        return CausalGraph(
            variables,
            np.concatenate(masks),
            np.where(differences.mean < 0.0, -1.0, 1.0) * differences.absolute,
            method="world_model",
            n_samples=statistics.n_samples,
            r_squared=np.clip(1.0 - differences.residual, 0.0, 1.0),
            **limits.remarks(),
        )

    def _probability(self, differences: _Differences) -> np.ndarray:
        squares = differences.absolute**2
        share = squares / (squares + np.maximum(differences.residual, self.smallest_residual)[:, None])
        return edge_probability(share, np.zeros_like(share), self.threshold, self.spread)

    def _train(self, rows: th.Tensor, variables: TransitionVariables, generator: th.Generator) -> None:
        n_steps = self.gradient_steps
        n_states, n_actions = variables.n_states, variables.n_actions
        if self.world_model is None:
            n_steps = self.first_gradient_steps
            with th.random.fork_rng(devices=[]):
                th.manual_seed(self.seed)
                self.world_model = MaskedWorldModel(n_states, n_actions, self.net_arch)
        state, action, next_state, reward = _columns(rows, variables)
        self.world_model.update_statistics(state, next_state, reward)
        optimizer = th.optim.Adam(self.world_model.parameters(), lr=self.learning_rate)
        schedule = th.optim.lr_scheduler.CosineAnnealingLR(optimizer, n_steps, eta_min=0.01 * self.learning_rate)
        for _ in range(n_steps):
            batch = th.randint(len(rows), (min(self.batch_size, len(rows)),), generator=generator)
            losses = self.world_model.negative_log_likelihood(state[batch], action[batch], next_state[batch], reward[batch])
            loss = losses[0].mean() * n_states + losses[1].mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()


def _sizes(variables: TransitionVariables) -> tuple[int, int]:
    return variables.n_states, variables.n_actions


def _origin_of(rows: np.ndarray, variables: TransitionVariables) -> np.ndarray:
    """The means of the rewards and of the states, which s and s' share, shape ``(2 n + d + 1,)``."""
    origin = np.zeros(variables.n_variables)
    origin[variables.state] = origin[variables.next_state] = rows[:, variables.state].mean(axis=0)
    origin[variables.reward] = rows[:, variables.reward].mean()
    return origin


def _columns(rows: th.Tensor, variables: TransitionVariables) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
    state, action, next_state = rows[:, variables.state], rows[:, variables.action], rows[:, variables.next_state]
    return state.contiguous(), action.contiguous(), next_state.contiguous(), rows[:, variables.reward].contiguous()


@th.no_grad()
def _differences(
    world_model: MaskedWorldModel, rows: np.ndarray, variables: TransitionVariables, deviation: np.ndarray
) -> _Differences:
    """
    :param rows: Shape (N, 2 n + d + 1)
    :param deviation: Standard deviations of all variables, 0 for those that do not move, shape (2 n + d + 1,)
    """
    n_states, n_inputs = variables.n_states, variables.n_states + variables.n_actions
    state, action, next_state, reward = _columns(th.as_tensor(rows, dtype=th.float32), variables)
    of_target = np.append(deviation[variables.next_state], deviation[variables.reward])
    inverse = np.divide(1.0, of_target, out=np.zeros_like(of_target), where=of_target > 0.0)
    mean, absolute = np.zeros((n_states + 1, n_inputs)), np.zeros((n_states + 1, n_inputs))
    sources = (
        (state, deviation[variables.state], lambda s, a: world_model.predict_next_state(s, a)[0], slice(0, n_states)),
        (
            next_state,
            deviation[variables.next_state],
            lambda s, a: world_model.predict_reward(s, a)[0][:, None],
            slice(n_states, None),
        ),
    )
    for first, deviation_of_first, predict, targets in sources:
        half_steps = th.as_tensor(np.diag(0.5 * np.append(deviation_of_first, deviation[variables.action])), dtype=th.float32)
        for part in range(0, len(rows), ROWS_AT_ONCE):
            inputs = th.cat([first, action], dim=1)[part : part + ROWS_AT_ONCE, None]
            both = th.stack([inputs + half_steps, inputs - half_steps]).flatten(0, 2)
            above, below = predict(both[:, :n_states], both[:, n_states:]).view(2, len(inputs), n_inputs, -1)
            change = (above - below).transpose(1, 2).double().numpy() * inverse[targets][:, None]
            mean[targets] += change.sum(axis=0) / len(rows)
            absolute[targets] += np.abs(change).sum(axis=0) / len(rows)
    errors = th.cat(
        [
            world_model.predict_next_state(state, action)[0] - next_state,
            (world_model.predict_reward(next_state, action)[0] - reward)[:, None],
        ],
        dim=1,
    )
    residual = errors.double().square().mean(dim=0).numpy() * inverse**2
    return _Differences(mean, absolute, residual)
