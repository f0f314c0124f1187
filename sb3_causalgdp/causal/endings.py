"""What ends an episode matters as much as what is rewarded: an end costs all later rewards."""

from dataclasses import replace

import numpy as np

from sb3_causalgdp.causal.graph import CausalGraph

LEAST_ENDS = 5
LARGEST_Z = 4.0  # a normal variable is beyond it in one of sixteen thousand


def states_that_end(usual: np.ndarray, last: np.ndarray) -> np.ndarray:
    """
    Which states are others where episodes terminate than elsewhere: in their mean, or in their distance from it.

    :param usual: States of any moments, shape (rows, n)
    :param last: The states in which episodes terminated, shape (ends, n)
    :return: boolean, shape (n,); none where there are fewer than five ends
    """
    if len(last) < LEAST_ENDS:
        return np.zeros(usual.shape[1], dtype=bool)
    centre = usual.mean(axis=0)
    differs = np.zeros(usual.shape[1], dtype=bool)
    for power in (1, 2):
        ours, theirs = (usual - centre) ** power, (last - centre) ** power
        error = ours.std(axis=0) / np.sqrt(len(last))
        differs |= np.abs(theirs.mean(axis=0) - ours.mean(axis=0)) > LARGEST_Z * np.maximum(error, 1e-12)
    return differs


def with_endings(graph: CausalGraph, ends: np.ndarray) -> CausalGraph:
    """
    :param graph: Any causal graph
    :param ends: Which states are known to end episodes, boolean, shape (n,)
    :return: the same with an edge from each of these to the reward in its evidence
    """
    if not ends.any():
        return graph
    evidence = (graph.masks if graph.evidence is None else graph.evidence).copy()
    evidence[-1, : len(ends)][ends] = 1.0
    return replace(graph, evidence=evidence)
