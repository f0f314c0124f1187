"""What ``train --optimize-hyperparameters`` searches: sampled parameters, and the arguments that they stand for."""

from collections.abc import Mapping
from typing import Any

import optuna

from sb3_causalgdp.zoo.hyperparameters import merged

NET_ARCHS = {"small": [64, 64], "medium": [256, 256], "big": [400, 300]}
WORLD_MODELS = {"small": [64, 64], "medium": [128, 128, 128], "big": [256, 256, 256, 256]}
# The first two of these need no optional package
SEARCHED_METHODS = ["partial_r2", "notears"]
GUIDANCE_TARGETS = ["return", "reward", "none"]
ACTOR_UPDATES = ["one_step", "chain"]


def sample_causalgdp_params(
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: Mapping[str, Any],
    hyperparams: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """
    Sampler of CausalGDP's hyperparameters, in RL Zoo's form. The space is the same in all trials of a study, as the
    multivariate TPE sampler needs it.

    :param trial: Optuna's trial
    :param n_actions: Number of action components
    :param n_envs: Number of environments
    :param additional_args: What RL Zoo knows: ``using_her_replay_buffer``
    :param hyperparams: The entry of the YAML file, whose ``policy_kwargs`` stay where they are not sampled
    :return: Arguments of the constructor
    """
    entry = hyperparams or {}
    trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True)
    trial.suggest_int("batch_size_pow", 6, 10)
    trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True)
    trial.suggest_float("world_model_learning_rate", 1e-4, 3e-3, log=True)
    trial.suggest_float("tau", 0.001, 0.05, log=True)
    trial.suggest_int("train_freq", 1, 8)
    trial.suggest_categorical("net_arch", list(NET_ARCHS))
    trial.suggest_categorical("world_model", list(WORLD_MODELS))
    # The paper's table has eta from 0.005 to 5; a denoising weight of 1 is for fixed datasets
    trial.suggest_float("eta", 0.005, 5.0, log=True)
    trial.suggest_float("denoising_weight", 1e-4, 1.0, log=True)
    trial.suggest_float("pessimism", 0.0, 1.0)
    trial.suggest_categorical("actor_update", ACTOR_UPDATES)
    trial.suggest_int("policy_delay", 1, 3)
    trial.suggest_int("diffusion_steps", 2, 16, log=True)
    trial.suggest_int("n_action_candidates_pow", 0, 5)
    trial.suggest_float("exploration_noise", 0.05, 0.5, log=True)
    trial.suggest_float("exploration_optimism", -1.0, 1.0)
    trial.suggest_categorical("guidance_target", GUIDANCE_TARGETS)
    trial.suggest_float("guidance_scale", 0.1, 3.0, log=True)
    trial.suggest_float("state_guidance_scale", 0.001, 1.0, log=True)
    trial.suggest_int("causal_refresh_freq", 250, 8000, log=True)
    if not entry.get("causal_discovery_kwargs"):
        # Arguments in the YAML file are those of the method that it names
        trial.suggest_categorical("causal_discovery", SEARCHED_METHODS)
    if entry.get("offline_dataset"):
        trial.suggest_float("offline_fraction", 0.0, 1.0)
    if additional_args.get("using_her_replay_buffer"):
        trial.suggest_int("n_sampled_goal", 1, 5)
        trial.suggest_categorical("goal_selection_strategy", ["final", "episode", "future"])
    hyperparameters = convert_causalgdp_params(trial.params)
    # Display true values
    for key in ("gamma", "batch_size", "n_action_candidates"):
        trial.set_user_attr(key, hyperparameters[key])
    return {key: value for key, value in merged(entry, hyperparameters).items() if key in hyperparameters}


def convert_causalgdp_params(sampled_params: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Parameters of a trial
    :return: Arguments of the constructor
    """
    hyperparams = dict(sampled_params)
    hyperparams["gamma"] = 1.0 - hyperparams.pop("one_minus_gamma")
    for name in ("batch_size", "n_action_candidates"):
        hyperparams[name] = 2 ** hyperparams.pop(f"{name}_pow")
    # As many updates as steps
    hyperparams["gradient_steps"] = hyperparams["train_freq"]
    hyperparams["policy_kwargs"] = {
        "net_arch": NET_ARCHS[hyperparams.pop("net_arch")],
        "world_model_net_arch": WORLD_MODELS[hyperparams.pop("world_model")],
    }
    if hyperparams["guidance_target"] == "none":
        hyperparams.update(guidance=None, guidance_target="return")
    her = {name: hyperparams.pop(name) for name in ("n_sampled_goal", "goal_selection_strategy") if name in hyperparams}
    if her:
        hyperparams["replay_buffer_kwargs"] = her
    return hyperparams
