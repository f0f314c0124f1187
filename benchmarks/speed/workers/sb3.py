"""
Stable-Baselines3's SAC and TD3 and sb3-contrib's TQC as contestants.

``algorithm`` of the configuration names the class.
"""

import stable_baselines3

from benchmarks.speed.workers.off_policy import OffPolicyContestant
from benchmarks.speed.workers.protocol import Config, NotAvailable, serve
from benchmarks.speed.workers.torch_contestant import TorchContestant


class SB3Contestant(OffPolicyContestant, TorchContestant):
    """
    :param config: See :class:`OffPolicyContestant`
    """

    def __init__(self, config: Config) -> None:
        name = config["algorithm"]
        if name == "TQC":
            try:
                from sb3_contrib import TQC
            except ImportError as error:
                raise NotAvailable("sb3_contrib is not installed") from error
            super().__init__(TQC, config)
        else:
            super().__init__(getattr(stable_baselines3, name), config)


if __name__ == "__main__":
    serve(SB3Contestant)
