"""Every writer of the package, on a full disk and in a folder that may not be written to."""

import os
import resource
import shutil
import signal
import stat
import tempfile
import warnings
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from sb3_causalgdp import CausalGDP, MlpPolicy
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.files import MARK
from sb3_causalgdp.offline.storage import Episode, write_dataset

pytest.importorskip("minari")

NOBODY = 65534


@pytest.fixture(scope="module")
def model():
    warnings.filterwarnings("ignore", message=".*is set to None")
    return CausalGDP("MlpPolicy", "Pendulum-v1", learning_starts=50, buffer_size=20_000, seed=0).learn(300)


def write_data(model, path):
    episode = Episode(np.zeros((501, 3), np.float32), np.zeros((500, 1), np.float32), np.zeros(500))
    # Never the same name: a dataset that is there is not replaced
    write_dataset(f"{path.name}-v{len(list(path.parent.glob(f'{path.name}-v*')))}", [episode] * 20, "Pendulum-v1", path.parent)


def read_data(path):
    from minari import MinariDataset

    assert MinariDataset(path.with_name(f"{path.name}-v0") / "data").total_steps == 10_000


WRITERS = {
    "model.zip": (lambda model, path: model.save(path), CausalGDP.load),
    "policy.pt": (lambda model, path: model.policy.save(path), MlpPolicy.load),
    "buffer.npz": (lambda model, path: model.save_replay_buffer(path), lambda path: new_model().load_replay_buffer(path)),
    "buffer.pkl": (lambda model, path: model.save_replay_buffer(path), lambda path: new_model().load_replay_buffer(path)),
    "checkpoint.zip": (lambda model, path: model.save_checkpoint(path), lambda path: CausalGDP.resume(path, new_env())),
    "checkpoints": (lambda model, path: model.save_checkpoint(path), lambda path: CausalGDP.resume(path, new_env())),
    "graph.json": (lambda model, path: model.causal_graph().save(path), CausalGraph.load),
    "graph.png": (lambda model, path: model.causal_graph().plot(path), matplotlib.image.imread),
    "data": (write_data, read_data),
}


def new_model():
    return CausalGDP("MlpPolicy", "Pendulum-v1", buffer_size=20_000)


def new_env():
    from stable_baselines3.common.env_util import make_vec_env

    return make_vec_env("Pendulum-v1")


@pytest.fixture
def folder():
    """One that every user may look into, as pytest's may not be."""
    path = Path(tempfile.mkdtemp())
    path.chmod(0o755)
    yield path
    path.chmod(0o755)
    shutil.rmtree(path)


def sizes(path):
    return {one: one.stat().st_size for one in path.parent.rglob("*") if one.is_file()}


def error_in_child(prepare, write):
    """What a copy of this process is told, which writes under other conditions; None if it is told nothing."""
    ready, told = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            prepare()
            write()
            os.write(told, b"nothing")
        except Exception as error:
            os.write(told, f"{type(error).__name__}: {error}".encode())
        finally:
            os._exit(0)
    os.close(told)
    with os.fdopen(ready) as pipe:
        text = pipe.read()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    return text


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_one_line(name, model, folder):
    write, read = WRITERS[name]
    path = folder / name
    write(model, path)
    before = sizes(path)

    def fill_disk():
        # A process that ignores the signal is told so by the system, as on a full disk
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        limit = max(before.values()) // 2
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    text = error_in_child(fill_disk, lambda: write(model, path))
    assert "\n" not in text and "File too large" in text and str(path) in text and MARK not in text
    read(path)
    assert sizes(path) == before


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_that_may_not_be_written_to_is_named(name, model, folder):
    write, read = WRITERS[name]
    path = folder / name
    write(model, path)
    before = sizes(path)
    for one in [folder, *folder.rglob("*")]:
        one.chmod(stat.S_IMODE(one.stat().st_mode) & ~0o222)

    def become_nobody():
        if os.getuid() == 0:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)

    text = error_in_child(become_nobody, lambda: write(model, path))
    assert "\n" not in text and "Permission denied" in text and str(folder) in text and MARK not in text
    read(path)
    assert sizes(path) == before
