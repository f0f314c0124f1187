import warnings
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sb3_causalgdp.causal.discovery.acyclic import notears, without_cycles
from sb3_causalgdp.causal.discovery.lasso import least_squares_gram, newton_steps, solve_lasso_gram
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.degenerate import Degeneracy, LimitsFinder
from sb3_causalgdp.causal.statistics.jackknife import jackknife_error
from sb3_causalgdp.causal.statistics.matrices import product
from sb3_causalgdp.causal.statistics.moments import Moments, StreamingMoments, leave_one_out
from sb3_causalgdp.causal.variables import TransitionVariables

TINY = np.finfo(np.float64).tiny


class _Part(NamedTuple):
    """Some rows of the graph: those of the m targets, from p inputs."""

    masks: np.ndarray  # (m, p)
    weights: np.ndarray  # (m, p)
    r_squared: np.ndarray  # (m,)
    standard_errors: np.ndarray | None  # (m, p)


def weight_masks(weights: np.ndarray, edge_threshold: float, mask_scale: float) -> np.ndarray:
    """
    ``w^2 / (w^2 + mask_scale^2)``, and 0 where \\|w\\| < ``edge_threshold``.

    :param weights: Weights in standardised units, any shape
    :param edge_threshold: Smallest \\|w\\| of an open edge
    :param mask_scale: The \\|w\\| at which a mask is one half
    :return: masks in [0, 1), the same shape
    """
    squares = weights**2
    masks = squares / (squares + mask_scale**2)
    masks[np.abs(weights) < edge_threshold] = 0.0
    return masks


class Notears:
    """
    NOTEARS (Zheng et al., 2018, https://arxiv.org/abs/1803.01422) on the edges that time allows:
    (s_t, a_t) -> s_{t+1} and (s_{t+1}, a_t) -> r_t.

    Minimises ``1/2 tr((I - W)^T S (I - W)) + sparsity ||W||_1`` with S the second moments. Every graph of these edges is
    acyclic, so NOTEARS' constraint h(W) = 0 holds identically and the problem is convex: one Lasso per target.

    With ``instantaneous``, edges s'_k -> s'_j are estimated as well, and there h(W) = 0 binds: NOTEARS on what (s_t, a_t)
    leaves of s_{t+1} finds their weights B, and a Lasso of (I - B) s_{t+1} on (s_t, a_t) finds the direct weights A. The graph
    holds the effects over all paths, ``(I - B)^{-1} A``: those are what a model of s_{t+1} given (s_t, a_t) alone needs. B
    itself is left in the attribute ``instantaneous_weights``.

    A weight w (in standardised units) becomes a mask by one map: 0 where \\|w\\| < ``edge_threshold``, otherwise
    ``w^2 / (w^2 + mask_scale^2)``, which is half at \\|w\\| = ``mask_scale`` and, by default, 0.90 at 0.15 and 0.99 at 0.5.
    Linearly dependent causes share a mask, the largest among them.

    Standard errors come from moments of at least two blocks, by a jackknife that takes one Newton step from the solution, at
    its support and signs; that of a closed edge is the error of what the L1 norm set to 0.

    :param sparsity: Weight of the L1 norm, not negative; in units of a correlation when ``standardize``. 0 is least squares,
        which has a closed form
    :param edge_threshold: Smallest \\|w\\| of an open edge, not negative
    :param mask_scale: The \\|w\\| at which a mask is one half, positive
    :param max_iterations: Upper limit of the solver's iterations
    :param tolerance: Largest KKT residual, relative to the target's largest second moment with an input
    :param standardize: Solve on the correlation matrix. False solves on the covariance, as the original does, where the
        variables' units decide what is sparse and, among simultaneous variables, what causes what (Reisach et al., 2021,
        https://arxiv.org/abs/2102.13647)
    :param instantaneous: Whether edges inside s_{t+1} are estimated; costs hundreds of matrix exponentials of size n
    :param standard_errors: Whether rows are kept in eight blocks, for standard errors, which doubles the time of a graph; not
        with ``instantaneous``. With a window there are blocks, and so standard errors, in any case
    :param on_degenerate: ``"share"`` lets linearly dependent causes share a mask and gives constant ones none, ``"raise"`` is
        an error that names both
    """

    def __init__(
        self,
        sparsity: float = 0.01,
        edge_threshold: float = 0.02,
        mask_scale: float = 0.05,
        max_iterations: int = 20_000,
        tolerance: float = 1e-5,
        standardize: bool = True,
        instantaneous: bool = False,
        standard_errors: bool = False,
        on_degenerate: str = "share",
    ) -> None:
        for name, number, zero_allowed in (
            ("sparsity", sparsity, True),
            ("edge_threshold", edge_threshold, True),
            ("mask_scale", mask_scale, False),
            ("tolerance", tolerance, False),
        ):
            if not (isinstance(number, int | float | np.number) and 0 <= number < np.inf and (zero_allowed or number > 0)):
                accepted = "0 or above" if zero_allowed else "above 0"
                raise ValueError(f"{name} must be a finite number {accepted}, got {number!r}")
        if not (isinstance(max_iterations, int | np.integer) and max_iterations > 0):
            raise ValueError(f"max_iterations must be an integer above 0, got {max_iterations!r}")
        self.sparsity = sparsity
        self.edge_threshold = edge_threshold
        self.mask_scale = mask_scale
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.standardize = standardize
        self.instantaneous = instantaneous
        self.standard_errors = standard_errors
        self._find_limits = LimitsFinder(on_degenerate)
        self.instantaneous_weights: np.ndarray | None = None
        """Of the last graph: row j holds the direct weights of s'_k on s'_j in standardised units, without cycles, (n, n)."""

    def make_statistics(
        self, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
    ) -> StreamingMoments:
        """
        :param variables: Names and order of the variables
        :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
        :param window: Number of newest rows that are kept; None keeps all
        :return: what this method gathers
        """
        n_blocks = 8 if self.standard_errors else None
        return StreamingMoments(variables.n_variables, half_life, variables.names, window, n_blocks)

    def __call__(
        self, moments: StreamingMoments, variables: TransitionVariables, previous: CausalGraph | None = None
    ) -> CausalGraph:
        """
        Find the graph.

        :param moments: Moments of rows in the order of ``variables``
        :param variables: Names and order of the variables
        :param previous: Graph over the same variables whose weights are the solver's start
        :return: the graph; constant variables have no edges
        :raises ValueError: on fewer than n + d + 2 rows that are not forgotten, when the arguments are not about the same
            variables, or on linearly dependent or constant causes if ``on_degenerate="raise"``
        """
        self._check(moments, variables, previous)
        shape = (variables.n_states + 1, variables.n_states + variables.n_actions)
        start = np.zeros(shape) if previous is None else previous.effects
        problem = _Standardised(moments, self.standardize)
        limits = self._find_limits(problem.correlation, variables)
        now, after, reward = variables.causes_of_state, variables.causes_of_reward, np.array([variables.reward])
        parts = (
            self._solve(problem, now, after[: variables.n_states], limits.of_dynamics, start[:-1], self.instantaneous),
            self._solve(problem, after, reward, limits.of_reward, start[-1:]),
        )
        errors = [part.standard_errors for part in parts if part.standard_errors is not None]
        return CausalGraph(
            variables,
            np.concatenate([part.masks for part in parts]),
            np.concatenate([part.weights for part in parts]),
            method="notears",
            n_samples=moments.n_samples,
            standard_errors=np.concatenate(errors) if len(errors) == len(parts) else None,
            r_squared=np.concatenate([part.r_squared for part in parts]),
            **limits.remarks(),
        )

    def min_rows(self, variables: TransitionVariables) -> int:
        """
        :param variables: Names and order of the variables
        :return: number of rows, not forgotten, that a graph needs
        """
        return variables.n_states + variables.n_actions + 2

    def mask(self, weights: np.ndarray) -> np.ndarray:
        """
        :param weights: Weights in standardised units, any shape
        :return: masks in [0, 1), the same shape
        """
        return weight_masks(weights, self.edge_threshold, self.mask_scale)

    def _check(self, moments: StreamingMoments, variables: TransitionVariables, previous: CausalGraph | None) -> None:
        if moments.n_variables != variables.n_variables:
            raise ValueError(f"moments must hold {variables.n_variables} variables, got {moments.n_variables}")
        needed = self.min_rows(variables)
        # Weights of a half-life do not add up to an integer
        if moments.count < needed - 0.5:
            raise ValueError(
                f"moments must hold at least {needed} rows (states + actions + 2) that are not forgotten, "
                f"got {moments.count:.0f}"
            )
        if previous is not None and previous.variables != variables:
            raise ValueError(f"previous must be over {variables.names}, got {previous.variables.names}")

    def _solve(
        self,
        problem: "_Standardised",
        inputs: np.ndarray,
        targets: np.ndarray,
        degeneracy: Degeneracy,
        initial: np.ndarray,
        instantaneous: bool = False,
    ) -> _Part:
        """
        :param inputs: Columns of the p possible causes
        :param targets: Columns of the m effects
        :param degeneracy: What cannot be told apart among the inputs
        :param initial: Start in standardised units, shape (m, p)
        :param instantaneous: Whether the targets may cause each other
        """
        moves = np.flatnonzero(problem.moving[targets])
        free, targets = inputs[degeneracy.kept], targets[moves]
        chosen = np.ix_(moves, degeneracy.kept)
        units = problem.to_standardised(targets, free)
        gram, cross = problem.second_moments(free, free), problem.second_moments(targets, free)
        # Least squares needs no start
        start = np.broadcast_to(0.0, cross.shape) if self.sparsity == 0.0 else initial[chosen] / units
        errors = None
        if instantaneous:
            among = self._among(problem.second_moments(targets, targets), gram, cross)
            self.instantaneous_weights = np.zeros((len(initial), len(initial)))
            self.instantaneous_weights[np.ix_(moves, moves)] = among * problem.to_standardised(targets, targets)
            to_direct = np.eye(len(targets)) - among
            total = np.linalg.solve(to_direct, self._lasso(gram, to_direct @ cross, to_direct @ start))
        else:
            total = self._lasso(gram, cross, start)
        # Second moments of what the inputs leave of the targets, and the inputs: none after least squares
        left = np.zeros_like(cross) if self.sparsity == 0.0 else cross - product(total, gram)
        if not instantaneous:
            errors = problem.jackknife(free, targets, gram, left, total, self.sparsity)
        weights, r_squared = np.zeros_like(initial), np.zeros(len(initial))
        weights[chosen] = total * units
        r_squared[moves] = problem.r_squared(targets, cross, left, total)
        standard_errors = None
        if errors is not None:
            standard_errors = np.zeros_like(initial)
            standard_errors[chosen] = errors * units
        for variable, (stand_in, sign) in degeneracy.stand_in.items():
            weights[:, variable] = sign * weights[:, stand_in]
            if standard_errors is not None:
                standard_errors[:, variable] = standard_errors[:, stand_in]
        return _Part(degeneracy.share(self.mask(weights)), weights, r_squared, standard_errors)

    def _lasso(self, gram: np.ndarray, cross: np.ndarray, initial: np.ndarray) -> np.ndarray:
        """Weights of shape (m, p) from second moments of the inputs, (p, p), and of these with the targets, (m, p)."""
        solution = solve_lasso_gram(gram, cross.T, self.sparsity, initial.T, self.max_iterations, self.tolerance)
        if not solution.converged:
            warnings.warn(
                f"NOTEARS stopped at max_iterations={self.max_iterations} before tolerance={self.tolerance:g}", stacklevel=4
            )
        return solution.weights.T

    def _among(self, target_moments: np.ndarray, gram: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """Weights among the targets, from the second moments of what the inputs leave of them, shape (m, m)."""
        left = target_moments - cross @ least_squares_gram(gram, cross.T)
        return without_cycles(notears((left + left.T) / 2.0, self.sparsity), self.edge_threshold)


class _Standardised:
    """Second moments in the units in which the problem is solved: all with deviation 1, or the variables' own."""

    def __init__(self, moments: StreamingMoments, standardize: bool) -> None:
        self.blocks = moments.blocks
        total = self.blocks[0] if len(self.blocks) == 1 else moments.total()  # without a copy, which would be felt
        self.shares = np.array([block.count for block in self.blocks]) / total.count
        self.mean = total.mean
        self.moving = ~total.constant
        self.correlation = total.correlation()
        self.deviation = np.where(self.moving, total.standard_deviation(), 1.0)
        self.is_standard = standardize
        self.scale = np.ones_like(self.deviation) if standardize else self.deviation

    def second_moments(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        moments = self.correlation[rows][:, columns]
        return moments if self.is_standard else moments * np.outer(self.scale[rows], self.scale[columns])

    def to_standardised(self, targets: np.ndarray, inputs: np.ndarray) -> float | np.ndarray:
        """Factors that bring weights into standardised units, shape (m, p); 1 where they are."""
        return 1.0 if self.is_standard else np.outer(1.0 / self.scale[targets], self.scale[inputs])

    def r_squared(self, targets: np.ndarray, cross: np.ndarray, left: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        :param cross: Second moments of the targets and the inputs, shape (m, p)
        :param left: Those of the residuals and the inputs, shape (m, p)
        :param weights: In the problem's units, shape (m, p)
        :return: 1 - residual variance / variance, shape (m,)
        """
        explained = np.einsum("ij,ij->i", weights, cross) + np.einsum("ij,ij->i", weights, left)
        return np.clip(explained / self.scale[targets] ** 2, 0.0, 1.0)

    def jackknife(
        self,
        inputs: np.ndarray,
        targets: np.ndarray,
        gram: np.ndarray,
        left: np.ndarray,
        weights: np.ndarray,
        sparsity: float,
    ) -> np.ndarray | None:
        """
        :param left: Second moments of the residuals and the inputs in all rows, shape (m, p)
        :param weights: Solution in the problem's units, shape (m, p)
        :param sparsity: Weight of the L1 norm
        :return: standard errors of the weights, shape (m, p); None when there are not two blocks
        """
        if len(self.blocks) < 2:
            return None
        gradients = []
        for block, share, deviation in zip(self.blocks, self.shares, self._deviations_without, strict=True):
            gradients.append(share / (1.0 - share) * (-left - self._gradient(block, inputs, targets, weights)))
            if self.is_standard:
                # The weight of the L1 norm is in units of a correlation, of the other blocks'
                gradients[-1] += sparsity * (np.outer(deviation[targets], deviation[inputs]) - 1.0) * np.sign(weights)
        slopes = np.stack(gradients).transpose(2, 1, 0)
        changes = -newton_steps(gram, weights.T != 0.0, slopes).transpose(2, 1, 0)
        # A standard deviation, the unit of an effect, is an estimate as well
        units = [d[inputs] / np.maximum(d[targets, None], TINY) for d in self._deviations_without]
        return jackknife_error(weights, [(weights + c) * u for c, u in zip(changes, units, strict=True)], self.shares)

    @cached_property
    def _deviations_without(self) -> list[np.ndarray]:
        """Standard deviations without each block, in those of all rows."""
        return [others.standard_deviation() / self.deviation for others in leave_one_out(self.blocks)]

    def _gradient(self, block: Moments, inputs: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Of half the mean square of the residuals in one block, shape (m, p)."""
        to_units = self.scale / self.deviation
        raw = weights * to_units[inputs]
        gradient = product(raw, block.comoment[np.ix_(inputs, inputs)])
        gradient -= block.comoment[np.ix_(targets, inputs)] * to_units[targets, None]
        # The block's means are not those of all rows
        shift = block.mean - self.mean
        residual = raw @ shift[inputs] - shift[targets] * to_units[targets]
        return (gradient / block.count + np.outer(residual, shift[inputs])) * to_units[inputs]
