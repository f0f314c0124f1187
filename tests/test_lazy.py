import ast
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import sb3_causalgdp
from sb3_causalgdp import causal

HEAVY = ("stable_baselines3", "gymnasium", "torch", "scipy", "matplotlib", "pandas")
PACKAGES = {"sb3_causalgdp": sb3_causalgdp, "sb3_causalgdp.causal": causal}


def modules_after(*arguments):
    """The modules that a fresh process has at its end."""
    script = "import atexit, sys; atexit.register(lambda: print('\\nMODULES', *sorted(sys.modules)))\n" + arguments[0]
    done = subprocess.run([sys.executable, "-c", script, *arguments[1:]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split("MODULES ")[-1].split()), done.stdout


RUN = "import runpy; runpy.run_module('sb3_causalgdp.causal', run_name='__main__')"


@pytest.mark.parametrize("statement", ["import sb3_causalgdp", "import sb3_causalgdp.causal"])
def test_a_package_imports_nothing_heavy(statement):
    assert not modules_after(statement)[0] & set(HEAVY)


def test_the_help_of_the_command_line_imports_nothing_heavy():
    start = time.perf_counter()
    modules, text = modules_after(RUN, "--help")
    print(f"--help took {time.perf_counter() - start:.2f} s")  # less than a second on an idle machine: seen with pytest -s
    assert "--reward NAME" in text
    assert not modules & set(HEAVY)


def test_discovery_on_a_table_needs_neither_sb3_nor_gymnasium(tmp_path):
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(100, 3))
    np.savez(tmp_path / "tank.npz", level=columns[:, 0], valve=columns[:, 1], cost=columns[:, 2])
    roles = ("--state", "level", "--action", "valve", "--reward", "cost")
    modules, text = modules_after(RUN, str(tmp_path / "tank.npz"), *roles)
    assert "99 transitions" in text
    assert "torch" in modules and not modules & {"stable_baselines3", "gymnasium"}


@pytest.mark.parametrize("package", PACKAGES.values(), ids=PACKAGES)
def test_every_public_name_is_there_and_a_type_checker_sees_it(package):
    tree = ast.parse(Path(package.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: f"{node.module}" for node in block.body for alias in node.names}
    assert set(seen) | {"__version__"} >= set(package.__all__) >= set(seen)
    for name, home in seen.items():
        assert getattr(package, name) is getattr(sys.modules[home], name)
    assert set(seen) == set(dir(package))


def test_unknown_names_are_attribute_errors_and_modules_are_found():
    with pytest.raises(AttributeError, match="module 'sb3_causalgdp' has no attribute 'CausalGPD'"):
        _ = sb3_causalgdp.CausalGPD
    with pytest.raises(ImportError, match="cannot import name 'CausalGPD'"):
        from sb3_causalgdp import CausalGPD  # noqa: F401
    assert sb3_causalgdp.losses.__name__ == "sb3_causalgdp.losses"


def test_the_command_line_names_all_methods():
    from sb3_causalgdp.causal import DISCOVERY_METHODS
    from sb3_causalgdp.causal.__main__ import METHODS

    assert set(METHODS) == set(DISCOVERY_METHODS)
