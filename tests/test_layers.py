import ast
from pathlib import Path

import pytest

import sb3_causalgdp

PACKAGE = Path(sb3_causalgdp.__file__).parent
# From the roof to the ground: imports go down; the parts of one line do not import each other. A part is a folder, or a file
LAYERS = [
    {"zoo", "datasets"},
    {"__init__"},
    {"causalgdp"},
    {"checked", "callbacks.own", "distilling"},
    {"saving.algorithm", "callbacks.pictures"},
    {"callbacks", "checkpoints", "knowledge"},
    {"callbacks.world_model", "updates"},
    {"losses", "batches", "distillation", "callbacks.diagnostics", "callbacks.calibration", "questions"}
    | {"acceleration.fast_steps", "step_plans"},
    {"policies", "counterfactual", "acceleration.device_replay", "acceleration.cuda_graphs", "acceleration.gradients"},
    {"export", "abstraction"},
    {"steering"},
    {"prediction", "acceleration.product_pass"},
    {"networks", "acceleration.acting"},
    {"saving.policies", "acceleration.numpy_networks", "forgetting"},
    {"arguments", "names", "saving.models", "acceleration.numpy_layers"},
    {"causal.__main__"},
    {"causal", "offline", "diffusion", "stress"},
    {"causal.plots", "causal.sources", "causal.guidance"},
    {"causal.transitions", "causal.discovery", "causal.interventions"},
    {"causal.world_model", "causal.statistics"},
    {"causal.masked_blocks"},
    {"causal.endings"},
    {"causal.graph"},
    {"causal.rows"},
    {"causal.answers", "causal.description", "causal.relevance"},
    {"causal.drawing", "causal.variables"},
    {"causal.answers_in_words", "causal.edges", "sources", "lazy"},
    {
        "checks",
        "divergence",
        "files",
        "hints",
        "acceleration.products",
        "acceleration.activations",
        "saving.plain",
        "saving.archives",
        "extractors",
    },
    {"kinds", "noise", "saving.numpy_pickles", "acceleration.switch", "acceleration", "saving", "moved", "presets"},
]
# Graphs and answers are drawn by pictures that know them: this file imports those late, and no other does
LATE = {("causal.drawing", "causal.plots")}
WITHOUT_SB3 = {
    "causal",
    "diffusion",
    "divergence",
    "files",
    "hints",
    "losses",
    "moved",
    "sources",
    "stress",
    "acceleration.gradients",
    "acceleration.products",
    "acceleration.product_pass",
    "acceleration.activations",
    "acceleration.cuda_graphs",
    "acceleration.fast_steps",
    "acceleration.numpy_layers",
    "acceleration.numpy_networks",
    "acceleration.switch",
    "forgetting",
}
LEVELS = {part: level for level, parts in enumerate(LAYERS) for part in parts}
FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(file):
    names = file.relative_to(PACKAGE).with_suffix("").parts
    return part_of_module(".".join(name for name in names if name != "__init__") or "__init__")


def part_of_module(name):
    """The longest name on the map that a module's name begins with."""
    names = name.split(".")
    ways = (".".join(names[:length]) for length in range(len(names), 0, -1))
    return next((way for way in ways if way in LEVELS), names[0])


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
            is_package = (PACKAGE.parent / Path(*base.split("."))).is_dir()
            yield from (f"{base}.{alias.name}" for alias in node.names) if is_package else (base,)


def imported_parts(file):
    for module in imported_modules(file):
        package, *names = module.split(".")
        if package == "sb3_causalgdp":
            is_part = names and (
                names[0] in {"__init__"} or (PACKAGE / names[0]).is_dir() or (PACKAGE / f"{names[0]}.py").is_file()
            )
            yield part_of_module(".".join(names)) if is_part else "__init__"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_imports_go_down_and_never_sideways(file):
    part = part_of(file)
    assert part in LEVELS, f"{part} is not on the map: add it to LAYERS"
    for imported in set(imported_parts(file)) - {part} - {above for below, above in LATE if below == part}:
        assert LEVELS[imported] > LEVELS[part], f"{part} must not import {imported}"


@pytest.mark.parametrize("file", [file for file in FILES if part_of(file) in WITHOUT_SB3], ids=lambda file: file.stem)
def test_the_mathematics_knows_nothing_of_sb3(file):
    assert not any(module.split(".")[0] == "stable_baselines3" for module in imported_modules(file))
