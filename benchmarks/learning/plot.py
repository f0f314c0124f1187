"""
Draw the learning curves that ``run.py`` wrote, and print their table.

    python benchmarks/learning/plot.py --env HalfCheetah-v5
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

RESULTS = Path(__file__).parent / "results"


def read(folder: Path, env_id: str) -> dict[str, list[np.ndarray]]:
    """Runs by the name of the algorithm, in the order of the seeds."""
    runs: dict[str, list[np.ndarray]] = {}
    for path in sorted(folder.glob(f"{env_id}_*.csv")):
        name, _ = path.stem.removeprefix(f"{env_id}_").rsplit("_", 1)
        runs.setdefault(name, []).append(np.genfromtxt(path, delimiter=",", names=True))
    return runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--folder", type=Path, default=RESULTS)
    args = parser.parse_args()
    runs = read(args.folder, args.env)
    if not runs:
        raise SystemExit(f"No results of {args.env} in {args.folder}: run run.py first")
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for colour, (name, tables) in zip(("C0", "C1", "C2", "C3", "C4", "C5"), runs.items(), strict=False):
        steps = tables[0]["timesteps"]
        returns = np.stack([table["mean_return"] for table in tables])
        for curve in returns:
            axes.plot(steps, curve, color=colour, alpha=0.3, linewidth=1)
        axes.plot(steps, returns.mean(axis=0), color=colour, linewidth=2, label=f"{name} (runs: {len(tables)})")
        last = ", ".join(f"{value:.0f}" for value in returns[:, -1])
        seconds = np.mean([table["cpu_seconds"][-1] for table in tables])
        print(f"{name}: {returns[:, -1].mean():.0f} +- {returns[:, -1].std():.0f} ({last}); {seconds:.0f} CPU seconds a run")
    axes.set(title=f"{args.env}: mean and single seeds", xlabel="environment steps", ylabel="return of deterministic episodes")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(args.folder / f"{args.env}.png", dpi=120)


if __name__ == "__main__":
    main()
