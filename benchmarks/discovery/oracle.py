"""
True effects in Gymnasium's MuJoCo tasks, by intervening in the simulator.

    python -m benchmarks.discovery.oracle --env HalfCheetah-v5 --states 500 --seed 0

A behaviour is rolled; at sampled states, one component at a time is moved by half of its standard deviation, up and down, the
simulator makes one step, and the mean absolute change of each next observation component, in its standard deviations, is the
effect. The matrix is laid out as ``CausalGraph.masks``.

The reward's row is about the *next* state. The reward of these tasks pays for the mean velocity over the frames of a step,
which is not a function of (s', a). The row intervenes on the closest one that is: the task's own reward with the root's
velocity in s' for the mean velocity, ``r(s', a) = w_f v_x' + healthy(s') - w_c |a|^2``. How close it comes is kept as
``reward_r2``, its explained variance of the true reward; read a Spearman correlation of the reward's row with it in mind.

Two things to know. Observations of Walker2d and Hopper clip velocities at +-10: a sampled state starts from the clipped ones
and is moved without a clip. And an intervention may push a body into the ground, where the step answers violently: such moves
are possible, however rare, and count like all others.
"""

import argparse
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from sb3_causalgdp.causal import TransitionVariables

ENVIRONMENTS = ("HalfCheetah-v5", "Walker2d-v5", "Hopper-v5")
RESULTS = Path(__file__).parent / "results"
STEP = 0.5  # size of an intervention in standard deviations
SMOOTHNESS = 0.9  # correlation of successive smooth actions

Policy = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Oracle:
    """
    :param effects: Mean absolute changes in standardised units, shape (n + 1, n + d)
    :param state_sd: Standard deviations of the observation, shape (n,)
    :param action_sd: Of the actions, shape (d,)
    :param reward_sd: Of the reward
    :param reward_r2: Variance of the true reward that the function of (s', a) explains
    """

    effects: np.ndarray
    state_sd: np.ndarray
    action_sd: np.ndarray
    reward_sd: float
    reward_r2: float


class Simulator:
    """
    A MuJoCo task that can be put into any state.

    :param env_id: Id of a task whose observation is all positions but the root's x, then all velocities
    """

    def __init__(self, env_id: str) -> None:
        env: Any = gym.make(env_id).unwrapped
        self.env = env
        n_positions, n_velocities = self.env.model.nq - 1, self.env.model.nv
        n_observed = self.env.observation_space.shape[0]
        if n_observed != n_positions + n_velocities:
            raise ValueError(f"{env_id} observes {n_observed} numbers, not its {n_positions} + {n_velocities} coordinates")
        self.n_states, self.n_actions = n_observed, self.env.action_space.shape[0]

    def coordinates(self) -> np.ndarray:
        """Positions and velocities of now without the root's x: the observation before clipping, shape (n,)."""
        return np.concatenate([self.env.data.qpos[1:], self.env.data.qvel])

    def step(self, coordinates: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, float]:
        """
        One step from a state; the same arguments give the same result to the last bit.

        :param coordinates: As ``coordinates`` returns them
        :param action: shape (d,)
        :return: next observation and reward
        """
        # Clears the solver's warm start, which the state does not hold
        mujoco.mj_resetData(self.env.model, self.env.data)
        n_positions = self.env.model.nq - 1
        self.env.set_state(np.concatenate([[0.0], coordinates[:n_positions]]), coordinates[n_positions:])
        observation, reward, *_ = self.env.step(action)
        return observation, float(reward)

    def reward(self, coordinates: np.ndarray, action: np.ndarray) -> float:
        """
        The reward as a function of the next state and the action; see the module.

        :param coordinates: Of the next state
        :param action: shape (d,)
        """
        n_positions = self.env.model.nq - 1
        self.env.data.qpos[1:], self.env.data.qvel[:] = coordinates[:n_positions], coordinates[n_positions:]
        return float(self.env._get_rew(coordinates[n_positions], action)[0])


def uniform_policy(space: gym.spaces.Box, rng: np.random.Generator) -> Policy:
    """
    :param space: Action space
    :param rng: Source of the actions
    :return: actions that are uniform in the bounds
    """
    return lambda observation: rng.uniform(space.low, space.high)


def smooth_policy(space: gym.spaces.Box, rng: np.random.Generator) -> Policy:
    """
    :param space: Action space
    :param rng: Source of the actions
    :return: autocorrelated actions, clipped at the bounds
    """
    middle, half = (space.high + space.low) / 2.0, (space.high - space.low) / 2.0
    inside = rng.standard_normal(space.shape)

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal inside
        inside = SMOOTHNESS * inside + np.sqrt(1.0 - SMOOTHNESS**2) * rng.standard_normal(space.shape)
        return np.clip(middle + 0.6 * half * inside, space.low, space.high)

    return act


def saved_policy(path: str, algorithm: str) -> Policy:
    """
    :param path: Zip that a Stable-Baselines3 algorithm saved
    :param algorithm: ``causalgdp``, or a class of Stable-Baselines3 in any case (``sac``)
    :return: its stochastic actions
    """
    import stable_baselines3

    import sb3_causalgdp

    classes = {name.lower(): value for module in (stable_baselines3, sb3_causalgdp) for name, value in vars(module).items()}
    model = classes[algorithm.lower()].load(path, device="cpu")
    return lambda observation: model.predict(observation, deterministic=False)[0]


def make_policy(behaviour: str, space: gym.spaces.Box, rng: np.random.Generator) -> Policy:
    """
    :param behaviour: ``uniform``, ``smooth`` or ``<algorithm>:<path of a zip>``
    :param space: Action space
    :param rng: Source of the actions
    """
    if behaviour in ("uniform", "smooth"):
        return (uniform_policy if behaviour == "uniform" else smooth_policy)(space, rng)
    algorithm, _, path = behaviour.partition(":")
    if not path:
        raise ValueError(f"behaviour must be 'uniform', 'smooth' or '<algorithm>:<zip>', got {behaviour!r}")
    return saved_policy(path, algorithm)


def collect(env_id: str, n_rows: int, seed: int, behaviour: str = "uniform") -> tuple[np.ndarray, TransitionVariables]:
    """
    Roll a behaviour, with the task's own resets.

    :param env_id: Any environment of flat observations and continuous actions
    :param n_rows: Number of transitions
    :param seed: Seed of the environment and the behaviour
    :param behaviour: See ``make_policy``
    :return: rows [s, a, s', r] and their variables
    """
    env = gym.make(env_id)
    assert isinstance(env.action_space, gym.spaces.Box) and isinstance(env.observation_space, gym.spaces.Box)
    variables = TransitionVariables(
        tuple(f"s{i}" for i in range(env.observation_space.shape[0])),
        tuple(f"a{i}" for i in range(env.action_space.shape[0])),
    )
    policy = make_policy(behaviour, env.action_space, np.random.default_rng(seed))
    rows = np.empty((n_rows, variables.n_variables))
    observation, _ = env.reset(seed=seed)
    for row in rows:
        action = policy(observation)
        following, reward, terminated, truncated, _ = env.step(action)
        row[:] = np.concatenate([observation, action, following, [float(reward)]])
        observation = env.reset()[0] if terminated or truncated else following
    env.close()
    return rows, variables


def measure(env_id: str, n_states: int = 500, seed: int = 0, behaviour: str = "uniform", n_rolled: int = 20_000) -> Oracle:
    """
    Intervene.

    :param env_id: One of ``ENVIRONMENTS``, or another task of the same observation
    :param n_states: Number of states at which to intervene
    :param seed: Seed of everything random
    :param behaviour: See ``make_policy``
    :param n_rolled: Transitions that the standard deviations are taken from, and the states
    """
    rows, variables = collect(env_id, n_rolled, seed, behaviour)
    simulator = Simulator(env_id)
    state_sd, action_sd = rows[:, variables.state].std(axis=0), rows[:, variables.action].std(axis=0)
    reward_sd = float(rows[:, variables.reward].std())
    chosen = np.random.default_rng(seed).choice(n_rolled, n_states, replace=False)

    total = np.zeros((variables.n_states + 1, variables.n_states + variables.n_actions))
    true_rewards, formula_rewards = np.empty(n_states), np.empty(n_states)
    for k, row in enumerate(rows[chosen]):
        before, action = row[variables.state], row[variables.action]
        total[:-1] += _effects_on_next_state(simulator, before, action, state_sd, action_sd)
        _, true_rewards[k] = simulator.step(before, action)
        after = simulator.coordinates()
        formula_rewards[k] = simulator.reward(after, action)
        total[-1] += _effects_on_reward(simulator, after, action, state_sd, action_sd) / reward_sd
    total[:-1] /= state_sd[:, None]
    error = ((true_rewards - formula_rewards) ** 2).mean()
    return Oracle(total / n_states, state_sd, action_sd, reward_sd, float(1.0 - error / true_rewards.var()))


def _moved(
    simulator: Simulator, state: np.ndarray, action: np.ndarray, state_sd: np.ndarray, action_sd: np.ndarray
) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """For each component of (state, action): that pair with the component moved down and up; actions stay in their bounds."""
    space = simulator.env.action_space
    moved = []
    for i in range(len(state) + len(action)):
        pairs = []
        for sign in (-STEP, STEP):
            new_state, new_action = state.copy(), action.copy()
            if i < len(state):
                new_state[i] += sign * state_sd[i]
            else:
                new_action[i - len(state)] += sign * action_sd[i - len(state)]
            pairs.append((new_state, np.clip(new_action, space.low, space.high)))
        moved.append(pairs)
    return moved


def _effects_on_next_state(
    simulator: Simulator, state: np.ndarray, action: np.ndarray, state_sd: np.ndarray, action_sd: np.ndarray
) -> np.ndarray:
    """Mean absolute changes of s', shape (n, n + d)."""
    base, _ = simulator.step(state, action)
    changes = [
        np.mean([np.abs(simulator.step(*pair)[0] - base) for pair in pairs], axis=0)
        for pairs in _moved(simulator, state, action, state_sd, action_sd)
    ]
    return np.stack(changes, axis=1)


def _effects_on_reward(
    simulator: Simulator, after: np.ndarray, action: np.ndarray, state_sd: np.ndarray, action_sd: np.ndarray
) -> np.ndarray:
    """Mean absolute changes of r(s', a), shape (n + d,)."""
    base = simulator.reward(after, action)
    moved = _moved(simulator, after, action, state_sd, action_sd)
    return np.array([np.mean([abs(simulator.reward(*pair) - base) for pair in pairs]) for pairs in moved])


def cached(
    env_id: str, n_states: int = 500, seed: int = 0, behaviour: str = "uniform", folder: Path = RESULTS, redo: bool = False
) -> Oracle:
    """
    ``measure``, or what it once wrote.

    :param env_id: See ``measure``
    :param n_states: See ``measure``
    :param seed: See ``measure``
    :param behaviour: See ``measure``
    :param folder: Where the npz lies
    :param redo: Measure again
    """
    label = behaviour.replace(":", "-").replace("/", "-")
    path = folder / f"oracle_{env_id}_{label}_{n_states}_{seed}.npz"
    if redo or not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, **asdict(measure(env_id, n_states, seed, behaviour)))
    with np.load(path) as stored:
        return Oracle(
            stored["effects"],
            stored["state_sd"],
            stored["action_sd"],
            float(stored["reward_sd"]),
            float(stored["reward_r2"]),
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=list(ENVIRONMENTS))
    parser.add_argument("--states", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--behaviour", default="uniform", help="uniform, smooth or <algorithm>:<zip>")
    parser.add_argument("--folder", type=Path, default=RESULTS)
    parser.add_argument("--redo", action="store_true", help="measure again although the file is there")
    args = parser.parse_args()
    for env_id in args.env:
        oracle = cached(env_id, args.states, args.seed, args.behaviour, args.folder, args.redo)
        print(f"{env_id}: effects {oracle.effects.shape}, reward_r2 {oracle.reward_r2:.3f}")
        print(np.array2string(oracle.effects, precision=2, suppress_small=True, max_line_width=200))


if __name__ == "__main__":
    main()
