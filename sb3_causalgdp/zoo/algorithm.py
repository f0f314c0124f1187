"""CausalGDP as RL Zoo is to know it."""

from typing import Any

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.hints import how_to_install

ALGORITHM = "causalgdp"
ZOO_HINT = how_to_install("zoo")
TRUST_OPTION = "--trusted"


class SetupError(Exception):
    """An experiment could not be set up: what is wrong with the entry, the environment or the command line."""


class WithoutReplayBuffer(CausalGDP):
    """CausalGDP for playing: room for one transition, which RL Zoo gives to algorithms that it knows."""

    @classmethod
    def load(cls, *args: Any, **kwargs: Any) -> Any:
        return super().load(*args, **{"buffer_size": 1, "optimize_memory_usage": False, **kwargs})


class TrustingCausalGDP(CausalGDP):
    """CausalGDP for files that may run code."""

    @classmethod
    def load(cls, *args: Any, **kwargs: Any) -> Any:
        return super().load(*args, **{"trusted": True, **kwargs})

    def load_replay_buffer(self, *args: Any, **kwargs: Any) -> None:
        super().load_replay_buffer(*args, **{"trusted": True, **kwargs})


class TrustingWithoutReplayBuffer(WithoutReplayBuffer, TrustingCausalGDP):
    """The same for playing."""
