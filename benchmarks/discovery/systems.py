"""
Control systems whose causal graph is known: states s, actions a, next states s' and a reward r of (s', a).

Every effect is a sum of terms, each a function of one or two parents, plus Gaussian noise. An edge that is there matters: the
terms' coefficients are calibrated on rolled trajectories, and a system is drawn again until every parent's share of the
variance of its effect is at least 5 % (``MIN_SHARE``). The share is Sobol's total index, by Jansen's estimator: half the mean
squared change of the noise-free effect when the parent's column is shuffled. Noise has 15 % of the variance. In ``slow``
systems effect means the change s' - s (s itself explains nearly all of s'). Where the behaviour ties actions to states
(``confounded``), a parent may add less than its share once all others are known: that is what the kind is for.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sb3_causalgdp.causal import TransitionVariables

KINDS = ("linear", "nonlinear", "outside_basis", "confounded", "irrelevant", "duplicated", "slow")
MIN_SHARE = 0.05
HORIZON = 100  # steps of an episode
MAX_ENDED = 0.05  # share of the steps that end an episode by leaving the bounds: an unstable system is drawn again
LARGEST_STATE = 4.0  # an episode ends where a state leaves [-4, 4] standard deviations, so that products cannot blow up
DISTRACTOR_PERSISTENCE = 0.95
TARGET_ERROR = 1.0  # a squared error of the reward is (s' - 1)^2

Function = Callable[..., np.ndarray]
FUNCTIONS: dict[str, Function] = {
    "linear": lambda x: x,
    "square": lambda x: x**2,
    "sin": np.sin,
    "tanh": np.tanh,
    "product": lambda x, y: x * y,
    "abs": np.abs,
    "saturating_cube": lambda x: x**3 / (1.0 + np.abs(x) ** 3),
    "fast_sin": lambda x: np.sin(2.0 * x),
    "bump": lambda x: np.exp(-(x**2)),
    "x_sin_y": lambda x, y: x * np.sin(y),
    "step": lambda x: np.tanh(6.0 * x),
    "squared_error": lambda x: -((x - TARGET_ERROR) ** 2),
    "control_cost": lambda x: -(x**2),
}
OF_TWO = ("product", "x_sin_y")
LIBRARIES: dict[str, tuple[str, ...]] = {
    "linear": ("linear",),
    "nonlinear": ("square", "sin", "tanh", "product"),
    "mixed": ("linear", "linear", "linear", "square", "sin", "tanh", "product"),
    "outside_basis": ("abs", "saturating_cube", "fast_sin", "bump", "x_sin_y", "step"),
}
DEFAULT_LIBRARY = {"linear": "linear", "nonlinear": "nonlinear", "outside_basis": "outside_basis"}


@dataclass(frozen=True)
class Term:
    """
    ``coefficient * function(parents)``, a part of one effect.

    :param function: Key of ``FUNCTIONS``
    :param parents: One or two columns of the effect's inputs: [s, a] for next states, [s', a] for the reward
    :param share: Share of the effect's variance that the term is calibrated to have, before covariances of the terms
    :param coefficient: Its sign is drawn, its size calibrated
    """

    function: str
    parents: tuple[int, ...]
    share: float
    coefficient: float = 1.0

    def basis(self, inputs: np.ndarray) -> np.ndarray:
        """
        :param inputs: shape (N, n + d)
        :return: the function's values without the coefficient, shape (N,)
        """
        return FUNCTIONS[self.function](*(inputs[:, parent] for parent in self.parents))


@dataclass(frozen=True)
class Effect:
    """
    One next state (or its change) or the reward: intercept + terms + noise.

    :param terms: Noise-free part; none for a constant
    :param noise_share: Share of the noise in the variance
    :param intercept: Calibrated so that the mean is zero
    :param fixed: The coefficients are not to be calibrated
    """

    terms: tuple[Term, ...]
    noise_share: float
    intercept: float = 0.0
    fixed: bool = False

    @property
    def parents(self) -> list[int]:
        """Columns of the inputs that matter, sorted."""
        return sorted({parent for term in self.terms for parent in term.parents})

    def mean(self, inputs: np.ndarray) -> np.ndarray:
        """
        :param inputs: shape (N, n + d)
        :return: noise-free effect, shape (N,)
        """
        values = np.full(len(inputs), self.intercept)
        for term in self.terms:
            values = values + term.coefficient * term.basis(inputs)
        return values

    def calibrated(self, inputs: np.ndarray) -> "Effect":
        """
        :param inputs: shape (N, n + d)
        :return: the effect with mean 0 and variance 1 (noise included) on these inputs, its terms with their shares
        """
        if self.fixed or not self.terms:
            return self
        scaled = []
        for term in self.terms:
            size = np.sqrt(term.share) / term.basis(inputs).std()
            scaled.append(replace(term, coefficient=float(np.copysign(size, term.coefficient))))
        signal = Effect(tuple(scaled), self.noise_share).mean(inputs)
        size = float(np.sqrt(1.0 - self.noise_share) / signal.std())
        terms = tuple(replace(term, coefficient=term.coefficient * size) for term in scaled)
        return Effect(terms, self.noise_share, float(-signal.mean() * size))


@dataclass(frozen=True)
class ControlSystem:
    """
    A system with a known graph.

    :param kind: One of ``KINDS``
    :param variables: Names and order of the variables
    :param dynamics: One effect per state; those of copies and constants have no terms and are not used
    :param reward: Effect whose inputs are [s', a]
    :param rate: None for s' = effect; otherwise s' = s + rate * effect
    :param behaviour: Gains K of the policy a = tanh(K s) + noise, shape (d, n); None for uniform actions in [-1, 1]
    :param action_noise: Standard deviation of the policy's noise
    :param copies: Pairs (copy, original) of states
    :param constant_states: States that never move
    :param constant_actions: Actions that never move
    """

    kind: str
    variables: TransitionVariables
    dynamics: tuple[Effect, ...]
    reward: Effect
    rate: float | None = None
    behaviour: np.ndarray | None = None
    action_noise: float = 0.3
    copies: tuple[tuple[int, int], ...] = ()
    constant_states: tuple[int, ...] = ()
    constant_actions: tuple[int, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Of the next states and, last, the reward."""
        return (*self.dynamics, self.reward)

    @property
    def adjacency(self) -> np.ndarray:
        """True edges, boolean, laid out as ``CausalGraph.masks``: shape (n + 1, n + d), the reward's row about [s', a]."""
        n_states, n_actions = self.variables.n_states, self.variables.n_actions
        edges = np.zeros((n_states + 1, n_states + n_actions), dtype=bool)
        for row, effect in enumerate(self.effects):
            edges[row, effect.parents] = True
        if self.rate is not None:
            edges[:n_states, :n_states] |= np.eye(n_states, dtype=bool)
        for copy, original in self.copies:
            edges[copy] = edges[original]
        return edges

    @property
    def scored(self) -> np.ndarray:
        """Entries that data can decide, boolean, shape (n + 1, n + d): not a copy's column where its original is a cause."""
        decidable = np.ones_like(self.adjacency)
        for copy, original in self.copies:
            decidable[:, copy] = ~self.adjacency[:, original]
        return decidable

    def fold_copies(self, scores: np.ndarray) -> np.ndarray:
        """
        Credit a cause's copy to the cause: a method cannot tell one from the other and may open either.

        :param scores: shape (n + 1, n + d)
        :return: scores with the larger of both in the original's column, to be read at ``scored``
        """
        folded = scores.copy()
        for copy, original in self.copies:
            larger = np.maximum(scores[:, original], scores[:, copy])
            folded[:, original] = np.where(self.adjacency[:, original], larger, scores[:, original])
        return folded

    def expected_next_states(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """
        :param states: shape (N, n)
        :param actions: shape (N, d)
        :return: noise-free s', shape (N, n)
        """
        inputs = np.concatenate([states, actions], axis=1)
        means = np.stack([effect.mean(inputs) for effect in self.dynamics], axis=1)
        return self._tie(means if self.rate is None else states + self.rate * means)

    def expected_reward(self, next_states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """
        :param next_states: shape (N, n)
        :param actions: shape (N, d)
        :return: noise-free r, shape (N,)
        """
        return self.reward.mean(np.concatenate([next_states, actions], axis=1))

    def step(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """
        :param states: shape (N, n)
        :param actions: shape (N, d)
        :param rng: Source of the noise
        :return: s' of shape (N, n) and r of shape (N,), with noise
        """
        sizes = np.sqrt([effect.noise_share for effect in self.dynamics]) * (1.0 if self.rate is None else self.rate)
        next_states = self.expected_next_states(states, actions) + sizes * rng.standard_normal(states.shape)
        next_states = self._tie(next_states)
        noise = np.sqrt(self.reward.noise_share) * rng.standard_normal(len(states))
        return next_states, self.expected_reward(next_states, actions) + noise

    def act(self, states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """
        :param states: shape (N, n)
        :param rng: Source of the noise
        :return: the behaviour's actions, shape (N, d)
        """
        shape = (len(states), self.variables.n_actions)
        if self.behaviour is None:
            actions = rng.uniform(-1.0, 1.0, shape)
        else:
            actions = np.tanh(states @ self.behaviour.T) + self.action_noise * rng.standard_normal(shape)
        actions[:, list(self.constant_actions)] = 0.5
        return actions

    def initial_states(self, n_episodes: int, rng: np.random.Generator) -> np.ndarray:
        """
        :param n_episodes: How many
        :param rng: Source of the draws
        :return: standard normal states, shape (n_episodes, n)
        """
        return self._tie(rng.standard_normal((n_episodes, self.variables.n_states)))

    def sample(self, n_rows: int, rng: np.random.Generator) -> np.ndarray:
        """
        Roll episodes side by side; one ends after ``HORIZON`` steps or where a state leaves its bounds.

        :param n_rows: Number of transitions
        :param rng: Source of everything random
        :return: rows [s, a, s', r], shape (n_rows, 2 n + d + 1)
        """
        n_episodes = max(1, min(1000, n_rows // HORIZON))
        states = self.initial_states(n_episodes, rng)
        age = rng.integers(0, HORIZON, n_episodes)  # episodes do not all end at once
        blocks = []
        for _ in range(-(-n_rows // n_episodes)):
            actions = self.act(states, rng)
            next_states, rewards = self.step(states, actions, rng)
            blocks.append(np.concatenate([states, actions, next_states, rewards[:, None]], axis=1))
            age += 1
            over = (age >= HORIZON) | (np.abs(next_states) > LARGEST_STATE).any(axis=1)
            states = np.where(over[:, None], self.initial_states(n_episodes, rng), next_states)
            age[over] = 0
        return np.concatenate(blocks)[:n_rows]

    def shares(self, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """
        Sobol's total index of every true edge, by shuffling the parent.

        :param rows: Transitions of this system
        :param rng: Source of the shuffles
        :return: share of the effect's variance, shape (n + 1, n + d); 0 where there is no edge
        """
        variables = self.variables
        before = np.concatenate([rows[:, variables.state], rows[:, variables.action]], axis=1)
        after = np.concatenate([rows[:, variables.next_state], rows[:, variables.action]], axis=1)
        result = np.zeros(self.adjacency.shape)
        for row, effect in enumerate(self.effects):
            inputs = before if row < variables.n_states else after
            means = effect.mean(inputs)
            for parent in effect.parents:
                shuffled = inputs.copy()
                shuffled[:, parent] = rng.permutation(shuffled[:, parent])
                change = 0.5 * ((effect.mean(shuffled) - means) ** 2).mean()
                result[row, parent] = change / (means.var() + effect.noise_share)
        return result

    def _tie(self, states: np.ndarray) -> np.ndarray:
        """Give copies their original's value and constants theirs, in place."""
        for copy, original in self.copies:
            states[:, copy] = states[:, original]
        states[:, list(self.constant_states)] = 1.0
        return states

    def _calibrated(self, rng: np.random.Generator) -> "ControlSystem":
        """Coefficients decide where the states go, and where they go decides the coefficients: alternate a few times."""
        system = self
        variables = self.variables
        states = self.initial_states(2000, rng)
        actions = self.act(states, rng)
        for _ in range(6):
            inputs = np.concatenate([states, actions], axis=1)
            system = replace(system, dynamics=tuple(effect.calibrated(inputs) for effect in system.dynamics))
            rows = system.sample(2000, rng)
            states, actions = rows[:, variables.state], rows[:, variables.action]
            after = np.concatenate([rows[:, variables.next_state], actions], axis=1)
            system = replace(system, reward=system.reward.calibrated(after))
        return system


def make_system(
    kind: str,
    rng: np.random.Generator,
    n_states: int = 10,
    n_actions: int = 4,
    noise_share: float = 0.15,
    action_noise: float = 0.3,
    library: str | None = None,
) -> ControlSystem:
    """
    Draw a system.

    :param kind: ``linear``; ``nonlinear`` (products, squares, sin, tanh); ``outside_basis`` (\\|x\\|, saturating cube, sin 2x,
        exp(-x^2), x sin y, a steep step); ``confounded`` (actions a = tanh(K s) + noise); ``irrelevant`` (the last 40 % of the
        states are autocorrelated distractors); ``duplicated`` (the last three states are two exact copies and a constant, the
        last action is constant); ``slow`` (s' = s + 0.05 f)
    :param rng: Source of everything random
    :param n_states: n, at least 6
    :param n_actions: d, at least 2
    :param noise_share: Share of the noise in the variance of every effect
    :param action_noise: Noise of the confounded behaviour, in units of the action's range [-1, 1]
    :param library: Key of ``LIBRARIES``; by default the kind's own, and ``mixed`` for the kinds that are about something else
    :return: the calibrated system
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, got {kind!r}")
    if n_states < 6 or n_actions < 2:
        raise ValueError(f"at least 6 states and 2 actions are needed, got {n_states} and {n_actions}")
    functions = LIBRARIES[library or DEFAULT_LIBRARY.get(kind, "mixed")]
    for _ in range(200):
        system = _draw(kind, rng, n_states, n_actions, noise_share, action_noise, functions)._calibrated(rng)
        rows = system.sample(5000, rng)
        shares = system.shares(rows, rng)
        smallest = min(shares[row, effect.parents].min() for row, effect in enumerate(system.effects) if effect.terms)
        ended = (np.abs(rows[:, system.variables.next_state]) > LARGEST_STATE).any(axis=1).mean()
        # Half a percent above the limit: the estimate itself is a sample
        if smallest >= MIN_SHARE + 0.005 and ended <= MAX_ENDED:
            return system
    raise RuntimeError(f"no stable {kind} system whose edges all have {MIN_SHARE:.0%} of the variance in 200 draws")


def _draw(
    kind: str,
    rng: np.random.Generator,
    n_states: int,
    n_actions: int,
    noise_share: float,
    action_noise: float,
    functions: tuple[str, ...],
) -> ControlSystem:
    """A system whose coefficients are not yet calibrated."""
    copies: tuple[tuple[int, int], ...] = ()
    constant_states: tuple[int, ...] = ()
    constant_actions: tuple[int, ...] = ()
    n_core, n_moving_actions = n_states, n_actions
    if kind == "irrelevant":
        n_core = max(3, round(0.6 * n_states))
    if kind == "duplicated":
        n_core, n_moving_actions = n_states - 3, n_actions - 1
        copies = ((n_states - 3, 0), (n_states - 2, 1))
        constant_states, constant_actions = (n_states - 1,), (n_actions - 1,)
    dynamics = []
    for row in range(n_states):
        if row < n_core:
            parents = _draw_parents(rng, row, n_core, n_states, n_moving_actions)
            terms = _draw_terms(rng, parents, functions)
            if kind == "slow":
                # Drifts back, or the states would wander off
                terms = [Term("linear", (row,), 1.5, -1.0), *(term for term in terms if row not in term.parents)]
            dynamics.append(Effect(tuple(terms), noise_share))
        elif kind == "irrelevant":
            itself = Term("linear", (row,), 1.0, DISTRACTOR_PERSISTENCE)
            dynamics.append(Effect((itself,), 1.0 - DISTRACTOR_PERSISTENCE**2, fixed=True))
        else:
            dynamics.append(Effect((), 0.0))
    return ControlSystem(
        kind,
        TransitionVariables([f"s{i}" for i in range(n_states)], [f"a{i}" for i in range(n_actions)]),  # type: ignore[arg-type]
        tuple(dynamics),
        _draw_reward(rng, n_core, n_states, n_moving_actions, noise_share),
        rate=0.05 if kind == "slow" else None,
        behaviour=rng.standard_normal((n_actions, n_states)) / np.sqrt(n_states) if kind == "confounded" else None,
        action_noise=action_noise,
        copies=copies,
        constant_states=constant_states,
        constant_actions=constant_actions,
    )


def _draw_parents(rng: np.random.Generator, row: int, n_core: int, n_states: int, n_actions: int) -> list[int]:
    """Two to four causes of a next state: itself (70 %), one or two other states, an action; every action gets an effect."""
    others = rng.permutation([i for i in range(n_core) if i != row])
    parents = [int(i) for i in others[: rng.integers(1, 3)]]
    if rng.random() < 0.7:
        parents.insert(0, row)
    if row < n_actions:
        parents.append(n_states + row)
    elif rng.random() < 0.5:
        parents.append(n_states + int(rng.integers(n_actions)))
    return parents


def _draw_terms(rng: np.random.Generator, parents: list[int], functions: tuple[str, ...]) -> list[Term]:
    """Each parent in one term; functions of two take two parents."""
    terms, left = [], [parents[i] for i in rng.permutation(len(parents))]
    while left:
        choices = [name for name in functions if name not in OF_TWO or len(left) > 1]
        function = choices[rng.integers(len(choices))]
        n_taken = 2 if function in OF_TWO else 1
        taken, left = tuple(left[:n_taken]), left[n_taken:]
        terms.append(Term(function, taken, n_taken * rng.uniform(1.0, 2.0), float(rng.choice([-1.0, 1.0]))))
    return terms


def _draw_reward(rng: np.random.Generator, n_core: int, n_states: int, n_actions: int, noise_share: float) -> Effect:
    """Squared errors of one or two next states, two linear ones, control cost of half of the actions (rounded up)."""
    chosen = [int(i) for i in rng.permutation(n_core)]
    n_errors = int(rng.integers(1, 3))
    costly = rng.permutation(n_actions)[: (n_actions + 1) // 2]
    terms = [Term("squared_error", (i,), rng.uniform(1.0, 2.0)) for i in chosen[:n_errors]]
    terms += [Term("linear", (i,), rng.uniform(1.0, 2.0), float(rng.choice([-1.0, 1.0]))) for i in chosen[n_errors:][:2]]
    terms += [Term("control_cost", (n_states + int(i),), rng.uniform(1.0, 2.0)) for i in costly]
    return Effect(tuple(terms), noise_share)


def generate(kind: str, n_rows: int, seed: int, **options: object) -> tuple[np.ndarray, TransitionVariables, np.ndarray]:
    """
    Draw a system and its transitions.

    :param kind: One of ``KINDS``
    :param n_rows: Number of transitions
    :param seed: Seed of the system and of the transitions
    :param options: Further arguments of ``make_system``
    :return: rows [s, a, s', r], their variables, and the true adjacency of shape (n + 1, n + d)
    """
    rng = np.random.default_rng(seed)
    system = make_system(kind, rng, **options)  # type: ignore[arg-type]
    return system.sample(n_rows, rng), system.variables, system.adjacency
