"""Regressions of all next states, or of the reward, on nonlinear features of their possible causes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch as th
from scipy.linalg import cho_solve

from sb3_causalgdp.causal.discovery.evidence import detectable_effect, edge_evidence
from sb3_causalgdp.causal.statistics.basis import N_FUNCTIONS, BasisExpansion, BasisMoments
from sb3_causalgdp.causal.statistics.degenerate import Degeneracy
from sb3_causalgdp.causal.statistics.matrices import cholesky_in_place, inverse_in_place, product, symmetric_product
from sb3_causalgdp.causal.statistics.moments import Moments, Spread, StreamingMoments, leave_one_out, merge

RIDGE = 1e-6  # of a feature's variance: features of many causes may be almost dependent where the causes are not
# Larger, so that where cos^2 + sin^2 is 1 in all rows, what is linear in the cosine is not taken for squares
RIDGE_OF_SQUARES_AND_PRODUCTS = 1e-5
SMALLEST_RESIDUAL = 1e-9  # of the target's variance: what float32 rounding and the ridge leave of an exact function
SMALLEST_DEVIATION = 1e-9  # in units of the standard deviation of all rows: below it, a column does not move in these rows
THINNING = 8
FOLDS = 4
LEAST_FREEDOM = 0.25  # for each feature, of a fit that is asked about rows that it has not seen
FEW_ROWS = 3.0  # for each feature
MOST_OVERFITTING = 3.0  # of half of the targets: above, simpler features say more
CHANGES_AT_ONCE = 2**18  # so that they stay in the processor's cache


class Estimates(NamedTuple):
    """Of p possible causes and their m targets: partial R^2 and effects, each of shape (p, m)."""

    partial_r2: np.ndarray
    effects: np.ndarray


class Tests(NamedTuple):
    """
    Leave-outs of as many features each: of a cause alone, or of linearly dependent ones together.

    :param causes: Index of one of the causes that each is about, shape (q,)
    :param n_features: Number of features that are left out and in use, shape (q, 1)
    :param features: Indices of the features that are left out, shape (q, g)
    :param spread: Covariance of these features given all others, ``[(S^-1)_GG]^-1``, shape (q, g, g)
    :param spreads_behind: By a number of first features, the same of all others: of those behind the linear one, and of the
        products; empty for groups and single features
    """

    causes: np.ndarray
    n_features: np.ndarray
    features: th.Tensor
    spread: th.Tensor
    spreads_behind: dict[int, th.Tensor]


class Fit(NamedTuple):
    """
    Least squares for m targets.

    :param coefficients: In units of the features' and the targets' standard deviations in all rows, shape (F, m)
    :param deviation: Standard deviations of the features in these rows, in the same units, shape (F,)
    :param variance: Of the targets in these rows, in the same units, 1 for those that do not move; shape (m,)
    :param residual: Variance that the features leave, shape (m,)
    """

    coefficients: th.Tensor
    deviation: np.ndarray
    variance: np.ndarray
    residual: np.ndarray


def regression_of_dynamics(statistics: BasisMoments, degeneracy: Degeneracy) -> "Regression":
    """
    :param statistics: Of the features of all transitions
    :param degeneracy: What cannot be told apart among states and actions
    :return: Of the next states, by states and actions
    """
    assert statistics.expansions is not None
    targets = np.arange(statistics.variables.n_variables)[statistics.variables.next_state]
    inputs = statistics.inputs_of_dynamics
    return Regression(statistics, statistics.dynamics, statistics.expansions[0], inputs, targets, degeneracy)


def regression_of_reward(statistics: BasisMoments, degeneracy: Degeneracy) -> "Regression":
    """
    :param statistics: Of the features of all transitions
    :param degeneracy: What cannot be told apart among next states and actions
    :return: Of the reward, by next states and actions
    """
    assert statistics.expansions is not None
    targets, inputs = np.array([statistics.variables.reward]), statistics.inputs_of_reward
    return Regression(statistics, statistics.reward, statistics.expansions[1], inputs, targets, degeneracy)


class Regression:
    """
    Regresses some targets on the features of their possible causes, on all rows, by one factorisation.

    What a part of the rows says is one Newton step away: the second moments of the features there are taken to be those of
    all rows.

    :param statistics: Where the scales and the newest rows come from
    :param moments: Of the features and, behind them, the targets
    :param expansion: The features
    :param inputs: Columns of the p possible causes
    :param targets: Columns of the m targets
    :param degeneracy: What cannot be told apart among the inputs
    """

    def __init__(
        self,
        statistics: BasisMoments,
        moments: StreamingMoments,
        expansion: BasisExpansion,
        inputs: np.ndarray,
        targets: np.ndarray,
        degeneracy: Degeneracy,
    ) -> None:
        self.shape = len(inputs), len(targets)
        self.n_features = expansion.n_features
        self.degeneracy = degeneracy
        self.blocks = moments.blocks
        self.ridge = np.where(expansion.squares_and_products, RIDGE_OF_SQUARES_AND_PRODUCTS, RIDGE)
        spread = statistics.raw.spread()
        deviation = spread.standard_deviation()
        self.target_moves = ~spread.constant[targets]
        self.target_scale = np.where(self.target_moves, deviation[targets], 1.0)

        richest, *simpler = _affordable_features(expansion, degeneracy.kept, moments.count)
        factor = self._fit_by(richest, moments)
        # Where rows are many, the world has changed among them, which simpler features explain no better
        few = moments.count < FEW_ROWS * len(richest)
        moving = self.overfitting[self.target_moves]
        if simpler and few and len(moving) > 0 and np.median(moving) > MOST_OVERFITTING:
            factor = self._fit_by(min(simpler, key=lambda features: self._error_by(features, moments)), moments)
        self.raw_coefficients = self.fit.coefficients * th.from_numpy(self.inverse_scale)[:, None]
        self.penalty = self.ridge[:, None] * self.fit.coefficients.numpy()
        # In double precision: where features do not move, 1 / RIDGE here meets next to nothing in the scores
        self.inverse = inverse_in_place(factor)
        features_of_kept = expansion.features_of(degeneracy.kept)
        self.tests = self._tests(features_of_kept)
        self.features_of_kept = th.from_numpy(features_of_kept)
        self.slopes, self.mean_slopes = self._slopes(statistics, expansion, inputs, 0.5 * deviation[inputs] / expansion.scale)
        self.whole = self._estimates(self.fit)
        self.design_effect = np.ones(self.shape[1])
        """Of each target; known after ``parts``."""

    def _error_by(self, features: np.ndarray, moments: StreamingMoments) -> float:
        """How far off these features are in rows that they were not fitted to: mean logarithm over the targets."""
        self._fit_by(features, moments)
        return float(np.log(np.maximum(self.unseen_residual, self.fit.residual)).mean())

    def _fit_by(self, features: np.ndarray, moments: StreamingMoments) -> np.ndarray:
        """Use these features alone; the factor of their second moments."""
        total = moments.total()
        self.total: Spread = total
        self.used = np.isin(np.arange(self.n_features), features)
        self.freedom = max(total.count - len(features) - 1.0, 1.0)
        deviation = total.standard_deviation()[: self.n_features]
        # A feature that is not used, or does not move, has nothing in common with any other
        moves = self.used & (deviation > SMALLEST_DEVIATION)
        self.inverse_scale = moves / np.where(moves, deviation, 1.0)
        factor = self._factor(total)
        self.fit = self._fit(total, factor)
        self._look_at_unseen()
        return factor

    def r_squared(self) -> np.ndarray:
        """
        :return: share of the targets' variance that the features explain, adjusted for their number, shape (m,)
        """
        total_freedom = self.freedom + int(self.used.sum())
        return np.maximum(1.0 - (self.fit.residual / self.freedom) / (self.fit.variance / total_freedom), 0.0)

    def parts(self) -> Iterator[tuple[Estimates, float]]:
        """
        :return: for each block, what all other rows say, and the share of the weight that it has; none with fewer than two
        """
        if len(self.blocks) < 2:
            return
        scores = np.empty((self.n_features, len(self.blocks), self.shape[1]))
        for i, block in enumerate(self.blocks[:-1]):
            scores[:, i] = self._scores(block)
        # At the minimum all gradients add up to nothing
        np.negative(scores[:, :-1].sum(axis=1), out=scores[:, -1])
        self.design_effect = self._design_effect(scores) * self.overfitting
        squares = [self._squares(block, scores[:, i]) for i, block in enumerate(self.blocks)]
        # One product for all blocks: each alone would read the whole inverse
        steps = symmetric_product(self.inverse, scores.reshape(self.n_features, -1)).reshape(scores.shape)
        del scores
        for i, (block, rest) in enumerate(zip(self.blocks, leave_one_out(self.blocks), strict=True)):
            residual = np.sum(squares[:i] + squares[i + 1 :], axis=0) / rest.count
            yield self._estimates(self._step(steps[:, i], residual, rest)), block.count / self.total.count

    def evidence(self, n_tests: int, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param n_tests: Number of edges that are tested in the whole graph
        :param masks: Of the edges, shape (p, m)
        :return: evidence for the edges, shape (p, m), and the partial R^2 that it could see, shape (m,)
        """
        evidence, unit = np.zeros(self.shape), self.freedom / (self.fit.residual * self.design_effect)
        for test in self.tests:
            explained = self._explained(self.fit, test.features, test.spread).numpy()
            found = edge_evidence(explained * unit / test.n_features, test.n_features, self.freedom, 3 * n_tests)
            if test.spreads_behind and test.features.shape[1] > N_FUNCTIONS:
                # Products are largest where residuals are, too, for which an F-test makes no allowance
                found = np.minimum(found, masks[test.causes])
            for n_first, spread in test.spreads_behind.items():
                # A few features are seen with fewer rows than all
                behind = self._explained(self.fit, test.features[:, n_first:], spread).numpy()
                n_used = self.used[test.features.numpy()[:, :n_first]].sum(axis=1, keepdims=True)
                ratio = np.maximum(explained - behind, 0.0) * unit / n_used
                found = np.maximum(found, edge_evidence(ratio, n_used, self.freedom, 3 * n_tests))
            evidence[test.causes] = found
        for group in self.degeneracy.groups:
            evidence[list(group)] = evidence[group[0]]
        return evidence, detectable_effect(1.0, self.freedom, self.design_effect, 3 * n_tests)

    def _design_effect(self, scores: np.ndarray) -> np.ndarray:
        """From the blocks' scores, shape (F, blocks, m): at least 1, shape (m,)."""
        shares = np.array([block.count for block in self.blocks]) / self.total.count
        n_moving = max(int(np.count_nonzero(self.inverse_scale)), 1)
        residual = self.fit.residual * self.total.count / self.freedom
        independent = n_moving * residual * self.total.count * float(np.sum(shares * (1.0 - shares)))
        return np.maximum(np.einsum("ijk,ijk->k", scores, scores) / independent, 1.0)

    def _look_at_unseen(self) -> None:
        """
        The mean square of the residuals in rows that a fit has not seen, and that in units of what independent rows would
        give, at least 1, each of shape (m,). Many slow features follow the slow errors of a model that is not quite right, and
        are no causes of them.
        """
        self.unseen_residual, self.overfitting = self.fit.residual, np.ones(self.shape[1])
        n_used, n_folds = int(self.used.sum()), min(FOLDS, len(self.blocks))
        errors, n_unseen, expected = np.zeros(self.shape[1]), 0.0, 0.0
        for i in range(n_folds if n_folds > 1 else 0):
            # From everywhere in the recording, so that no time of it is unseen
            rest = merge([block for j, block in enumerate(self.blocks) if j % n_folds != i])
            freedom = rest.count - n_used - 1.0
            if freedom < LEAST_FREEDOM * n_used:
                continue
            fold = merge(self.blocks[i::n_folds])
            errors += self._squared_errors(self._fit(rest, self._factor(rest)), fold, rest)
            n_unseen += fold.count
            expected += fold.count * (1.0 + n_used / freedom)
        if n_unseen > 0.0:
            noise = self.fit.residual * self.total.count / self.freedom
            self.unseen_residual, self.overfitting = errors / n_unseen, np.maximum(errors / (expected * noise), 1.0)

    def _squared_errors(self, fit: Fit, rows: Moments, fitted: Moments) -> np.ndarray:
        """Of a fit to other rows, their sum, in units of the targets' deviations in all rows, shape (m,)."""
        coefficients = fit.coefficients.numpy() * self.inverse_scale[:, None]
        errors = rows.squares[self.n_features :] / self.target_scale**2
        errors -= 2.0 * np.einsum("ij,ij->j", coefficients, rows.cross / self.target_scale)
        errors += np.einsum("ij,ij->j", coefficients, product(rows.comoment, coefficients))
        shift = rows.mean - fitted.mean
        offset = shift[self.n_features :] / self.target_scale - shift[: self.n_features] @ coefficients
        return np.maximum(errors, 0.0) + rows.count * offset**2

    def _factor(self, total: Moments) -> np.ndarray:
        """Cholesky factor of the features' second moments S, in units of their standard deviations; takes the place of
        ``total.comoment``."""
        gram = total.comoment
        gram *= self.inverse_scale / total.count
        gram *= self.inverse_scale[:, None]
        diagonal = np.einsum("ii->i", gram)
        diagonal[self.inverse_scale == 0.0] = 1.0
        diagonal += self.ridge
        return cholesky_in_place(gram)

    def _fit(self, total: Moments, factor: np.ndarray) -> Fit:
        cross = total.cross * self.inverse_scale[:, None] / (total.count * self.target_scale)
        deviation, variance, moves = self._units(total)
        cross[:, ~moves] = 0.0
        coefficients = cho_solve((factor, True), cross, check_finite=False)
        # The ridge takes part of what is explained: b' (S + ridge) b = b' c
        explained = np.einsum("ij,ij->j", coefficients, cross + self.ridge[:, None] * coefficients)
        return Fit(th.from_numpy(coefficients), deviation, variance, _residual(variance - explained, variance))

    def _units(self, spread: Spread) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Deviations of the features and variances of the targets, in units of all rows; and which targets move."""
        variance = spread.squares / spread.count
        deviation = np.sqrt(variance[: self.n_features]) * self.inverse_scale
        variance = variance[self.n_features :] / self.target_scale**2
        moves = self.target_moves & (variance > SMALLEST_DEVIATION**2)
        return deviation, np.where(moves, variance, 1.0), moves

    def _tests(self, features_of_kept: np.ndarray) -> list[Tests]:
        in_group = {member for group in self.degeneracy.groups for member in group}
        left_out: dict[tuple[int, bool], list[tuple[int, np.ndarray]]] = {}
        for cause, features in zip(self.degeneracy.kept.tolist(), features_of_kept, strict=True):
            if cause not in in_group:
                left_out.setdefault((len(features), False), []).append((cause, features))
        for group in self.degeneracy.groups:
            features = np.unique(features_of_kept[np.isin(self.degeneracy.kept, group)])
            left_out.setdefault((len(features), True), []).append((group[0], features))
        tests = []
        for (n_features, of_groups), together in left_out.items():
            causes, indices = (np.array(part) for part in zip(*together, strict=True))
            row, column = indices[:, :, None], indices[:, None, :]
            of_features = self.inverse[np.maximum(row, column), np.minimum(row, column)]
            spread = th.linalg.inv(th.from_numpy(of_features))
            firsts = [] if of_groups else [n_first for n_first in (1, N_FUNCTIONS) if n_first < n_features]
            behind = {n: th.linalg.inv(th.from_numpy(np.ascontiguousarray(of_features[:, n:, n:]))) for n in firsts}
            n_used = self.used[indices].sum(axis=1, keepdims=True)
            tests.append(Tests(causes, n_used, th.from_numpy(indices), spread, behind))
        return tests

    def _slopes(
        self, statistics: BasisMoments, expansion: BasisExpansion, inputs: np.ndarray, half_steps: np.ndarray
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        How the mean absolute change of the targets, shape (q, g, m), and the mean change, shape (q, g, 1), grow with the
        coefficients of the q kept causes' g features.
        """
        standardised = expansion.standardise(statistics.recent[:, inputs])
        if expansion.basis == "linear":
            standardised = standardised[:1]
        elif not expansion.products:
            # What changes with a cause is then a function of it alone: one of its ordered values can stand for its neighbours
            standardised = np.sort(standardised, axis=0)[THINNING // 2 - 1 :: THINNING]
        kept = self.degeneracy.kept
        slopes = th.empty(*self.features_of_kept.shape, self.shape[1], dtype=th.float64)
        differences = th.from_numpy(np.ascontiguousarray(expansion.differences(standardised, kept, half_steps)))
        n_causes = max(1, CHANGES_AT_ONCE // (len(standardised) * self.shape[1]))
        for first in range(0, len(kept), n_causes):
            chunk = slice(first, first + n_causes)
            difference, of_cause = differences[chunk], self.raw_coefficients[self.features_of_kept[chunk]]
            slopes[chunk] = difference.transpose(1, 2) @ th.sign(difference @ of_cause) / len(standardised)
        units = th.from_numpy(self.inverse_scale)[self.features_of_kept][:, :, None]
        return slopes * units, differences.mean(dim=1)[:, :, None] * units

    def _scores(self, block: Moments) -> np.ndarray:
        """
        Of the rows of one block: sums of the products of features and residuals, less the block's part of the ridge. That is
        minus the gradient of what is minimised, in units of the deviations in all rows; shape (F, m).
        """
        scores = block.cross / self.target_scale
        scores -= block.comoment @ self.raw_coefficients.numpy()
        of_features, _, residual = self._shifts(block)
        scores += np.outer(block.count * of_features, residual)
        scores *= self.inverse_scale[:, None]
        scores -= block.count * self.penalty
        return scores

    def _squares(self, block: Moments, scores: np.ndarray) -> np.ndarray:
        """
        :param block: Some of the rows
        :param scores: What ``_scores`` says of it, shape (F, m)
        :return: sums of the squared residuals there, in units of the targets' deviations in all rows, shape (m,)
        """
        _, of_targets, residual = self._shifts(block)
        explained = np.einsum("ij,ij->j", self.raw_coefficients.numpy(), block.cross) / self.target_scale
        explained += np.einsum("ij,ij->j", self.fit.coefficients.numpy(), scores + block.count * self.penalty)
        squares = block.squares[self.n_features :] / self.target_scale**2 - explained + block.count * residual * of_targets
        return np.maximum(squares, 0.0)

    def _shifts(self, block: Moments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far the means of the block's features, shape (F,), and of its targets and residuals, each of shape (m,), are
        from those of all rows."""
        shift = block.mean - self.total.mean
        of_features, of_targets = shift[: self.n_features], shift[self.n_features :] / self.target_scale
        return of_features, of_targets, of_targets - of_features @ self.raw_coefficients.numpy()

    def _step(self, step: np.ndarray, residual: np.ndarray, rest: Spread) -> Fit:
        """
        The fit without some rows.

        :param step: Inverse of the features' second moments, times the scores of the rows that are left out, shape (F, m)
        :param residual: Mean square of the residuals of all others, shape (m,)
        :param rest: Of all others
        """
        deviation, variance, moves = self._units(rest)
        still = deviation <= SMALLEST_DEVIATION
        # Residuals are smaller than the errors, by the features that were fitted to them
        size = np.sqrt(self.total.count / self.freedom) / rest.count
        coefficients = self.fit.coefficients - size * th.from_numpy(step)
        if still.any():
            coefficients[still] = 0.0
        if not moves.all():
            coefficients[:, ~moves] = 0.0
        return Fit(coefficients, deviation, variance, _residual(residual, variance))

    def _estimates(self, fit: Fit) -> Estimates:
        return Estimates(self._partial_r2(fit), self._effects(fit))

    def _partial_r2(self, fit: Fit) -> np.ndarray:
        partial = np.zeros(self.shape)
        for causes, n_features, features, spread, _ in self.tests:
            # Variances instead of sums of squares, as in the adjusted R^2, so that a null edge has 0 on average
            without = self._explained(fit, features, spread).numpy() + fit.residual
            partial[causes] = np.maximum(1.0 - fit.residual * (1.0 + n_features / self.freedom) / without, 0.0)
        for group in self.degeneracy.groups:
            partial[list(group)] = partial[group[0]]
        return partial

    @staticmethod
    def _explained(fit: Fit, features: th.Tensor, spread: th.Tensor) -> th.Tensor:
        """How much the residual grows when some features are left out, shape (q, m)."""
        left_out = fit.coefficients[features]
        # Products of single numbers in a batch are slow
        return _summed(left_out * (spread @ left_out if features.shape[1] > 1 else spread * left_out))

    def _effects(self, fit: Fit) -> np.ndarray:
        effects = np.zeros(self.shape)
        of_causes = fit.coefficients[self.features_of_kept]
        size, mean = _summed(self.slopes * of_causes), _summed(self.mean_slopes * of_causes)
        effects[self.degeneracy.kept] = th.copysign(size, mean).numpy()
        # In standard deviations of these rows: the errors of the scales and of the coefficients partly cancel
        effects *= np.outer(fit.deviation[: self.shape[0]], 1.0 / np.sqrt(fit.variance))
        for variable, (stand_in, sign) in self.degeneracy.stand_in.items():
            effects[variable] = sign * effects[stand_in]
        return effects


def _summed(values: th.Tensor) -> th.Tensor:
    """Over the second dimension."""
    return values[:, 0] if values.shape[1] == 1 else values.sum(dim=1)


def _residual(residual: np.ndarray, variance: np.ndarray) -> np.ndarray:
    return np.maximum(residual, SMALLEST_RESIDUAL * variance)


def _affordable_features(expansion: BasisExpansion, inputs: np.ndarray, n_rows: float) -> Iterator[np.ndarray]:
    """Features of which there are twice as many rows, the richest first, and at last those that are linear."""
    richer = 0
    for functions, products in ((4, True), (4, False), (2, False)):
        features = expansion.subset(inputs, functions, products)
        if len(features) != richer and n_rows >= 2 * len(features) + 2:
            yield features
        richer = len(features)
    linear = expansion.subset(inputs, 1, False)
    if len(linear) != richer or n_rows < 2 * len(linear) + 2:
        yield linear
