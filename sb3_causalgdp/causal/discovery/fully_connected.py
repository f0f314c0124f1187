from typing import Any

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.variables import TransitionVariables


class FullyConnected:
    """No discovery: every edge that time allows is open, whatever the data say. A graph has to be worth more than this."""

    def __call__(self, statistics: Any, variables: TransitionVariables, previous: CausalGraph | None = None) -> CausalGraph:
        """
        :param statistics: Of any kind; only the number of rows is read
        :param variables: Names and order of the variables
        :param previous: Not used
        :return: the graph with all masks 1 and all effects 0
        """
        graph = CausalGraph.fully_connected(variables)
        graph.method, graph.n_samples = "fully_connected", int(statistics.n_samples)
        return graph
