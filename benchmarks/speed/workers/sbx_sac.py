"""SAC of SBX (https://github.com/araffin/sbx) as a contestant; JAX gets one thread by the environment that the client sets."""

from benchmarks.speed.workers.off_policy import OffPolicyContestant
from benchmarks.speed.workers.protocol import Config, NotAvailable, serve


def make(config: Config) -> OffPolicyContestant:
    """
    :param config: See :class:`OffPolicyContestant`
    """
    try:
        from sbx import SAC
    except ImportError as error:
        raise NotAvailable(f"sbx cannot be imported: {error}") from error
    return OffPolicyContestant(SAC, config)


if __name__ == "__main__":
    serve(make)
