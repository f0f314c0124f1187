"""
What the guidance does to trained policies: how far it moves actions, what the critics say of that, and what is obtained.

    python -m benchmarks.learning.guidance benchmarks/learning/checkpoints/HalfCheetah-v5_causalgdp_0 --precisions 0 1 10 100

Checkpoints of ``run.py``, or folders with several of them, of which the newest is taken: nothing is trained. Actions are
compared in the observations of the unguided episodes (precision 0).
"""

import argparse
import functools
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.offline.study import SELECTION_SEED, returns_of
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.checkpoints.checkpoint import MODEL
from sb3_causalgdp.checkpoints.store import open_checkpoint

MOST_OBSERVATIONS = 2_000
HEAD = ("checkpoint", "precision", "|change of actions|", "change of Q in its standard deviations", "return")


def loaded(path: Path, precision: float) -> CausalGDP:
    """
    :param path: Folder of checkpoints, or one
    :param precision: That of the return that is wished for, ``outcome_guidance_scale``; 0 for no guidance
    :return: The model, acting with it
    """
    settings = {"outcome_guidance_scale": precision} if precision > 0.0 else {"guidance": None}
    with open_checkpoint(path) as checkpoint, checkpoint.read(MODEL) as file:
        return CausalGDP.load(io.BytesIO(file.read()), device="cpu", **settings)


def played(model: CausalGDP, observations: np.ndarray) -> np.ndarray:
    """
    :param model: A model
    :param observations: Shape ``(batch, n)``
    :return: What it does there without noise, shape ``(batch, d)``
    """
    return model.predict(observations, deterministic=True)[0]


def sweep(path: Path, env_id: str, precisions: Sequence[float], episodes: int) -> list[str]:
    """
    :param path: Folder of checkpoints, or one
    :param env_id: The environment
    :param precisions: Without 0, which comes first
    :param episodes: Number of episodes, the same starts for all
    :return: Lines of a table in Markdown
    """
    env = make_vec_env(env_id, n_envs=episodes)
    seen: list[np.ndarray] = []
    plain = loaded(path, 0.0)

    def watched(observations: np.ndarray) -> np.ndarray:
        seen.append(observations)
        return played(plain, observations)

    returns = returns_of(watched, env, SELECTION_SEED)
    lines = [f"| {path.name} | 0 | | | {returns.mean():.0f} +- {returns.std():.0f} |"]
    all_seen = np.concatenate(seen)
    some = np.random.default_rng(0).permutation(len(all_seen))[:MOST_OBSERVATIONS]
    observations = all_seen[some]
    unguided = plain.policy.scale_action(played(plain, observations))
    shown = plain.policy.obs_to_tensor(observations)[0]

    @th.no_grad()
    def mean_q(actions: np.ndarray) -> float:
        return float(plain.policy.critic.smallest(shown, th.as_tensor(actions)).mean())

    before, std = mean_q(unguided), float(plain.policy.return_std)
    for precision in precisions:
        model = loaded(path, precision)
        actions = model.policy.scale_action(played(model, observations))
        gain = (mean_q(actions) - before) / std
        returns = returns_of(functools.partial(played, model), env, SELECTION_SEED)
        moved = np.abs(actions - unguided).mean()
        lines.append(f"| | {precision:g} | {moved:.3f} | {gain:+.4f} | {returns.mean():.0f} +- {returns.std():.0f} |")
    return lines


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, metavar="CHECKPOINT")
    parser.add_argument("--env", help="id of the environment; by default what the folder's name begins with")
    parser.add_argument("--precisions", nargs="+", type=float, default=[1.0, 10.0, 100.0])
    parser.add_argument("--episodes", type=int, default=10)
    arguments = parser.parse_args(argv)
    th.set_num_threads(1)
    print(f"| {' | '.join(HEAD)} |\n{'|---' * len(HEAD)}|")
    for path in arguments.paths:
        precisions = [precision for precision in arguments.precisions if precision > 0.0]
        env_id = arguments.env or path.name.split("_")[0]
        print(*sweep(path, env_id, precisions, arguments.episodes), sep="\n", flush=True)


if __name__ == "__main__":
    main()
