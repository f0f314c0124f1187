"""
Trained agents in RL Zoo's folders, from checkpoints of ``run.py`` or from runs of RL Zoo: small enough to be sent.

    python benchmarks/learning/publish.py --env Hopper-v5 --kwargs '{"compile": true}'
    python benchmarks/learning/publish.py --run logs/causalgdp/Pendulum-v1_1
    causalgdp-zoo enjoy --env Hopper-v5 -f rl-trained-agents

A published model has no moments of the optimizers and no statistics of the causal discovery, which take most of a file: it
plays and answers questions as before, and a training that goes on from it begins with new ones. Each agent is evaluated as
``run.py`` does. ``README.md`` and ``checksums.sha256`` of the folder are about all agents in it.
"""

import argparse
import hashlib
import io
import json
import os
import shlex
import shutil
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from run import CHECKPOINTS
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.checkpoints.checkpoint import MODEL
from sb3_causalgdp.checkpoints.store import open_checkpoint
from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.offline.callbacks import note_success
from sb3_causalgdp.zoo.run_folder import RunFolder
from sb3_causalgdp.zoo.versions import installed_versions

ALGORITHM = "causalgdp"
FOLDER = Path(__file__).parents[2] / "rl-trained-agents"
NOT_FOR_PLAYING = ("causal_statistics",)
SHOWN_VERSIONS = ("sb3_causalgdp", "Stable-Baselines3", "PyTorch", "Gymnasium", "mujoco", "gymnasium-robotics")
HEAD = f"""# Trained agents

Made by `python benchmarks/learning/publish.py`, in RL Zoo's folder layout. In the parent folder, run:

```bash
causalgdp-zoo enjoy --env Hopper-v5 -f rl-trained-agents
causalgdp-zoo report rl-trained-agents/{ALGORITHM}/Hopper-v5_1
```

To check the files, run `sha256sum -c checksums.sha256` in this folder. There is one seed of each: these agents show what the
package does, but do not rank algorithms. They include neither the optimizers' moments nor the statistics of causal discovery,
so continuing their training starts with new ones.
"""


# One agent ----------------------------------------------------------------------------------------------------------------


def publish_checkpoint(env: str, seed: int, kwargs: Mapping[str, Any], checkpoints: Path, folder: Path, episodes: int) -> Path:
    """
    :param env: Id of the environment that ``run.py`` trained in
    :param seed: Seed of that training
    :param kwargs: Its arguments of the algorithm
    :param checkpoints: Where ``run.py`` writes checkpoints
    :param folder: Of the trained agents
    :param episodes: How many to evaluate
    :return: Folder of the agent
    """
    with open_checkpoint(checkpoints / f"{env}_{ALGORITHM}_{seed}") as checkpoint, checkpoint.read(MODEL) as file:
        model = CausalGDP.load(io.BytesIO(file.read()), env=make_environments(env, 1), device="cpu")
    steps = int(model.num_timesteps)
    words = ["python", "benchmarks/learning/run.py", "--env", env, "--steps", str(steps), "--seeds", str(seed)]
    words += ["--kwargs", json.dumps(kwargs)] if kwargs else []
    config = {"n_timesteps": steps, "policy": "MlpPolicy", **kwargs}
    arguments: dict[str, Any] = {
        "algo": ALGORITHM,
        "env": env,
        "env_kwargs": None,
        "gym_packages": [],
        "n_timesteps": -1,
        "seed": seed,
    }
    return _publish(model, arguments, config, shlex.join(words), installed_versions(), folder, episodes)


def publish_run(run: RunFolder, folder: Path, episodes: int) -> Path:
    """
    :param run: A complete training of RL Zoo
    :param folder: Of the trained agents
    :param episodes: How many to evaluate
    :return: Folder of the agent
    """
    env = str(run.environment_id)
    model = CausalGDP.load(run.models()["final"], env=make_environments(env, 1), device="cpu")
    command = f"causalgdp-zoo train {(run.command or '').partition(' train ')[2]}".strip()
    return _publish(model, run.arguments, run.entry or {}, command, run.versions, folder, episodes)


def _publish(
    model: CausalGDP,
    arguments: Mapping[str, Any],
    config: Mapping[str, Any],
    command: str,
    versions: Mapping[str, Any],
    folder: Path,
    episodes: int,
) -> Path:
    env, seed = str(arguments["env"]), int(arguments["seed"])
    agent = folder / ALGORITHM / f"{env}_1"
    shutil.rmtree(agent, ignore_errors=True)
    settings = agent / env
    settings.mkdir(parents=True)
    save_small(model, agent / f"{env}.zip")
    for name, content in {"args.yml": arguments, "config.yml": config}.items():
        # With RL Zoo's tag
        (settings / name).write_text(yaml.dump(OrderedDict(content)), encoding="utf-8")
    (settings / "command.txt").write_text(command, encoding="utf-8")
    (settings / "versions.yml").write_text(yaml.safe_dump(dict(versions), sort_keys=False), encoding="utf-8")
    card = {
        "task": env,
        "steps": int(model.num_timesteps),
        "seed": seed,
        **evaluated(agent / f"{env}.zip", env, seed, episodes),
    }
    card |= {"bytes": os.path.getsize(agent / f"{env}.zip"), "command": command}
    card["versions"] = {name: str(versions[name]) for name in SHOWN_VERSIONS if name in versions}
    (settings / "card.yml").write_text(yaml.safe_dump(card, sort_keys=False), encoding="utf-8")
    return agent


def make_environments(env: str, n_envs: int) -> Any:
    """
    :param env: Id of an environment
    :param n_envs: How many
    :return: Them, side by side
    """
    if env not in gym.registry:
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
    return make_vec_env(env, n_envs=n_envs)


def save_small(model: CausalGDP, path: Path) -> None:
    """
    :param model: A model, which loses the moments of its optimizers
    :param path: Where to save it, without what only its training needs
    """
    for name in model._get_torch_save_params()[0]:
        module: Any = model
        for part in name.split("."):
            module = getattr(module, part)
        if isinstance(module, th.optim.Optimizer):
            module.state.clear()
    stream = io.BytesIO()
    model.save(stream, exclude=NOT_FOR_PLAYING)
    with replaced_when_done(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        with zipfile.ZipFile(stream) as saved:
            for name in saved.namelist():
                # Without the time, so that the same model is the same file
                archive.writestr(zipfile.ZipInfo(name), saved.read(name), zipfile.ZIP_DEFLATED)


def evaluated(path: Path, env: str, seed: int, episodes: int) -> dict[str, Any]:
    """
    :param path: A published model
    :param env: Its environment
    :param seed: Of the training
    :param episodes: How many to play, as ``run.py`` does
    :return: Mean and standard deviation of their returns, and the share of successes where the environment tells
    """
    environments = make_environments(env, episodes)
    successes: list[bool | None] = []

    def look(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"]:
            note_success(local["info"])
            successes.append(local["info"].get("is_success"))

    environments.seed(10_000 + seed)
    model = CausalGDP.load(path, env=environments, device="cpu")
    mean_and_std: Any = evaluate_policy(model, environments, n_eval_episodes=episodes, warn=False, callback=look)
    mean, std = mean_and_std
    told = [success for success in successes if success is not None]
    facts = {"episodes": episodes, "return": round(float(mean), 1), "spread": round(float(std), 1)}
    return {**facts, "success_rate": round(float(np.mean(told)), 2)} if told else facts


# All agents ---------------------------------------------------------------------------------------------------------------


def write_table(folder: Path) -> None:
    """
    :param folder: Of trained agents: their README and their checksums are written anew
    """
    cards = [yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*/*/*/card.yml"))]
    lines = ["| task | steps | seed | return (episodes, without noise) | size |", "|---|---|---|---|---|"]
    lines += [
        f"| {card['task']} | {card['steps']:,} | {card['seed']} | {_return(card)} | {card['bytes'] / 1e6:.1f} MB |"
        for card in cards
    ]
    commands = [f"{card['command']}" for card in cards]
    versions = sorted({", ".join(f"{name} {version}" for name, version in card["versions"].items()) for card in cards})
    parts = [HEAD, *lines, "", "Training commands, on one core:", "", "```bash", *commands, "```", "", "Trained with:", ""]
    text = "\n".join([*parts, *(f"- {line}" for line in versions), ""])
    files = sorted(path for path in folder.glob("*/*/*") if path.suffix == ".zip")
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(folder).as_posix()}\n" for path in files]
    for name, content in {"README.md": text, "checksums.sha256": "".join(sums)}.items():
        with replaced_when_done(folder / name) as file:
            file.write_text(content, encoding="utf-8")


def _return(card: Mapping[str, Any]) -> str:
    text = f"{card['return']:,} ± {card['spread']:,} ({card['episodes']})"
    return f"{text}, success rate {card['success_rate']:.0%}" if "success_rate" in card else text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", help="environment of a training of run.py")
    parser.add_argument("--seed", type=int, default=0, help="its seed")
    parser.add_argument("--kwargs", type=json.loads, default={}, help="its --kwargs")
    parser.add_argument("--checkpoints", type=Path, default=CHECKPOINTS, help="where run.py writes them")
    parser.add_argument("--run", type=Path, help="folder of a training of RL Zoo, in place of --env")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    if (arguments.env is None) == (arguments.run is None):
        parser.error("one of --env and --run is needed")
    th.set_num_threads(1)
    folder, episodes = arguments.folder, arguments.episodes
    if arguments.run is not None:
        agent = publish_run(RunFolder(arguments.run), folder, episodes)
    else:
        agent = publish_checkpoint(arguments.env, arguments.seed, arguments.kwargs, arguments.checkpoints, folder, episodes)
    write_table(folder)
    print(f"Wrote {agent}")


if __name__ == "__main__":
    main()
