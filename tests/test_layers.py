import ast
from pathlib import Path

import pytest

import sb3_causalgdp

PACKAGE = Path(sb3_causalgdp.__file__).parent
# From the roof to the ground: imports go down; the parts of one line do not import each other
LAYERS = [
    {"zoo", "datasets"},
    {"pictures"},
    {"__init__"},
    {"causalgdp"},
    {"callbacks", "checkpoints"},
    {"losses", "gradients", "diagnostics", "structural", "device_replay", "cuda_graphs"},
    {"product_pass"},
    {"policies"},
    {"acting", "arguments", "saved"},
    {"causal", "offline", "diffusion"},
    {"checks", "divergence", "files", "products", "activations", "plain", "archives"},
    {"numpy_pickles"},
]
WITHOUT_SB3 = {
    "causal",
    "diffusion",
    "divergence",
    "files",
    "losses",
    "gradients",
    "products",
    "product_pass",
    "activations",
    "cuda_graphs",
}
LEVELS = {part: level for level, parts in enumerate(LAYERS) for part in parts}
FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(file):
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_modules(file):
    """All modules that a file imports, anywhere in it, with full names."""
    folder = ("sb3_causalgdp", *file.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = folder[: len(folder) - node.level + 1] if node.level else ()
            base = ".".join((*above, *([node.module] if node.module else [])))
            # "from sb3_causalgdp import causal" imports a part, "from sb3_causalgdp import CausalGDP" the package
            yield from (f"{base}.{alias.name}" for alias in node.names) if base == "sb3_causalgdp" else (base,)


def imported_parts(file):
    for module in imported_modules(file):
        if module.split(".")[0] == "sb3_causalgdp":
            name = (*module.split("."), "__init__")[1]
            yield name if name in {part_of(other) for other in FILES} else "__init__"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_imports_go_down_and_never_sideways(file):
    part = part_of(file)
    assert part in LEVELS, f"{part} is not on the map: add it to LAYERS"
    for imported in set(imported_parts(file)) - {part}:
        assert LEVELS[imported] > LEVELS[part], f"{part} must not import {imported}"


@pytest.mark.parametrize("file", [file for file in FILES if part_of(file) in WITHOUT_SB3], ids=lambda file: file.stem)
def test_the_mathematics_knows_nothing_of_sb3(file):
    assert not any(module.split(".")[0] == "stable_baselines3" for module in imported_modules(file))
