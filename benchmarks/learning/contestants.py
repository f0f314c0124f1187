"""Who runs: the class of each algorithm and the settings that its users take."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.discovery import FullyConnected, register_discovery_method
from sb3_causalgdp.presets import PRESETS, preset

PEERS = ("sac", "td3", "tqc", "crossq")
VARIANTS: dict[str, dict[str, Any]] = {
    "causalgdp": {},
    "causalgdp_sees_all": {"causal_abstraction": False},
    "causalgdp_true": {"causal_discovery": "distracted_truth"},
    "causalgdp_open": {"causal_discovery": "fully_connected"},
    "causalgdp_perturbed": {
        "causal_discovery": "perturbed",
        "causal_discovery_kwargs": {"method": "partial_r2", "noise": 0.5},
    },
    **{name: preset(name) for name in PRESETS},
}
NAMES = (*VARIANTS, *PEERS)


class DistractedTruth(FullyConnected):
    """
    The graph that an oracle knows of ``Distracted/<task>``: a distracting observation depends on its own past alone, an idle
    action moves nothing, and of the task itself, everything may move everything.
    """

    ADDED = ("noise ", "idle ")

    def __call__(self, statistics: Any, variables: TransitionVariables, previous: CausalGraph | None = None) -> CausalGraph:
        """
        :param statistics: Only the number of rows is read
        :param variables: Names and order of the variables
        :param previous: Not used
        :return: The graph
        """
        graph = super().__call__(statistics, variables)
        own = np.array([not name.startswith(self.ADDED) for name in (*variables.state_names, *variables.action_names)])
        effects = np.append(own[: variables.n_states], True)
        graph.masks[:] = np.outer(effects, own)
        np.fill_diagonal(graph.masks[:-1, : variables.n_states], 1.0)
        graph.method = "distracted_truth"
        return graph


def make_model(algorithm: str, env: Any, seed: int, **arguments: Any) -> Any:
    """
    :param algorithm: One of ``NAMES``
    :param env: The environments
    :param seed: Seed
    :param arguments: Of the constructor, on top of the settings
    :return: The model: CausalGDP with its defaults, as another method, or with a graph that says nothing or a wrong one, the
        others with RL Zoo's settings
    """
    own = algorithm in VARIANTS
    settings = dict(VARIANTS[algorithm]) if own else zoo_settings(algorithm, env.get_attr("spec")[0].id)
    noise_std = settings.pop("noise_std", None)
    if settings.pop("noise_type", None) == "normal":
        from stable_baselines3.common.noise import NormalActionNoise

        n_actions = env.action_space.shape[0]
        settings["action_noise"] = NormalActionNoise(np.zeros(n_actions), noise_std * np.ones(n_actions))
    return class_of(algorithm)(**{"policy": "MlpPolicy", **settings, "env": env, "seed": seed, **arguments})


def class_of(algorithm: str) -> Any:
    """
    :param algorithm: One of ``NAMES``
    :return: Its class; what its settings name is known from then on
    """
    import sb3_contrib
    import stable_baselines3

    from sb3_causalgdp import CausalGDP

    if algorithm == "causalgdp_true":
        register_discovery_method("distracted_truth", DistractedTruth)
    own = {**dict.fromkeys(VARIANTS, CausalGDP), "tqc": sb3_contrib.TQC, "crossq": sb3_contrib.CrossQ}
    return own.get(algorithm) or getattr(stable_baselines3, algorithm.upper())


def zoo_settings(algorithm: str, env_id: str) -> dict[str, Any]:
    """
    :param algorithm: One of ``PEERS``
    :param env_id: Of MuJoCo, version 5
    :return: RL Zoo's settings for version 4 of it, or where RL Zoo has none those of all MuJoCo tasks
    """
    # Not imported, because it patches Gymnasium
    spec = importlib.util.find_spec("rl_zoo3")
    assert spec is not None and spec.origin is not None
    path = Path(spec.origin).parent / "hyperparams" / f"{algorithm}.yml"
    entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    env_id = env_id.rpartition("/")[2]  # the namespace says what was put around the task
    entry = dict(entries.get(env_id.replace("-v5", "-v4")) or entries["HalfCheetah-v4"])
    entry.pop("n_timesteps")
    if isinstance(entry.get("policy_kwargs"), str):
        entry["policy_kwargs"] = eval(entry["policy_kwargs"], {"dict": dict})
    return entry
