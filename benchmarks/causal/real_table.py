"""
The graph of a real table: the American economy, 1959 to 2009, by quarters, as it comes with statsmodels.

    OMP_NUM_THREADS=1 python benchmarks/causal/real_table.py

Growth rates in per cent of the quarter, unemployment, the rate of treasury bills as the action, inflation as the reward. Edges
with an evidence above one half are printed. ``--csv`` also writes the table, for the command line.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from statsmodels.datasets import macrodata

from sb3_causalgdp.causal import CausalGraph, TransitionVariables, discover

GROWING = ("realgdp", "realcons", "realinv", "realgovt", "realdpi", "cpi", "m1", "pop")


def main(argv: Sequence[str] | None = None) -> CausalGraph:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="partial_r2")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args(argv)
    table = macrodata.load_pandas().data
    for name in GROWING:
        table[name] = 100.0 * np.log(table[name]).diff()
    table = table[1:]
    if arguments.csv is not None:
        table.to_csv(arguments.csv, index=False)
    states, rate = table[[*GROWING, "unemp"]].to_numpy(), table["tbilrate"].to_numpy()
    action = 2.0 * (rate - rate.min()) / (rate.max() - rate.min()) - 1.0
    variables = TransitionVariables((*GROWING, "unemp"), ("tbilrate",))
    rows = variables.stack(states[:-1], action[:-1, None], states[1:], table["infl"].to_numpy()[1:])
    graph = discover(arguments.method, rows, variables)
    evidence = graph.masks if graph.evidence is None else graph.evidence
    causes = np.array([*variables.state_names, *variables.action_names])
    for effect, of_effect in zip((*variables.next_state_names, "reward (infl)"), evidence, strict=True):
        order = [i for i in np.argsort(-of_effect) if of_effect[i] > 0.5]
        print(f"{effect}:", ", ".join(f"{causes[i]} {of_effect[i]:.2f}" for i in order) or "-")
    print(f"{graph.n_samples} transitions; masks above 0.5: {graph.n_edges}")
    if graph.detectable_r2 is not None:
        print(f"effects below a partial R^2 of {graph.detectable_r2.max():.2f} could be missed")
    return graph


if __name__ == "__main__":
    main()
