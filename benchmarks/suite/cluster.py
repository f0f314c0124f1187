"""Jobs on a Ray cluster."""

from concurrent.futures import Future
from pathlib import Path
from typing import Any

from benchmarks.suite.jobs import ROOT, Job, run_in_process
from sb3_causalgdp.hints import how_to_install


class RayExecutor:
    """
    The machines of a Ray cluster, one job for each CPU. Ray starts the jobs of a machine that was lost on another one.

    Results are sent to this machine. Checkpoints stay in ``folder`` on the machine of the job: with a shared file system, a
    job goes on where the lost machine left it, and begins anew without.

    :param folder: Folder of the benchmark, the same path on all machines
    :param address: Address of the cluster, ``"auto"`` for the one that runs on this machine, ``"local"`` for a new one
    :param kwargs: Arguments of ``ray.init``
    :raises ImportError: Without Ray
    """

    def __init__(self, folder: Path, address: str = "auto", **kwargs: Any) -> None:
        try:
            import ray
        except ImportError as error:
            raise ImportError(f"running on a cluster needs Ray: {how_to_install('cluster')}") from error
        self._ray = ray
        self.folder = folder
        # The benchmarks are no part of the installed package: the machines get a copy of their code
        code = {"py_modules": [str(ROOT / "benchmarks")], "excludes": ["**/results/**", "**/scratch/**", "**/__pycache__/**"]}
        ray.init(address=address, runtime_env=code, log_to_driver=False, **kwargs)
        # A lost machine is not the job's fault; what the job itself raises is not retried by Ray
        self._run = ray.remote(num_cpus=1, max_retries=-1)(run_in_process)

    def submit(self, job: Job) -> "Future[dict[str, Any]]":
        """
        :param job: The job
        :return: Its result, once there is one
        """
        return self._run.remote(job, self.folder).future()

    def __enter__(self) -> "RayExecutor":
        return self

    def __exit__(self, *error: object) -> None:
        self._ray.shutdown()
