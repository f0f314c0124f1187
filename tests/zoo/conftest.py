import os

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("MUJOCO_GL", "egl")

TINY = (
    "policy_kwargs:dict(net_arch=[8],world_model_net_arch=[8])",
    "batch_size:8",
    "buffer_size:1000",
    "diffusion_steps:2",
    "n_action_candidates:2",
)


@pytest.fixture(scope="module")
def tiny():
    """Arguments that make a model cheap."""
    return ("--num-threads", "1", "--device", "cpu", "--seed", "1", "-params", *TINY)


@pytest.fixture(scope="module")
def zoo():
    """The entry point, whose plots leave no trace."""
    pytest.importorskip("rl_zoo3")
    import matplotlib.pyplot as plt

    from sb3_causalgdp.zoo import main

    def run(*arguments):
        with plt.rc_context():
            main([str(one) for one in arguments])
        plt.close("all")

    return run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
