"""
Damage files with fixed seeds, read them in processes of their own, and count what must not happen.

    python benchmarks/reliability/mutate.py --mutations 3000

Model zips, checkpoints, policies, replay buffers, datasets of arrays and of HDF5, and graphs are changed: bits flipped, the
file cut, entries of archives swapped, numbers and texts in JSON replaced by wild ones with sound checksums. What is then read
has to be used without harm, or refused by one line that names the file. Counted are crashes of the process, hangs, errors of
another kind, and NaN that nobody mentions.
"""

import argparse
import hashlib
import io
import json
import multiprocessing
import os
import random
import re
import shutil
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

SECONDS = 30.0
KINDS = (
    *("model.zip", "parameters.zip", "checkpoint.zip", "policy.pt", "buffer.npz", "buffer.pkl", "her.npz", "arrays.npz"),
    *("preloaded.npz", "preloaded.pkl", "minari", "graph.json"),
)
WILD: tuple[Any, ...] = (
    *(None, True, False, [], {}, "", "x", "nan", "../../etc/passwd", "os:system", -1, 0, 1, 2, 3.5, 1e9, -1e9, 1e308),
    *(10**6, 10**9, 10**18, -(10**18), 10**400, float("nan"), float("inf"), "a" * 10_000, [[]] * 50, {"class": "os.system"}),
)


# Files ------------------------------------------------------------------------------------------------------------------


def write_files(folder: Path) -> None:
    """
    :param folder: Where to write one whole file of each kind
    """
    import numpy as np
    import torch as th

    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    from goal_env import GoalEnv
    from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

    from sb3_causalgdp import CausalGDP
    from sb3_causalgdp.offline.storage import Episode, write_dataset

    th.set_num_threads(1)
    model = _model().learn(260)
    model.save(folder / "model.zip", include=["causal_graph_history"])
    shutil.copyfile(folder / "model.zip", folder / "parameters.zip")
    model.save_checkpoint(folder / "checkpoint.zip")
    model.policy.save(str(folder / "policy.pt"))
    model.save_replay_buffer(folder / "buffer.npz")
    model.save_replay_buffer(folder / "buffer.pkl")
    for suffix in (".npz", ".pkl"):
        shutil.copyfile(folder / f"buffer{suffix}", folder / f"preloaded{suffix}")
    model.causal_graph().save(folder / "graph.json")
    generator, no = np.random.default_rng(0), np.zeros(50, bool)
    observations, following = generator.normal(size=(2, 50, 3)).astype(np.float32)
    arrays = {"observations": observations, "next_observations": following, "terminations": no, "truncations": no}
    actions, rewards = generator.uniform(-1.0, 1.0, (50, 1)).astype(np.float32), generator.normal(size=50)
    np.savez(folder / "arrays.npz", allow_pickle=False, **arrays, actions=actions, rewards=rewards)
    steps = [Episode(generator.normal(size=(21, 3)).astype(np.float32), actions[:20], rewards[:20])] * 3
    write_dataset("strange/data-v0", steps, "Pendulum-v1", folder / "minari")
    goals = CausalGDP(
        "MultiInputPolicy",
        GoalEnv(),
        replay_buffer_class=HerReplayBuffer,
        buffer_size=100,
        learning_starts=1_000,
        device="cpu",
    )
    goals.learn(60).save_replay_buffer(folder / "her.npz")


def _model(**kwargs: Any) -> Any:
    from sb3_causalgdp import CausalGDP

    tiny: dict[str, Any] = {
        "policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]},
        "batch_size": 8,
        "diffusion_steps": 2,
    }
    return CausalGDP(
        "MlpPolicy", "Pendulum-v1", **tiny, buffer_size=300, causal_refresh_freq=250, device="cpu", seed=0, **kwargs
    )


# Damage -----------------------------------------------------------------------------------------------------------------


def mutated(data: bytes, generator: random.Random) -> bytes:
    """
    :param data: A whole file
    :param generator: Says what is done to it
    :return: Another one
    """
    changes: list[Callable[[bytes, random.Random], bytes]] = [_flipped, _cut, _overwritten]
    if data[:4] == b"PK\x03\x04":
        changes += [_with_other_entries] * 3
    elif data[:1] in b"{[":
        changes += [_with_wild_json] * 3
    return generator.choice(changes)(data, generator)


def _flipped(data: bytes, generator: random.Random) -> bytes:
    changed = bytearray(data)
    # Where archives keep their directory more often than elsewhere
    first = generator.choice([0, max(0, len(data) - 1_500)])
    for _ in range(generator.choice([1, 1, 1, 8, 64])):
        changed[generator.randrange(first, len(data))] ^= 1 << generator.randrange(8)
    return bytes(changed)


def _cut(data: bytes, generator: random.Random) -> bytes:
    first = generator.randrange(len(data))
    return data[:first] if generator.random() < 0.5 else data[:first] + data[first + generator.randrange(1, 200) :]


def _overwritten(data: bytes, generator: random.Random) -> bytes:
    first = generator.randrange(len(data))
    return data[:first] + generator.randbytes(generator.randrange(1, 64)) + data[first + 32 :]


def _with_other_entries(data: bytes, generator: random.Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    names = sorted(entries)
    name, other = generator.choice(names), generator.choice(names)
    what = generator.randrange(6)
    if what == 0:
        entries[name], entries[other] = entries[other], entries[name]
    elif what == 1:
        del entries[name]
    elif what == 2:
        entries[name] = _flipped(entries[name] or b"x", generator)
    else:
        of_json = [one for one in names if entries[one][:1] in (b"{", b"[") or b'{"format"' in entries[one]]
        name = generator.choice(of_json or names)
        entries[name] = _with_wild_json(entries[name], generator)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for one, content in entries.items():
            archive.writestr(one, content)
    return stream.getvalue()


def _with_wild_json(data: bytes, generator: random.Random) -> bytes:
    start = max(data.find(b"{"), 0)
    try:
        content = json.loads(data[start:])
    except ValueError:
        return _flipped(data, generator)
    places = list(_places(content))
    if places:
        holder, key = generator.choice(places)
        if generator.random() < 0.1:
            del holder[key]
        else:
            holder[key] = generator.choice(WILD)
    text = json.dumps(content).encode()
    if start == 0:
        return text
    # Inside of an array of numpy's, whose header tells the length
    return re.sub(rb"\((\d+),\)", lambda found: b"(%d,)" % len(text), data[:start]) + text


def _signed(data: bytes) -> bytes:
    """A checkpoint with the sums that its files have now, as somebody who wants to harm would write it."""
    from sb3_causalgdp.checkpoints.store import _checksum

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
        manifest = json.loads(entries["manifest.json"])
        sums = {name: hashlib.sha256(entries[name]).hexdigest() for name in manifest["files"] if name in entries}
        manifest["files"] |= sums
        entries["manifest.json"] = json.dumps({**manifest, "checksum": _checksum(manifest)}).encode()
    except Exception:
        return data
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for one, content in entries.items():
            archive.writestr(one, content)
    return stream.getvalue()


def _places(content: Any) -> Any:
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield content, key
        if isinstance(value, dict | list):
            yield from _places(value)


# Reading ----------------------------------------------------------------------------------------------------------------


def read(path: Path, kind: str) -> Any:
    """
    Read and use a file.

    :param path: The file, or the folder of datasets
    :param kind: One of ``KINDS``
    :return: Arrays that must be finite
    """
    import numpy as np

    from sb3_causalgdp import CausalGDP, MlpPolicy
    from sb3_causalgdp.causal import CausalGraph
    from sb3_causalgdp.causal.sources import open_source

    observations = np.zeros((2, 3), np.float32)
    if kind == "model.zip":
        model = CausalGDP.load(path, device="cpu")
        return [model.predict(observations, deterministic=True)[0], model.causal_graph().effects]
    if kind == "parameters.zip":
        model = _model()
        model.set_parameters(path, device="cpu")
        return [model.predict(observations, deterministic=True)[0]]
    if kind == "checkpoint.zip":
        model = CausalGDP.resume(path, "Pendulum-v1", device="cpu")
        model.learn(2, reset_num_timesteps=False)
        assert model.replay_buffer is not None
        return [model.predict(observations, deterministic=True)[0], model.replay_buffer.rewards]
    if kind == "policy.pt":
        return [MlpPolicy.load(path, device="cpu").predict(observations, deterministic=True)[0]]
    if kind == "graph.json":
        graph = CausalGraph.load(path)
        return [graph.masks, graph.effects]
    if kind == "her.npz":
        from sb3_causalgdp.offline.saved_buffers import read_buffer

        return [read_buffer(path).rewards]
    model = _MODELS.get("plain") or _MODELS.setdefault("plain", _model())
    if kind.startswith("buffer"):
        model.load_replay_buffer(path)
        sample = model.replay_buffer.sample(8)
        rows = next(open_source(path).batches())
        return [*(part.numpy() for part in (sample.observations, sample.rewards, sample.actions)), rows]
    model = _model()
    if kind == "minari":
        os.environ["MINARI_DATASETS_PATH"] = str(path)
        model.preload("strange/data-v0", download=False)
    else:
        model.preload(path)
    if kind.startswith("preloaded"):
        assert sum(map(len, open_source(path).batches())) > 0
    return [model.replay_buffer.observations[:20], model.replay_buffer.rewards[:20], model.replay_buffer.actions[:20]]


_MODELS: dict[str, Any] = {}


def verdict(path: Path, kind: str) -> str:
    """
    :param path: A damaged file
    :param kind: Its kind
    :return: ``refused``, ``used``, or what is wrong
    """
    import numpy as np

    name = "strange/data-v0" if kind == "minari" else path.name
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            used = read(path, kind)
    except (ValueError, TypeError, OSError) as error:
        text = str(error)
        if "\n" in text:
            return f"error of several lines: {type(error).__name__} {text[:300]!r}"
        return "refused" if name in text else f"error that does not name the file: {type(error).__name__} {text[:300]!r}"
    except BaseException as error:
        return f"other error: {type(error).__name__} {str(error)[:300]!r}"
    return "used" if all(np.isfinite(values).all() for values in used) else "silent NaN"


def _damage(files: Path, target: Path, kind: str, seed: int) -> Path:
    """Write the damaged file, and give its path."""
    generator = random.Random(f"{kind} {seed}")
    path = target / kind
    if kind != "minari":
        damaged = mutated((files / kind).read_bytes(), generator)
        path.write_bytes(_signed(damaged) if kind == "checkpoint.zip" else damaged)
        return path
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(files / kind, path)
    inside = generator.choice(sorted(one for one in path.rglob("*") if one.is_file() and "data-v0" in one.parts))
    inside.write_bytes(mutated(inside.read_bytes(), generator))
    return path


def _work(files: str, connection: Any) -> None:
    import resource

    import torch as th

    resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        while (job := connection.recv()) is not None:
            kind, seed = job
            connection.send(verdict(_damage(Path(files), Path(scratch), kind, seed), kind))


class Worker:
    """A process that reads damaged files one by one, and is replaced when one of them ends it."""

    def __init__(self, files: Path) -> None:
        self.files = files
        self._start()

    def _start(self) -> None:
        self.connection, other = multiprocessing.Pipe()
        self.process = multiprocessing.get_context("spawn").Process(target=_work, args=(str(self.files), other), daemon=True)
        self.process.start()
        other.close()

    def run(self, kind: str, seed: int, seconds: float = SECONDS) -> str:
        """
        :param kind: Of the file
        :param seed: Of its damage
        :param seconds: After which it hangs
        :return: See :func:`verdict`
        """
        self.connection.send((kind, seed))
        try:
            if self.connection.poll(seconds):
                return self.connection.recv()
            result = "hang"
        except EOFError:
            self.process.join()
            result = f"crash: exit status {self.process.exitcode}"
        self.process.kill()
        self._start()
        return result

    def close(self) -> None:
        """End the process."""
        self.connection.send(None)
        self.process.join(5.0)
        self.process.kill()


def run(n_mutations: int, kinds: tuple[str, ...] = KINDS, first_seed: int = 0) -> dict[str, Counter[str]]:
    """
    :param n_mutations: Of all files together
    :param kinds: Which files
    :param first_seed: Of the first damage of each
    :return: For each kind, how often which verdict was given
    """
    results: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        write_files(Path(folder))
        worker = Worker(Path(folder))
        # Imports take their time
        worker.run("graph.json", 0, 120.0)
        for number in range(n_mutations):
            kind, seed = kinds[number % len(kinds)], first_seed + number // len(kinds)
            result = worker.run(kind, seed)
            results[kind][result.partition(":")[0]] += 1
            if result not in ("refused", "used"):
                print(f"{kind} {seed}: {result}", flush=True)
        worker.close()
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutations", type=int, default=3_000)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--one", nargs=2, metavar=("KIND", "SEED"), help="read one damaged file here, to see its error")
    arguments = parser.parse_args()
    if arguments.one:
        with tempfile.TemporaryDirectory() as folder:
            write_files(Path(folder))
            path = _damage(Path(folder), Path(tempfile.mkdtemp()), arguments.one[0], int(arguments.one[1]))
            print(path)
            read(path, arguments.one[0])
        return
    start = time.perf_counter()
    results = run(arguments.mutations, tuple(arguments.only), arguments.first_seed)
    for kind, counts in results.items():
        print(f"{kind}: {sum(counts.values())} files, {', '.join(f'{count} {what}' for what, count in counts.most_common())}")
    wrong = sum(count for counts in results.values() for what, count in counts.items() if what not in ("refused", "used"))
    print(f"{wrong} of {arguments.mutations} went wrong, in {time.perf_counter() - start:.0f} s")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
