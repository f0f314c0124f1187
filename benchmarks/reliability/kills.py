"""
Kill processes with SIGKILL at random moments, start the same command again, and see what is lost.

    python benchmarks/reliability/kills.py trainings --kills 10
    python benchmarks/reliability/kills.py writers --kills 200
    python benchmarks/reliability/kills.py full_disk

``trainings``: those of ``tests/checkpoints/setups.py`` that the table names; each is killed again and again until it has been
killed often enough and ends. Its weights have to be bit for bit those of a training that nobody killed. ``writers``: whatever
the package writes, in a loop; the file has to be whole, and behind the next writing no temporary may be left. ``full_disk``:
a disk that takes half of what is to be written; the old file has to stay, and the error to be one line.
"""

import argparse
import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[2] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "checkpoints")]

TRAININGS = ("Pendulum", "HalfCheetah", "VecNormalize", "HER", "offline to online", "SubprocVecEnv")
STEPS = 600
READY = "ready"


# Trainings ----------------------------------------------------------------------------------------------------------------


def train(name: str) -> None:
    """Train to the end, from the newest checkpoint if there is one, and say what the weights are."""
    import torch as th
    from setups import SETUPS

    from sb3_causalgdp import CausalGDP

    th.set_num_threads(1)
    setup = SETUPS[name]
    folder = Path("checkpoints")
    print(READY, flush=True)
    try:
        model = CausalGDP.resume(folder, setup.make_env(1))
    except FileNotFoundError:
        model = setup.make_model()
    model.learn(STEPS - model.num_timesteps, setup.callbacks(folder, every=40), reset_num_timesteps=False)
    digest = hashlib.sha256()
    for value in model.policy.state_dict().values():
        digest.update(value.numpy().tobytes())
    print(model.num_timesteps, digest.hexdigest(), flush=True)
    if model.env is not None:
        model.env.close()


def kill_trainings(names: list[str], n_kills: int, generator: random.Random) -> int:
    n_equal = 0
    for name in names:
        with tempfile.TemporaryDirectory() as scratch:
            start = time.perf_counter()
            expected = _uninterrupted("train", name, Path(scratch, "plain"))
            seconds = time.perf_counter() - start
            done = 0
            while done < n_kills:
                folder = Path(scratch, f"killed_{done}")
                n, result = _killed_training(name, folder, generator, seconds, n_kills - done)
                done += max(n, 1)
                n_equal += (result == expected) * max(n, 1)
            print(f"{name}: {done} kills, {'all equal' if result == expected else 'DIFFERENT'}", flush=True)
    print(f"{n_equal} of {len(names) * n_kills} resumed bit for bit")
    return len(names) * n_kills - n_equal


def _killed_training(name: str, folder: Path, generator: random.Random, seconds: float, most: int) -> tuple[int, str]:
    """Killed until it ends in spite of it: how often, and what it said."""
    for n_kills in range(most + 1):
        delay = generator.uniform(0.0, seconds / 2) if n_kills < most else None
        output = _run("train", name, folder, delay)
        if output is not None:
            left = [path for path in (folder / "checkpoints").rglob(".writing-*")]
            return n_kills, output if not left else f"temporaries: {left}"
    raise AssertionError("the last run is not killed")


# Writers ------------------------------------------------------------------------------------------------------------------


def writers() -> dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any], str]]:
    """By name: what writes, what reads, and the name of the file."""
    import numpy as np
    from PIL import Image
    from setups import Setup

    from sb3_causalgdp import CausalGDP, MlpPolicy
    from sb3_causalgdp.causal import CausalGraph
    from sb3_causalgdp.offline.storage import Episode, write_dataset

    setup = Setup()
    model = setup.make_model().learn(400)
    graph = model.causal_graph()

    def write_data(path: Path) -> None:
        import shutil

        # At once: a removal that is killed half way is no fault of a writer
        removed = path.with_name("removed")
        shutil.rmtree(removed, ignore_errors=True)
        if path.exists():
            path.rename(removed)
        episode = Episode(np.zeros((501, 3), np.float32), np.zeros((500, 1), np.float32), np.zeros(500))
        write_dataset(path.name, [episode] * 20, "Pendulum-v1", path.parent)

    def read_data(path: Path) -> None:
        from minari import MinariDataset

        assert not path.exists() or MinariDataset(path / "data").total_steps == 10_000

    def read_buffer(path: Path) -> None:
        setup.make_model().load_replay_buffer(path)

    return {
        "model.save": (model.save, lambda path: CausalGDP.load(path), "model.zip"),
        "policy.save": (model.policy.save, lambda path: MlpPolicy.load(path), "policy.pt"),
        "save_replay_buffer": (model.save_replay_buffer, read_buffer, "buffer.npz"),
        "save_replay_buffer, pickled": (model.save_replay_buffer, read_buffer, "buffer.pkl"),
        "save_checkpoint, file": (model.save_checkpoint, lambda path: CausalGDP.resume(path, setup.make_env(0)), "there.zip"),
        "save_checkpoint, folder": (model.save_checkpoint, lambda path: CausalGDP.resume(path, setup.make_env(0)), "there"),
        "graph.save": (graph.save, CausalGraph.load, "graph.json"),
        "graph.plot": (lambda path: graph.plot(path), lambda path: Image.open(path).load(), "graph.png"),
        "datasets": (write_data, read_data, "data-v0"),
    }


def write_until_killed(write: Callable[[Path], Any], path: Path, delay: float) -> None:
    """In a process that is a copy of this one, which is killed so many seconds after it began to write."""
    ready, begun = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(begun, b"1")
        while True:
            write(path)
    os.read(ready, 1)
    time.sleep(delay)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.close(ready)
    os.close(begun)


def kill_writers(names: list[str], n_kills: int, generator: random.Random) -> int:
    import torch as th

    th.set_num_threads(1)
    n_wrong, all_writers = 0, writers()
    per_writer = -(-n_kills // len(names))
    for name in names:
        write, read, file = all_writers[name]
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch, file)
            write(path)
            start = time.perf_counter()
            write(path)
            seconds = time.perf_counter() - start
            torn = left = 0
            for _ in range(per_writer):
                write_until_killed(write, path, generator.uniform(0.0, 3.0 * seconds))
                torn += not _is_whole(read, path)
                write(path)
                left += any(one.name.startswith((".writing-", ".making-")) for one in Path(scratch).rglob("*"))
            print(f"{name}: {per_writer} kills, {torn} torn, {left} with temporaries left", flush=True)
            n_wrong += torn + left
    return n_wrong


def fill_disk(names: list[str]) -> int:
    """A limit of the size of files stands for a full disk."""
    n_wrong, all_writers = 0, writers()
    for name in names:
        write, read, file = all_writers[name]
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch, file)
            write(path)
            sizes = [one.stat().st_size for one in (path, *path.rglob("*")) if one.is_file()]
            child = os.fork()
            if child == 0:
                os._exit(_write_with_limit(write, path, max(sizes) // 2))
            said_so = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
            whole = _is_whole(read, path)
            left = any(one.name.startswith(".writing-") for one in Path(scratch).rglob("*"))
            print(f"{name}: {'one line' if said_so else 'NO ERROR'}, {'whole' if whole else 'TORN'}{', TEMPORARIES' * left}")
            n_wrong += not said_so or not whole or left
    return n_wrong


def _write_with_limit(write: Callable[[Path], Any], path: Path, n_bytes: int) -> int:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))
    try:
        write(path)
    except Exception as error:
        return int("\n" in str(error).strip())
    return 1


def _is_whole(read: Callable[[Path], Any], path: Path) -> bool:
    try:
        read(path)
        return True
    except Exception as error:
        print(f"{path.name}: {error}", file=sys.stderr)
        return False


# Processes ----------------------------------------------------------------------------------------------------------------


def _uninterrupted(command: str, name: str, folder: Path) -> str:
    output = _run(command, name, folder, None)
    assert output
    return output


def _run(command: str, name: str, folder: Path, delay: float | None) -> str | None:
    """What it says behind that it is ready; None if it was killed that many seconds later."""
    folder.mkdir(exist_ok=True)
    if command == "train" and not (folder / "data.npz").exists():
        from setups import write_dataset

        write_dataset(folder)
    process = subprocess.Popen(
        [sys.executable, __file__, "--one", command, name],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    try:
        if delay is None:
            return process.stdout.read().removeprefix(f"{READY}\n")
        process.stdout.readline()
        process.wait(delay)
        return process.stdout.read()
    except subprocess.TimeoutExpired:
        return None
    finally:
        # Its environments' processes, too
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("trainings", "writers", "full_disk"))
    parser.add_argument("--kills", type=int, default=10, help="of each training, or of all writers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="names of trainings or writers")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        command, name = arguments.one
        assert command == "train"
        train(name)
        return
    generator = random.Random(arguments.seed)
    if arguments.what == "trainings":
        wrong = kill_trainings(arguments.only or list(TRAININGS), arguments.kills, generator)
    elif arguments.what == "full_disk":
        wrong = fill_disk(arguments.only or list(writers()))
    else:
        wrong = kill_writers(arguments.only or list(writers()), arguments.kills, generator)
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
