"""
TD3+BC of d3rlpy (https://github.com/takuseno/d3rlpy) as a contestant.

``with_sampling`` of the configuration: whether the time of its dataset's batches counts, which are gathered row by row.
"""

from typing import Any

from benchmarks.speed.data import load
from benchmarks.speed.workers.protocol import Config, NotAvailable, serve, versions
from benchmarks.speed.workers.torch_contestant import TorchContestant


class TD3BCContestant(TorchContestant):
    """
    :param config: Beside the common keys: ``net_arch``, ``with_sampling``
    """

    def __init__(self, config: Config) -> None:
        try:
            import d3rlpy
        except ImportError as error:
            raise NotAvailable(f"d3rlpy cannot be imported: {error}") from error
        self.batch_size: int = config["batch_size"]
        self.transitions = load(config["transitions"])
        names = ("observations", "actions", "rewards", "terminations")
        terminations = self.transitions["terminations"]
        timeouts = self.transitions["truncations"] * (1.0 - terminations)
        timeouts[-1] = 1.0 - terminations[-1]
        self.dataset = d3rlpy.dataset.MDPDataset(*(self.transitions[name] for name in names), timeouts=timeouts)
        encoder = d3rlpy.models.VectorEncoderFactory(config["net_arch"])
        settings = d3rlpy.algos.TD3PlusBCConfig(
            batch_size=self.batch_size, actor_encoder_factory=encoder, critic_encoder_factory=encoder
        )
        self.algorithm = settings.create(device="cpu")
        self.algorithm.build_with_dataset(self.dataset)
        self.batch = None if config["with_sampling"] else self.dataset.sample_transition_batch(self.batch_size)

    def about(self) -> dict[str, Any]:
        """Versions."""
        return {"versions": versions("d3rlpy", "torch", "numpy")}

    def update(self, n: int) -> None:
        """
        :param n: Number of gradient steps of the critics; the actor makes half as many
        """
        for _ in range(n):
            self.algorithm.update(self.batch or self.dataset.sample_transition_batch(self.batch_size))

    def predict(self, n: int, n_observations: int = 1, deterministic: bool = True) -> None:
        """
        :param n: Number of calls
        :param n_observations: Observations of one call
        :param deterministic: Without noise; this actor has none
        """
        observation = self.transitions["observations"][:n_observations]
        for _ in range(n):
            self.algorithm.predict(observation)


if __name__ == "__main__":
    serve(TD3BCContestant)
