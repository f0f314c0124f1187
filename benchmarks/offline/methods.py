"""What is compared: CausalGDP, what is left of it when parts are taken away, and other libraries' offline algorithms."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch as th

from benchmarks.offline.data import transitions
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.offline.make import MAZE_TASKS
from sb3_causalgdp.offline.maze2d import ReplanningAgent, find_maze

BATCH_SIZE = 256
NET_ARCH = [256, 256]
DISCOUNT = 0.99
# Of all methods: critics and targets are three and four times as fast as is usual for 1,000,000 updates, the study has fewer
ACTOR_LEARNING_RATE = 3e-4
CRITIC_LEARNING_RATE = 1e-3
TARGET_UPDATE = 0.02
# One action of a hundredth of a second changes the return by far less than its mean, by which the Q term is divided, and
# than its standard deviation, in which the guidance counts: with the paper's eta of 3 and 5 and a scale of 1, it clones
MAZE_ETA = 200.0
MAZE_ARGUMENTS: dict[str, Any] = {
    "eta": MAZE_ETA,
    "outcome_guidance_scale": 30.0,
    # The best of ten by a Q that can hardly tell them apart plays the luckiest error
    "n_action_candidates": 1,
}


def all_edges_open(statistics: Any, variables: TransitionVariables, previous: CausalGraph | None = None) -> CausalGraph:
    """
    A discovery that closes no edge.

    :param statistics: Not used
    :param variables: The model's variables
    :param previous: Not used
    :return: The graph of all edges that time allows
    """
    return CausalGraph.fully_connected(variables)


PERTURBED = {"causal_discovery": "perturbed", "causal_discovery_kwargs": {"method": "partial_r2", "noise": 0.5}}
# Arguments of CausalGDP beside those that all of them have
CAUSALGDP_METHODS: dict[str, dict[str, Any]] = {
    "causalgdp": {},
    "notears": {"causal_discovery": "notears"},
    "direct_lingam": {"causal_discovery": "direct_lingam"},
    "perturbed": PERTURBED,
    "open": {"causal_discovery": all_edges_open},
    # With masks that scale the world model's inputs
    "scaled": {"sample_masks": False},
    "notears_scaled": {"causal_discovery": "notears", "sample_masks": False},
    "perturbed_scaled": {**PERTURBED, "sample_masks": False},
    "no_guidance": {"guidance": None},
    "layer_norm": {"policy_kwargs": {"net_arch": NET_ARCH, "critic_normalization": "layer"}},
    # Cloning a distribution means to play samples of it: not the best of ten, and none of exploration's noise
    "bc": {"eta": 0.0, "guidance": None, "n_action_candidates": 1, "exploration_noise": 0.0},
}
RATES = {"actor_learning_rate": ACTOR_LEARNING_RATE, "critic_learning_rate": CRITIC_LEARNING_RATE}
PUBLISHED_RATES = {"actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4, "tau": 0.005}
# d3rlpy's name of the class and its arguments; the same networks, batches, target networks and discount for all.
# But for the learning rates: TD3+BC and IQL: d3rlpy's defaults, which are the papers' and those of CORL's
# configs/offline/*/maze2d; CQL: CORL's configs/offline/cql/maze2d (https://github.com/tinkoff-ai/CORL)
D3RLPY_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "td3_bc": ("TD3PlusBC", {"alpha": 2.5, **RATES}),
    # The weight of the Q term that CausalGDP has
    "td3_bc_200": ("TD3PlusBC", {"alpha": MAZE_ETA, **RATES}),
    "td3_bc_published": ("TD3PlusBC", {"alpha": 2.5, **PUBLISHED_RATES}),
    "iql": ("IQL", {"expectile": 0.7, "weight_temp": 3.0, **RATES}),
    "iql_published": ("IQL", {"expectile": 0.7, "weight_temp": 3.0, **PUBLISHED_RATES}),
    "cql": (
        "CQL",
        {
            "conservative_weight": 10.0,
            "alpha_threshold": 5.0,
            "alpha_learning_rate": 3e-4,
            "initial_alpha": 2.718,
            "n_action_samples": 10,
            "actor_learning_rate": 0.1 * ACTOR_LEARNING_RATE,
            "temp_learning_rate": 0.1 * ACTOR_LEARNING_RATE,
            "critic_learning_rate": CRITIC_LEARNING_RATE,
        },
    ),
}
METHODS = (*CAUSALGDP_METHODS, *D3RLPY_METHODS, "planner")


class Player(Protocol):
    """What an evaluation needs."""

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1], shape ``(batch, d)``, for observations of shape ``(batch, n)``."""


class Learner(Player, Protocol):
    """What the study needs of a method."""

    def train(self, n_updates: int) -> None:
        """Make gradient updates on the dataset."""

    def save(self, path: Path) -> None:
        """Write all that training goes on from."""

    def load(self, path: Path, n_updates: int) -> None:
        """Go back to what was saved after so many updates."""


class CausalGDPLearner:
    """
    :param dataset_id: Minari's id of the dataset
    :param seed: Seed
    :param kwargs: Arguments of CausalGDP
    """

    def __init__(self, dataset_id: str, seed: int, kwargs: dict[str, Any]) -> None:
        self.dataset_id = dataset_id
        self.seed = seed
        self.model = CausalGDP.from_dataset(dataset_id, seed=seed, device="cpu", **kwargs)
        self.plays_samples = self.model.eta == 0.0

    def train(self, n_updates: int) -> None:
        if self.model.offline_buffer is None:
            self.model.preload(self.dataset_id)
        self.model.pretrain(n_updates)

    def predict(self, observations: np.ndarray) -> np.ndarray:
        actions, _ = self.model.predict(observations, deterministic=not self.plays_samples)
        return actions

    def save(self, path: Path) -> None:
        with path.open("wb") as file:  # the path as it is, without a suffix
            self.model.save(file)

    def load(self, path: Path, n_updates: int) -> None:
        with path.open("rb") as file:
            self.model = CausalGDP.load(file, device="cpu", trusted=True)
        # Other batches than those of the first updates
        self.model.set_random_seed(self.seed + n_updates)


class D3rlpyLearner:
    """
    One of d3rlpy's algorithms (https://github.com/takuseno/d3rlpy) with standardised observations, on batches drawn as SB3
    draws them: uniformly, the transitions at the end of a cut episode included.

    :param data: The transitions, as :func:`~benchmarks.offline.data.transitions` gives them
    :param seed: Seed
    :param name: Name of the algorithm
    :param kwargs: Arguments of its configuration
    :raises ImportError: Without d3rlpy
    """

    def __init__(self, data: dict[str, np.ndarray], seed: int, name: str, kwargs: dict[str, Any]) -> None:
        import d3rlpy

        d3rlpy.seed(seed)
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        self.data = data
        self.make_batch = d3rlpy.dataset.TransitionMiniBatch
        observations = self.data["observations"]
        kwargs = dict(kwargs)
        self.batch_size = kwargs.setdefault("batch_size", BATCH_SIZE)
        encoder = d3rlpy.models.VectorEncoderFactory(hidden_units=kwargs.pop("net_arch", NET_ARCH))
        config = getattr(d3rlpy.algos, f"{name}Config")(
            actor_encoder_factory=encoder,
            critic_encoder_factory=encoder,
            **({"value_encoder_factory": encoder} if name == "IQL" else {}),
            observation_scaler=d3rlpy.preprocessing.StandardObservationScaler(
                observations.mean(axis=0), observations.std(axis=0)
            ),
            gamma=DISCOUNT,
            **{"tau": TARGET_UPDATE, **kwargs},
        )
        self.algorithm = config.create(device="cpu")
        self.algorithm.create_impl(observations.shape[1:], self.data["actions"].shape[1])

    def train(self, n_updates: int) -> None:
        ones = np.ones((self.batch_size, 1), dtype=np.float32)
        for _ in range(n_updates):
            rows = self.rng.integers(len(self.data["rewards"]), size=self.batch_size)
            observations, actions, rewards, next_observations, terminations = (values[rows] for values in self.data.values())
            # These algorithms do not read the recorded next actions
            self.algorithm.update(
                self.make_batch(observations, actions, rewards, next_observations, actions, terminations, ones, [])
            )

    def predict(self, observations: np.ndarray) -> np.ndarray:
        return np.clip(self.algorithm.predict(observations.astype(np.float32)), -1.0, 1.0)

    def save(self, path: Path) -> None:
        self.algorithm.save_model(str(path))

    def load(self, path: Path, n_updates: int) -> None:
        self.algorithm.load_model(str(path))
        self.algorithm.set_grad_step(n_updates)
        self.rng = np.random.default_rng([self.seed, n_updates])
        th.manual_seed(self.seed + n_updates)


class Planner:
    """
    The controller that knows the maze and plans anew at every step, for comparison: it learns nothing.

    :param task: Name of the task
    """

    def __init__(self, task: str) -> None:
        self.agent = ReplanningAgent(find_maze(MAZE_TASKS[task][0]))

    def train(self, n_updates: int) -> None:
        pass

    def predict(self, observations: np.ndarray) -> np.ndarray:
        return np.stack([self.agent(observation) for observation in observations])

    def save(self, path: Path) -> None:
        path.touch()

    def load(self, path: Path, n_updates: int) -> None:
        pass


def study_arguments(task: str) -> dict[str, Any]:
    """
    :param task: Name of the task
    :return: Arguments of CausalGDP that all its variants share
    """
    return {
        "policy_kwargs": {"net_arch": NET_ARCH},
        "batch_size": BATCH_SIZE,
        "gamma": DISCOUNT,
        "tau": TARGET_UPDATE,
        "learning_rate": ACTOR_LEARNING_RATE,
        "critic_learning_rate": CRITIC_LEARNING_RATE,
        "denoising_weight": 1.0,
        # Updates are what is counted: each one trains all parts, as the peers' do
        "policy_delay": 1,
        "world_model_delay": 1,
        **(MAZE_ARGUMENTS if task in MAZE_TASKS else {}),
    }


def make_learner(method: str, task: str, seed: int, dataset_id: str, overrides: dict[str, Any] | None = None) -> Learner:
    """
    :param method: One of ``METHODS``
    :param task: Name of the task
    :param seed: Seed
    :param dataset_id: Minari's id of the dataset
    :param overrides: Arguments of the algorithm that replace the study's
    :return: The method, not yet trained
    :raises ValueError: On an unknown method
    """
    overrides = overrides or {}
    if method == "planner":
        return Planner(task)
    if method in D3RLPY_METHODS:
        name, kwargs = D3RLPY_METHODS[method]
        return D3rlpyLearner(transitions(dataset_id), seed, name, {**kwargs, **overrides})
    if method not in CAUSALGDP_METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    return CausalGDPLearner(dataset_id, seed, {**study_arguments(task), **CAUSALGDP_METHODS[method], **overrides})
