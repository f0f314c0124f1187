import random
import zipfile

import mutate
import numpy as np
import pytest

pytest.importorskip("minari")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    mutate.write_files(folder)
    return folder


def test_whole_files_are_used(files):
    for kind in mutate.KINDS:
        assert mutate.verdict(files / kind, kind) == "used", kind


@pytest.mark.parametrize("kind", mutate.KINDS)
def test_damaged_files_are_used_without_harm_or_refused_by_name(files, kind, tmp_path):
    verdicts = [mutate.verdict(mutate._damage(files, tmp_path, kind, seed), kind) for seed in range(1_000, 1_008)]
    assert set(verdicts) <= {"refused", "used"} and "refused" in verdicts


def test_a_silent_nan_and_an_error_without_a_name_are_seen(files, monkeypatch):
    monkeypatch.setattr(mutate, "read", lambda path, kind: [np.array([1.0, np.nan])])
    assert mutate.verdict(files / "graph.json", "graph.json") == "silent NaN"

    def fail(path, kind):
        raise ValueError("something")

    monkeypatch.setattr(mutate, "read", fail)
    assert mutate.verdict(files / "graph.json", "graph.json").startswith("error that does not name the file")


def test_the_same_seed_does_the_same_damage(files):
    data = (files / "model.zip").read_bytes()
    one, other = (mutate.mutated(data, random.Random(7)) for _ in range(2))
    # Archives that are written anew hold the time
    assert one == other or zipfile.is_zipfile(files / "model.zip")
    assert one != data
