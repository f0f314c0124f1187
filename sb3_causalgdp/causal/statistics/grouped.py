"""Statistics of groups of variables, where there are too many for their own."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.basis import BasisMoments, bytes_needed
from sb3_causalgdp.causal.statistics.moments import Spread, check_rows, merge_spread
from sb3_causalgdp.causal.variables import TransitionVariables

LARGEST_CHANGE = 3.0  # of a deviation: beyond it, the groups weigh their members anew
ROWS_GROW_BY = 2.0  # between two times that the groups weigh their members anew


def groups_that_fit(variables: TransitionVariables, max_memory: float) -> tuple[np.ndarray, np.ndarray] | None:
    """
    :param variables: Names and order of the variables
    :param max_memory: Bytes that the moments of linear features may take
    :return: the first state of each group of neighbours, and the first action of each; the groups are of one size, the
        smallest that fits; None if one of the states and one of the actions do not
    """
    largest = max(variables.n_states, variables.n_actions)
    for size in range(1, largest + 1):
        states, actions = np.arange(0, variables.n_states, size), np.arange(0, variables.n_actions, size)
        if bytes_needed(len(states), len(states) + len(actions), "linear") <= max_memory:
            return states, actions
    return None


def _names(names: tuple[str, ...], starts: np.ndarray) -> tuple[str, ...]:
    ends = [*starts[1:].tolist(), len(names)]
    pairs = zip(starts.tolist(), ends, strict=True)
    return tuple(names[first] if end == first + 1 else f"{names[first]}..{names[end - 1]}" for first, end in pairs)


class GroupedStatistics:
    """
    Statistics in which neighbouring variables are one: the mean of its members, each in units of its standard deviation.

    When the standard deviation of a member has changed by more than a factor of 3, the groups start anew; ``wants_history``
    says that older rows may then be fed again, see :class:`~sb3_causalgdp.causal.statistics.basis.BasisMoments`.

    :param variables: Names and order of all variables
    :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
    :param window: Number of newest rows that are kept; None keeps all
    :param max_memory: Bytes that the groups' moments may take; the groups are as small as it allows
    :raises ValueError: when it is too little for any groups
    """

    FIRST_ROWS = 200

    def __init__(
        self,
        variables: TransitionVariables,
        half_life: float | None = None,
        window: int | None = None,
        max_memory: float = 200e6,
    ) -> None:
        starts = groups_that_fit(variables, max_memory)
        if starts is None:
            raise ValueError(f"max_memory is too little for any discovery, got {max_memory!r} bytes")
        self.variables = variables
        states, actions = starts
        groups = TransitionVariables(_names(variables.state_names, states), _names(variables.action_names, actions))
        self.group_variables = groups
        self.remark = (
            f"{variables.n_states} states and {variables.n_actions} actions are too many for max_memory "
            f"({max_memory / 1e6:.0f} MB): each edge is that between two of {groups.n_states} and {groups.n_actions} groups "
            "of neighbours"
        )
        after, reward = variables.next_state.start, variables.reward
        self._starts = np.concatenate([states, variables.n_states + actions, after + states, [reward]])
        self._sizes = np.diff(np.append(self._starts, variables.n_variables))
        # For each state and action, and for each next state and the reward, the column and the row of its group
        n_groups = groups.n_states + groups.n_actions
        self._column_of = np.repeat(np.arange(n_groups), self._sizes[:n_groups])
        self._row_of = np.append(self._column_of[: variables.n_states], groups.n_states)
        self._arguments = (half_life, window, "linear", max_memory)
        self.statistics = BasisMoments(groups, *self._arguments)
        self.wants_history = False
        self.n_samples = 0
        self._spread: Spread | None = None
        self._scaled_by: Spread | None = None
        self._waiting: list[np.ndarray] = []

    @property
    def count(self) -> float:
        """Sum of the weights of the rows from which a graph is found."""
        return self.n_samples if self._scaled_by is None else self.statistics.count

    @property
    def fewest_rows(self) -> float:
        """Sum of the rows' weights that is not fallen below once rows are forgotten."""
        return self.statistics.fewest_rows

    @property
    def rows_since_change(self) -> float:
        """Number of newest rows that are of the world as it is now; infinite as long as no older ones were forgotten."""
        return self.statistics.rows_since_change

    def update(self, rows: npt.ArrayLike) -> None:
        """
        Merge a batch of rows; nothing changes when it raises.

        :param rows: shape (N, 2 n + d + 1), N may be 0; never changed
        :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large values, naming the variables
        """
        rows = self._checked(rows)
        if len(rows) == 0:
            return
        centred = rows - rows[0]
        mean = centred.mean(axis=0)
        new = Spread(float(len(rows)), rows[0] + mean, ((centred - mean) ** 2).sum(axis=0))
        self._spread = new if self._spread is None else merge_spread([self._spread, new])
        self.n_samples += len(rows)
        if self._scaled_by is None and self.n_samples < self.FIRST_ROWS:
            self._waiting.append(rows.copy())
            return
        if self._scaled_by is None:
            self.start()
        elif self._has_changed():
            self.restart()
            self.wants_history = True
        self.statistics.update(self._grouped(rows))
        if self.statistics.wants_history:
            self.statistics.wants_history, self.wants_history = False, True

    def start(self) -> None:
        """Fix the units of the members now, with the rows that there are."""
        if self._scaled_by is None and self.n_samples > 0:
            self._scaled_by = self._spread
            for rows in self._waiting:
                self.statistics.update(self._grouped(rows))
            self._waiting = []

    def restart(self) -> None:
        """Take the units of all rows fed so far, and forget the groups' moments."""
        self._scaled_by = self._spread
        rows_since_change = self.rows_since_change
        self.statistics = BasisMoments(self.group_variables, *self._arguments)
        self.statistics.rows_since_change = rows_since_change
        self._waiting = []

    def refill(self, rows: npt.ArrayLike) -> None:
        """
        Feed rows again that had been fed before the groups started anew; oldest first.

        :param rows: shape (N, 2 n + d + 1)
        :raises ValueError: where ``update`` would raise
        """
        self.wants_history = False
        self.statistics.update(self._grouped(self._checked(rows)))
        self.statistics.wants_history = False

    def spread_out(self, graph: CausalGraph) -> CausalGraph:
        """
        :param graph: The groups' graph
        :return: that of all variables: each has the entries of its group, one that never moved has no edges
        """
        assert self._spread is not None
        constant, variables = self._spread.constant, self.variables
        at = np.ix_(self._row_of, self._column_of)
        masks, effects = graph.masks[at], graph.effects[at]
        targets = np.append(np.arange(variables.n_variables)[variables.next_state], variables.reward)
        still = constant[targets][:, None] | np.vstack(
            [np.tile(constant[variables.causes_of_state], (variables.n_states, 1)), constant[variables.causes_of_reward]]
        )
        masks[still] = effects[still] = 0.0
        actions = self._column_of[variables.n_states :] - self.group_variables.n_states
        return replace(
            graph,
            variables=variables,
            masks=masks,
            effects=effects,
            standard_errors=None if graph.standard_errors is None else graph.standard_errors[at],
            r_squared=None if graph.r_squared is None else graph.r_squared[self._row_of],
            action_vif=None if graph.action_vif is None else graph.action_vif[actions],
            evidence=None if graph.evidence is None else graph.evidence[at],
            # A member can be lost in the mean of its group: that no effect is seen says nothing
            detectable_r2=None if graph.detectable_r2 is None else np.ones(variables.n_states + 1),
            state_vif=None if graph.state_vif is None else graph.state_vif[self._column_of[: variables.n_states]],
            constant_variables=tuple(variables.names[i] for i in np.flatnonzero(constant)),
            duplicated_variables=(),
            n_samples=self.n_samples,
            remarks=(*graph.remarks, self.remark),
        )

    def _checked(self, rows: npt.ArrayLike) -> np.ndarray:
        return check_rows(rows, self.variables.names)

    def _has_changed(self) -> bool:
        assert self._spread is not None and self._scaled_by is not None
        if self._spread.count < ROWS_GROW_BY * self._scaled_by.count:
            return False
        before, now = self._scaled_by.standard_deviation(), self._spread.standard_deviation()
        moving = ~self._spread.constant
        return bool(((now > LARGEST_CHANGE * before) | (before > LARGEST_CHANGE * now))[moving].any())

    def _grouped(self, rows: np.ndarray) -> np.ndarray:
        """Shape (N, columns of the groups' variables)."""
        assert self._scaled_by is not None
        moving = ~self._scaled_by.constant
        scale = moving / np.where(moving, self._scaled_by.standard_deviation(), 1.0)
        return np.add.reduceat((rows - self._scaled_by.mean) * scale, self._starts, axis=1) / self._sizes
