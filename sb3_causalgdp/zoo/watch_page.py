"""The page of a watched folder, for Bokeh's server: what each browser that opens it shows, and how that is renewed."""

import asyncio
from typing import Any

import jinja2
from bokeh.layouts import column, row
from bokeh.models.widgets import Div, Select, Slider

from sb3_causalgdp.zoo.pages import style
from sb3_causalgdp.zoo.watch_folder import View, WatchedFolder

# Bokeh's own letters are smaller than those of the page
STYLES: dict[str, str | None] = {"font-size": "1rem"}
TITLE = "CausalGDP in training"
SECTIONS = (
    "summary",
    "learning-curve",
    "rollout",
    "causal-graph",
    "history-of-the-graph",
    "effects-of-the-actions",
    "guidance-along-the-denoising-chain",
)
# As wide as the film
WIDTHS = {"rollout": "23rem"}
# A page must not load anything from elsewhere, whatever stands on it
POLICY = "; ".join(
    [
        "default-src 'self'",
        # Bokeh's own scripts are in the page, and compile templates
        "script-src 'self' 'unsafe-inline' 'unsafe-eval'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data:",
    ]
)
TEMPLATE = """{% extends base %}
{% block preamble %}
<meta http-equiv="Content-Security-Policy" content="{{ policy }}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light">
<style>{{ page_style }} body { max-width: none; padding: 0; }</style>
{% endblock %}
{% block contents %}
<main>
<h1>{{ title }}</h1>
{{ super() }}
</main>
{% endblock %}
"""


class WatchPage:
    """
    A page in one browser.

    :param document: Bokeh's ``Document`` of the page
    :param watched: What it shows
    :param refresh: Seconds between looks
    """

    def __init__(self, document: Any, watched: WatchedFolder, refresh: float) -> None:
        self._document = document
        self._watched = watched
        self._runs = Select(name="runs", title="Run", visible=False, sizing_mode="stretch_width", max_width=480, margin=0)
        self._graphs = Slider(
            name="graphs",
            title="Graph",
            start=0,
            end=1,
            value=0,
            step=1,
            show_value=False,
            visible=False,
            sizing_mode="stretch_width",
            max_width=480,
            margin=0,
        )
        # None follows the newest
        self._chosen: int | None = None
        self._is_renewing = False
        self._sections = {
            name: Div(stylesheets=[style()], styles={**STYLES, "max-width": WIDTHS.get(name, "100%")}, margin=0)
            for name in SECTIONS
        }
        self._sections["summary"].text = "<p>Reads the files ...</p>"
        summary, curve, rollout, *others = self._sections.values()
        # One below the other where the window is narrow
        top = row(curve, rollout, styles={"flex-wrap": "wrap", "gap": "0 1.5rem"}, sizing_mode="stretch_width")
        document.add_root(column(self._runs, summary, top, self._graphs, *others, sizing_mode="stretch_width"))
        document.title = TITLE
        document.template = jinja2.Environment(loader=jinja2.BaseLoader()).from_string(TEMPLATE)
        document.template_variables.update(policy=POLICY, page_style=style())
        self._runs.on_change("value", self._chose_run)
        self._graphs.on_change("value", self._moved_slider)
        self._graphs.on_change("value_throttled", self._let_go_of_slider)
        self._document.add_next_tick_callback(self._renew)
        self._document.add_periodic_callback(self._renew, round(1000 * refresh))

    async def _renew(self) -> None:
        self._show(await asyncio.to_thread(self._watched.look, self._runs.value or None, self._chosen))

    def _show(self, view: View) -> None:
        self._is_renewing = True
        self._runs.update(options=list(view.runs), value=view.run or "", visible=len(view.runs) > 1)
        last = len(view.moments) - 1
        shown = max(last, 0) if self._chosen is None else min(self._chosen, max(last, 0))
        self._graphs.update(end=max(last, 1), value=shown, visible=last > 0)
        self._graphs.title = f"Graph {shown + 1} of {last + 1}, {view.moments[shown]}" if last > 0 else "Graph"
        for name, section in self._sections.items():
            section.update(text=view.sections.get(name, ""), visible=name in view.sections)
        self._is_renewing = False

    def _chose_run(self, attribute: str, old: str, new: str) -> None:
        if not self._is_renewing:
            self._chosen = None
            self._document.add_next_tick_callback(self._renew)

    def _moved_slider(self, attribute: str, old: float, new: float) -> None:
        # The last graph is the newest, also later
        if not self._is_renewing:
            self._chosen = None if new == self._graphs.end else int(new)

    def _let_go_of_slider(self, attribute: str, old: float, new: float) -> None:
        self._moved_slider(attribute, old, new)
        self._document.add_next_tick_callback(self._renew)
