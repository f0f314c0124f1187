"""
How much a mask closes: what a world model believes that the forces do to the ball, with masks from 1 to 0 on all forces.

    python -m benchmarks.offline.masks

See docs/benchmarks_offline.md.
"""

import argparse
from collections.abc import Sequence

import numpy as np
import torch as th

from benchmarks.offline.data import ensure_dataset, transitions
from sb3_causalgdp.causal import MaskedWorldModel
from sb3_causalgdp.losses import world_model_loss

TASK = "maze2d-umaze"
LEARNING_RATE = 1e-3  # the default of world_model_learning_rate
BATCH_SIZE = 256
TESTED = 2_000
VELOCITIES = slice(2, 4)


def responses(arrays: dict[str, th.Tensor], mask: float, updates: Sequence[int], seed: int = 0) -> list[float]:
    """
    :param arrays: Transitions of a maze
    :param mask: Of both forces on all states; every other edge is open
    :param updates: When to ask, ascending
    :param seed: Seed
    :return: Derivative of a velocity by its force after so many updates, mean over both and over states
    """
    th.manual_seed(seed)
    model = MaskedWorldModel(arrays["observations"].shape[1], arrays["actions"].shape[1])
    n, d = model.state_dim, model.action_dim
    model.set_masks(th.ones(n, n), mask * th.ones(n, d), th.ones(n), th.ones(d))
    optimizer = th.optim.Adam(model.parameters(), lr=LEARNING_RATE, fused=True)
    found = []
    for update in range(1, updates[-1] + 1):
        rows = th.randint(len(arrays["observations"]), (BATCH_SIZE,))
        state, action, next_state = (arrays[name][rows] for name in ("observations", "actions", "next_observations"))
        reward = arrays["rewards"][rows].flatten()
        model.update_statistics(state, next_state, reward)
        loss = sum(world_model_loss(model, state, action, next_state, reward), start=th.zeros(()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if update in updates:
            tested = (arrays[name][:TESTED] for name in ("observations", "actions"))
            jacobian = model.action_response(*tested).next_state_jacobian[:, VELOCITIES]
            found.append(float(jacobian.diagonal(dim1=1, dim2=2).mean()))
    return found


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param argv: Its arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", nargs="+", type=float, default=[1.0, 0.3, 0.03, 0.003, 0.0])
    parser.add_argument("--updates", nargs="+", type=int, default=[500, 1_000, 2_000, 4_000])
    parser.add_argument("--dataset-steps", type=int, default=1_000_000)
    args = parser.parse_args(argv)
    arrays = transitions(ensure_dataset(TASK, args.dataset_steps))
    tensors = {name: th.as_tensor(np.asarray(values, dtype=np.float32)) for name, values in arrays.items()}
    updates = sorted(args.updates)
    print("| mask | " + " | ".join(f"{count:,}" for count in updates) + " |\n" + "|---" * (1 + len(updates)) + "|")
    for mask in args.masks:
        values = " | ".join(f"{value:.3f}" for value in responses(tensors, mask, updates))
        print(f"| {mask:g} | {values} |", flush=True)


if __name__ == "__main__":
    main()
