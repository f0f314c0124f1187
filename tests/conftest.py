import os

# One thread per process, or the workers of pytest-xdist fight for the cores. OpenMP reads this once, when torch is imported.
os.environ["OMP_NUM_THREADS"] = "1"

import pytest
import torch
from hostile import Hostile

torch.set_num_threads(1)


@pytest.fixture
def hostile(tmp_path):
    """What would run code; at the end, nothing has."""
    mark = tmp_path / "mark"
    yield Hostile(mark)
    assert not mark.exists()


@pytest.fixture
def minari(tmp_path, monkeypatch):
    """With an empty folder of datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return pytest.importorskip("minari")


@pytest.fixture
def registries():
    """Names that a test registers are unknown behind it."""
    from sb3_causalgdp.causal import DISCOVERY_METHODS, GUIDANCE_TARGETS
    from sb3_causalgdp.diffusion import DENOISERS, NOISE_SCHEDULES, SAMPLERS

    tables = (DISCOVERY_METHODS, GUIDANCE_TARGETS, DENOISERS, SAMPLERS, NOISE_SCHEDULES)
    before = [dict(table) for table in tables]
    yield
    for table, content in zip(tables, before, strict=True):
        table.clear()
        table.update(content)
