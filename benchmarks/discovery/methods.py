"""
Discovery methods by name, ours and peers, behind one signature: rows and variables in, an ``Estimate`` out.

Peers are optional. They get standardised columns (constants become zero) and estimate weights between all 2n + d + 1
columns, of which the entries of ``CausalGraph.masks`` are read. Their masks are 1 where a weight reaches the threshold that
they publish.
"""

import importlib
import logging
import multiprocessing
import resource
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_causalgdp.causal import DISCOVERY_METHODS, CausalGraph, TransitionVariables, make_discovery
from sb3_causalgdp.causal.discovery import Statistics, make_statistics

PEER_SPARSITY = 0.1  # what NOTEARS' authors run
PEER_THRESHOLD = 0.3  # NOTEARS', DAGMA's and gCastle's default
SAME_SPARSITY = 0.01  # our default: the peers called ``*_allowed`` and ``lasso`` then solve our problem


class Estimate(NamedTuple):
    """
    What a method says of each edge, laid out as ``CausalGraph.masks``.

    ``ranking``: larger for likelier edges. ``masks``: in [0, 1], an edge at 0.5 and above. ``effects``: sizes in standardised
    units. ``probabilities``: whether the masks claim to be probabilities. ``weights``: the effects with their signs.
    """

    ranking: np.ndarray
    masks: np.ndarray
    effects: np.ndarray
    probabilities: bool
    weights: np.ndarray


Fit = Callable[[np.ndarray, TransitionVariables], Estimate]


def gather(name: str, rows: np.ndarray, variables: TransitionVariables, **kwargs: Any) -> Statistics:
    """
    Statistics that one of our methods reads.

    :param name: Key of ``DISCOVERY_METHODS``
    :param rows: [s, a, s', r], shape (N, 2 n + d + 1)
    :param variables: Names and order of the columns
    :param kwargs: Arguments of the method
    """
    statistics = make_statistics(make_discovery(name, **kwargs), variables)
    statistics.update(rows)
    return statistics


def refresh(name: str, statistics: Statistics, variables: TransitionVariables, **kwargs: Any) -> CausalGraph:
    """
    The graph of statistics that are there already: what a refresh during learning costs.

    :param name: Key of ``DISCOVERY_METHODS``
    :param statistics: What ``gather`` returned
    :param variables: Names and order of the columns
    :param kwargs: Arguments of the method
    """
    return make_discovery(name, **kwargs)(statistics, variables)


def fit_ours(name: str, rows: np.ndarray, variables: TransitionVariables, **kwargs: Any) -> CausalGraph:
    """
    The graph of recorded rows, statistics included.

    :param name: Key of ``DISCOVERY_METHODS``
    :param rows: [s, a, s', r], shape (N, 2 n + d + 1)
    :param variables: Names and order of the columns
    :param kwargs: Arguments of the method
    """
    return refresh(name, gather(name, rows, variables, **kwargs), variables, **kwargs)


def ours_estimate(graph: CausalGraph) -> Estimate:
    """
    :param graph: What one of our methods returned
    """
    return Estimate(graph.masks, graph.masks, np.abs(graph.effects), True, graph.effects)


def load_evidence() -> Fit:
    """``partial_r2`` read by its evidence, the probability of an effect at all, in place of its masks."""

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        graph = fit_ours("partial_r2", rows, variables)
        assert graph.evidence is not None
        return Estimate(graph.evidence, graph.evidence, np.abs(graph.effects), True, graph.effects)

    return fit


def standardise(rows: np.ndarray) -> np.ndarray:
    """
    :param rows: shape (N, p)
    :return: columns of mean 0 and standard deviation 1; constants are 0
    """
    centred = rows - rows.mean(axis=0)
    deviation = centred.std(axis=0)
    moving = deviation > 1e-10 * np.maximum(1.0, np.abs(rows.mean(axis=0)))
    return np.where(moving, centred / np.where(moving, deviation, 1.0), 0.0)


def cut(weights: np.ndarray, variables: TransitionVariables) -> np.ndarray:
    """
    Read the edges that time allows out of a full weighted adjacency.

    :param weights: Entry [i, j] is the weight of column i as a cause of column j, shape (2 n + d + 1, 2 n + d + 1)
    :param variables: Names and order of the columns
    :return: shape (n + 1, n + d), laid out as ``CausalGraph.masks``
    """
    before, after = _causes(variables)
    rows = [weights[before, effect] for effect in range(variables.next_state.start, variables.next_state.stop)]
    return np.stack([*rows, weights[after, variables.reward]])


def allowed_edges(variables: TransitionVariables) -> np.ndarray:
    """
    :param variables: Names and order of the columns
    :return: which column may cause which, boolean [cause, effect]: (s, a) -> s' and (s', a) -> r
    """
    allowed = np.zeros((variables.n_variables, variables.n_variables), dtype=bool)
    before, after = _causes(variables)
    allowed[np.ix_(before, np.arange(variables.n_variables)[variables.next_state])] = True
    allowed[after, variables.reward] = True
    return allowed


def _causes(variables: TransitionVariables) -> tuple[np.ndarray, np.ndarray]:
    """Columns [s, a] and [s', a]."""
    columns = np.arange(variables.n_variables)
    before = np.concatenate([columns[variables.state], columns[variables.action]])
    return before, np.concatenate([columns[variables.next_state], columns[variables.action]])


def _peer_estimate(weights: np.ndarray, variables: TransitionVariables, threshold: float) -> Estimate:
    allowed = cut(weights, variables)
    sizes = np.abs(allowed)
    return Estimate(sizes, (sizes >= threshold).astype(float), sizes, False, allowed)


def objective(weights: np.ndarray, rows: np.ndarray, variables: TransitionVariables, sparsity: float = SAME_SPARSITY) -> float:
    """
    What NOTEARS minimises, on standardised rows: half the mean square of the residuals, summed, and the L1 norm.

    :param weights: Signed, laid out as ``CausalGraph.masks``
    :param rows: [s, a, s', r], shape (N, 2 n + d + 1)
    :param variables: Names and order of the columns
    :param sparsity: Weight of the L1 norm
    """
    standardised = standardise(rows)
    before, after = _causes(variables)
    predicted = np.column_stack([standardised[:, before] @ weights[:-1].T, standardised[:, after] @ weights[-1]])
    effects = np.column_stack([standardised[:, variables.next_state], standardised[:, variables.reward]])
    return 0.5 * float(((effects - predicted) ** 2).sum()) / len(rows) + sparsity * float(np.abs(weights).sum())


def agreement(estimate: Estimate, other: Estimate) -> dict[str, float]:
    """
    :param estimate: What a method says that solves our problem
    :param other: What ours says
    :return: the largest difference of two weights, and the number of edges that are at least 0.1 in one alone
    """
    edges, others = np.abs(estimate.weights) >= 0.1, np.abs(other.weights) >= 0.1
    return {
        "weight_gap": float(np.abs(estimate.weights - other.weights).max()),
        "support_gap": int((edges != others).sum()),
    }


def load_zheng_notears(allowed_only: bool = False) -> Fit:
    """
    The authors' linear NOTEARS, package ``notears`` (github.com/xunzheng/notears) on the path.

    :param allowed_only: Bound the edges that time forbids to 0 and take our sparsity: the problem that ours solves
    """
    linear: Any = importlib.import_module("notears.linear")
    minimize = linear.sopt.minimize

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        sparsity = PEER_SPARSITY
        if allowed_only:
            sparsity = SAME_SPARSITY
            open_edges = allowed_edges(variables).ravel()
            bounds = [(0, None) if is_open else (0, 0) for _ in range(2) for is_open in open_edges]

            def bounded(*args: Any, **kwargs: Any) -> Any:
                return minimize(*args, **(kwargs | {"bounds": bounds}))

            # The function builds its bounds inside: put ours in on their way to the optimiser
            linear.sopt = SimpleNamespace(minimize=bounded)
        try:
            weights = linear.notears_linear(standardise(rows), lambda1=sparsity, loss_type="l2", w_threshold=0.0)
        finally:
            linear.sopt = SimpleNamespace(minimize=minimize)
        return _peer_estimate(weights, variables, 0.02 if allowed_only else PEER_THRESHOLD)

    return fit


def load_gcastle_notears() -> Fit:
    """gCastle's NOTEARS, package ``gcastle``, with its defaults."""
    algorithms: Any = importlib.import_module("castle.algorithms")
    logging.getLogger().setLevel(logging.WARNING)

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        learner = algorithms.Notears()
        learner.learn(standardise(rows))
        return _peer_estimate(np.asarray(learner.weight_causal_matrix), variables, PEER_THRESHOLD)

    return fit


def load_dagma(allowed_only: bool = False) -> Fit:
    """
    Linear DAGMA, package ``dagma``, with its defaults.

    :param allowed_only: Exclude the edges that time forbids
    """
    linear: Any = importlib.import_module("dagma.linear")
    linear.tqdm = partial(linear.tqdm, disable=True)

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        excluded = None
        if allowed_only:
            excluded = tuple((int(i), int(j)) for i, j in np.argwhere(~allowed_edges(variables)))
        learner = linear.DagmaLinear(loss_type="l2")
        # Its default list s is changed in place when a step is retried
        weights = learner.fit(standardise(rows), w_threshold=0.0, exclude_edges=excluded, s=[1.0, 0.9, 0.8, 0.7, 0.6])
        return _peer_estimate(weights, variables, PEER_THRESHOLD)

    return fit


def load_lingam(with_prior: bool = False) -> Fit:
    """
    DirectLiNGAM, package ``lingam``; constant columns are left out, where its entropies are not defined.

    :param with_prior: Tell it the paths that time forbids
    """
    lingam: Any = importlib.import_module("lingam")

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        standardised = standardise(rows)
        moving = np.flatnonzero(standardised.any(axis=0))
        prior = None
        if with_prior:
            paths = allowed_edges(variables)
            paths[variables.state, variables.reward] = True
            prior = np.where(paths, -1, 0).T[np.ix_(moving, moving)]
        model = lingam.DirectLiNGAM(prior_knowledge=prior).fit(standardised[:, moving])
        weights = np.zeros((variables.n_variables, variables.n_variables))
        weights[np.ix_(moving, moving)] = model.adjacency_matrix_.T
        # Its adaptive Lasso has chosen the edges already
        return _peer_estimate(weights, variables, 1e-9)

    return fit


def load_correlation() -> Fit:
    """Absolute correlation; an edge from 0.5 on."""

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        standardised = standardise(rows)
        return _peer_estimate(standardised.T @ standardised / len(rows), variables, 0.5)

    return fit


def load_lasso(cross_validated: bool = False) -> Fit:
    """
    scikit-learn's Lasso, one for each effect; an edge where the weight is at least our default threshold.

    :param cross_validated: Choose the sparsity by cross-validation in five folds; otherwise ours is taken
    """
    linear_model: Any = importlib.import_module("sklearn.linear_model")

    def fit(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        standardised = standardise(rows)
        weights = np.zeros((variables.n_variables, variables.n_variables))
        for effect, causes in enumerate(allowed_edges(variables).T):
            if causes.any() and standardised[:, effect].any():
                model = linear_model.LassoCV(cv=5) if cross_validated else linear_model.Lasso(SAME_SPARSITY)
                weights[causes, effect] = model.fit(standardised[:, causes], standardised[:, effect]).coef_
        return _peer_estimate(weights, variables, 0.02)

    return fit


PEERS: dict[str, Callable[[], Fit]] = {
    "zheng_notears": load_zheng_notears,
    "zheng_notears_allowed": partial(load_zheng_notears, allowed_only=True),
    "gcastle_notears": load_gcastle_notears,
    "dagma": load_dagma,
    "dagma_allowed": partial(load_dagma, allowed_only=True),
    "lingam": load_lingam,
    "lingam_prior": partial(load_lingam, with_prior=True),
    "correlation": load_correlation,
    "partial_r2_evidence": load_evidence,
    "lasso": load_lasso,
    "lasso_cv": partial(load_lasso, cross_validated=True),
}


def load(name: str, **kwargs: Any) -> Fit:
    """
    :param name: One of our methods or a key of ``PEERS``
    :param kwargs: Arguments of our method
    :return: a function of rows and variables
    :raises ImportError: when the peer's package is missing
    """
    if name in DISCOVERY_METHODS:
        make_discovery(name, **kwargs)
        return lambda rows, variables: ours_estimate(fit_ours(name, rows, variables, **kwargs))
    if name not in PEERS:
        raise ValueError(f"unknown method {name!r}, known are {sorted(DISCOVERY_METHODS)} and {sorted(PEERS)}")
    return _without_warnings(PEERS[name]())


def _without_warnings(fit: Fit) -> Fit:
    """Peers warn of each degenerate column, thousands of lines long."""

    def quiet(rows: np.ndarray, variables: TransitionVariables) -> Estimate:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return fit(rows, variables)

    return quiet


def load_all(names: list[str], kwargs: dict[str, dict[str, Any]]) -> dict[str, Fit]:
    """
    Those that are installed; the others are named in a line.

    :param names: Methods
    :param kwargs: Arguments by the method's name
    """
    fits = {}
    for name in names:
        try:
            fits[name] = load(name, **kwargs.get(name, {}))
        except ImportError as error:
            print(f"{name}: skipped, {error}", file=sys.stderr, flush=True)
    return fits


@dataclass
class Outcome:
    """
    :param status: ``ok``, ``> limit`` or ``failed``
    :param cpu_seconds: Of the call alone
    :param value: What the call returned
    :param peak_mib: The process's largest resident memory
    :param error: Last line of the traceback
    """

    status: str
    cpu_seconds: float = float("nan")
    value: Any = field(default=None, repr=False)
    peak_mib: float = float("nan")
    error: str = ""


def seconds_per_call(call: Callable[[], Any], min_seconds: float = 0.0) -> tuple[float, Any]:
    """
    :param call: Function without arguments
    :param min_seconds: Repeat the call until it took as many CPU seconds in all
    :return: CPU seconds of one call in this thread, the median, and what the last one returned
    """
    seconds: list[float] = []
    while True:
        # Where CPU seconds are limited, the clock of the process moves by the ticks of the system alone
        start = time.thread_time()
        value = call()
        seconds.append(time.thread_time() - start)
        if sum(seconds) >= min_seconds:
            return float(np.median(seconds)), value


def resident_mib(largest: bool = False) -> float:
    """
    :param largest: Since the process began, instead of now
    :return: MiB of memory that the process holds
    """
    if largest:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def product_gflops(size: int = 1024, repeats: int = 5) -> float:
    """
    :param size: Of the matrices
    :param repeats: The fastest of so many counts
    :return: floating point operations per nanosecond of a product of two matrices of float64, by torch
    """
    matrix = th.rand(size, size, dtype=th.float64)
    return 2e-9 * size**3 / min(seconds_per_call(lambda: matrix @ matrix)[0] for _ in range(repeats))


def run_limited(call: Callable[[], Any], limit_s: float, min_seconds: float = 0.0) -> Outcome:
    """
    Call in a forked child, whose CPU seconds are limited by the system.

    :param call: Function without arguments; what it returns must be picklable
    :param limit_s: Largest CPU seconds of the child
    :param min_seconds: Repeat a faster call, see ``seconds_per_call``
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_in_child, args=(call, limit_s, min_seconds, sender))
    child.start()
    sender.close()
    try:
        outcome = receiver.recv()
    except EOFError:
        outcome = Outcome("> limit")
    child.join()
    if outcome.status != "ok" and child.exitcode not in (0, -24):  # 24 is SIGXCPU
        outcome = Outcome("failed", error=f"exit code {child.exitcode}")
    return outcome


def _in_child(call: Callable[[], Any], limit_s: float, min_seconds: float, sender: Connection) -> None:
    limit = max(1, round(limit_s))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    start = time.thread_time()
    try:
        spent, value = seconds_per_call(call, min_seconds)
        sender.send(Outcome("ok", spent, value, resident_mib(largest=True)))
    except Exception:
        sender.send(Outcome("failed", time.thread_time() - start, error=traceback.format_exc().strip().splitlines()[-1]))
    sender.close()
