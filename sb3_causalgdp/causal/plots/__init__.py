"""Pictures of causal graphs; needs matplotlib and networkx."""

from sb3_causalgdp.causal.graph import PLOTS_HINT

try:
    from sb3_causalgdp.causal.plots.answers import plot_counterfactual, plot_intervention
    from sb3_causalgdp.causal.plots.effects import plot_action_effects
    from sb3_causalgdp.causal.plots.graphs import plot_causal_graph
    from sb3_causalgdp.causal.plots.heat_maps import plot_heat_map
    from sb3_causalgdp.causal.plots.history import animate_history, plot_history
    from sb3_causalgdp.causal.plots.layered_graphs import plot_graph
    from sb3_causalgdp.causal.plots.view import View
except ImportError as error:
    if (error.name or "").startswith("sb3_causalgdp"):
        raise
    raise ImportError(PLOTS_HINT) from error

__all__ = [
    "View",
    "animate_history",
    "plot_action_effects",
    "plot_causal_graph",
    "plot_counterfactual",
    "plot_graph",
    "plot_heat_map",
    "plot_history",
    "plot_intervention",
]
