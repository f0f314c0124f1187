"""Configuration of Sphinx: ``make doc`` builds the pages into ``docs/_build/html``."""

import importlib.util
import os
import sys
from pathlib import Path
from typing import NewType

import numpy.typing
from docutils.nodes import Element
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

# Before the package is imported: the alias is a union that fills three lines
numpy.typing.ArrayLike = NewType("ArrayLike", object)
numpy.typing.ArrayLike.__module__ = "numpy.typing"

project = "sb3_causalgdp"
author = "sb3_causalgdp contributors"
copyright = f"2026, {author}"
release = version = (ROOT / "sb3_causalgdp" / "version.txt").read_text(encoding="utf-8").strip()

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
language = "en"
highlight_language = "text"

# -- Pages -----------------------------------------------------------------------------------------------------------------

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# A reader's browser loads MathJax from the network, unless this names a copy ("npm pack mathjax@3"); the build loads nothing
mathjax_path = os.environ.get("MATHJAX_PATH", "https://cdn.jsdelivr.net/npm/mathjax@3/es5/tex-mml-chtml.js")

# -- Docstrings ------------------------------------------------------------------------------------------------------------

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
# The zoo's page needs no zoo
autodoc_mock_imports = [name for name in ("rl_zoo3", "optuna", "sb3_contrib") if importlib.util.find_spec(name) is None]

# Every reference to a name of ours must lead somewhere; other packages' documentation is not at hand without a network
nitpicky = True
LIBRARIES = "torch numpy np npt gymnasium stable_baselines3 minari matplotlib pandas pd networkx nx"
OTHERS = f"{LIBRARIES} collections contextlib pathlib os io"
nitpick_ignore_regex = [(r"py:.*", rf"{name}(\..*)?") for name in OTHERS.split()]
# Hints in quotation marks, for packages that are imported late
nitpick_ignore_regex += [(r"py:class", name) for name in ("Figure", "Groups", "VecEnv")]


def resolve_missing(app: Sphinx, env: BuildEnvironment, node: pending_xref, contnode: Element) -> Element | None:
    """What docstrings call by a name of their own module is documented under the public one; internals are left unlinked."""
    if node.get("refdomain") != "py":
        return None
    python, target = env.domains.python_domain, node["reftarget"]
    public = [name for name, entry in python.objects.items() if name.endswith(f".{target}") and not entry.aliased]
    if len(public) == 1:
        return python.resolve_xref(env, node["refdoc"], app.builder, "obj", public[0], node, contnode)
    module, _, name = target.rpartition(".")
    ours = [imported for path, imported in sys.modules.items() if path.startswith(project) and path.endswith(module)]
    return contnode if any(hasattr(imported, name) for imported in ours) else None


def setup(app: Sphinx) -> None:
    app.connect("missing-reference", resolve_missing)


# -- HTML ------------------------------------------------------------------------------------------------------------------

html_theme = "sphinx_rtd_theme"
html_title = f"sb3_causalgdp {release}"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_theme_options = {"navigation_depth": 3}
