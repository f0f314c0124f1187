"""What all sections share: the arguments, the transitions, who is there, and where results go."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.speed import contestants
from benchmarks.speed.client import Contestant, Field
from benchmarks.speed.data import collect, save, synthetic
from benchmarks.speed.results import Results

HALF_CHEETAH = "HalfCheetah-v5"
HUMANOID = "Humanoid-v5"
ROWS = {HALF_CHEETAH: 10_000, HUMANOID: 5_000}
SYNTHETIC_ROWS = 3_000


class Benchmark:
    """
    :param args: Of the command line
    :param scratch: Folder for the transitions and the processes' output
    """

    def __init__(self, args: argparse.Namespace, scratch: Path) -> None:
        self.args = args
        self.scratch = scratch
        self.rounds: int = args.rounds
        self.updates: int = args.updates
        args.folder.mkdir(parents=True, exist_ok=True)

    def transitions(self, env_id: str) -> str:
        """
        :param env_id: Task
        :return: Path of transitions of uniform actions
        """
        path = self.scratch / f"{env_id}.npz"
        return str(path) if path.exists() else save(path, collect(env_id, ROWS[env_id]))

    def synthetic(self, n_states: int, n_actions: int) -> str:
        """
        :param n_states: n
        :param n_actions: d
        :return: Path of transitions of these sizes
        """
        path = self.scratch / f"synthetic_{n_states}_{n_actions}.npz"
        return str(path) if path.exists() else save(path, synthetic(n_states, n_actions, SYNTHETIC_ROWS))

    def field(self, who: Sequence[Contestant], **more: object) -> Field:
        """
        :param who: Contestants
        :param more: Joined to each configuration
        :return: Their processes
        """
        return Field(who, self.scratch / "workers.log", **{"batch_size": 256, **more})

    def results(self, section: str) -> Results:
        """
        :param section: Name of the files
        """
        return Results(self.args.folder, section)

    def ours(self, settings: list[Contestant]) -> list[Contestant]:
        """
        :param settings: CausalGDP's
        :return: The same, with their compiled twins unless these are not wanted
        """
        return settings if self.args.no_compile else contestants.with_compiled(settings)

    def diffusion_ql(self, diffusion_steps: int = 5) -> list[Contestant]:
        """
        :param diffusion_steps: K
        :return: Diffusion-QL, if a checkout was given
        """
        path = self.args.diffusion_ql_path
        return [contestants.diffusion_ql(path, diffusion_steps)] if path else []

    def authors(self) -> list[Contestant]:
        """The authors' CausalGDP, if a checkout was given."""
        path = self.args.causalgdp_authors_path
        return [contestants.causalgdp_authors(path)] if path else []
