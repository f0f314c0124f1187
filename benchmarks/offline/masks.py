"""
How much a mask closes, and what the masks of a discovered graph are good for, on the world model alone.

    python -m benchmarks.offline.masks

First: what a world model believes that the forces do to the ball, with masks from 1 to 0 on all forces. Second: its error on
transitions that it has not seen, after learning from few. See docs/benchmarks_offline.md.
"""

import argparse
from collections.abc import Iterator, Sequence

import numpy as np
import torch as th

from benchmarks.offline.data import ensure_dataset, transitions
from sb3_causalgdp.causal import MaskedWorldModel, TransitionVariables, discover
from sb3_causalgdp.losses import world_model_loss

TASK = "maze2d-umaze"
LEARNING_RATE = 1e-3  # the default of world_model_learning_rate
BATCH_SIZE = 256
TESTED = 4_000
VELOCITIES = slice(2, 4)

Transitions = dict[str, th.Tensor]


def rows_of(arrays: Transitions, rows: th.Tensor) -> tuple[th.Tensor, ...]:
    """
    :param arrays: Transitions
    :param rows: Which of them
    :return: States, actions, next states and rewards
    """
    state, action, next_state = (arrays[name][rows] for name in ("observations", "actions", "next_observations"))
    return state, action, next_state, arrays["rewards"][rows].flatten()


def trained(
    model: MaskedWorldModel, arrays: Transitions, updates: Sequence[int], sample_masks: bool
) -> Iterator[MaskedWorldModel]:
    """
    :param model: The world model, with its masks
    :param arrays: What it learns from
    :param updates: When to give the model out, ascending
    :param sample_masks: Whether edges are drawn
    :return: The same model after so many updates each time
    """
    optimizer = th.optim.Adam(model.parameters(), lr=LEARNING_RATE, fused=True)
    for update in range(1, updates[-1] + 1):
        state, action, next_state, reward = rows_of(arrays, th.randint(len(arrays["actions"]), (BATCH_SIZE,)))
        model.update_statistics(state, next_state, reward)
        losses = world_model_loss(model, state, action, next_state, reward, sample_masks=sample_masks)
        optimizer.zero_grad()
        sum(losses, start=th.zeros(())).backward()
        optimizer.step()
        if update in updates:
            yield model


def responses(
    arrays: Transitions, mask: float, updates: Sequence[int], sample_masks: bool = False, seed: int = 0
) -> list[float]:
    """
    :param arrays: Transitions of a maze
    :param mask: Of both forces on all states; every other edge is open
    :param updates: When to ask, ascending
    :param sample_masks: Whether edges are drawn
    :param seed: Seed
    :return: Derivative of a velocity by its force after so many updates, mean over both and over states
    """
    th.manual_seed(seed)
    model = MaskedWorldModel(arrays["observations"].shape[1], arrays["actions"].shape[1])
    n, d = model.state_dim, model.action_dim
    model.set_masks(th.ones(n, n), mask * th.ones(n, d), th.ones(n), th.ones(d))
    found = []
    for _ in trained(model, arrays, updates, sample_masks):
        observations, actions = (arrays[name][:TESTED] for name in ("observations", "actions"))
        jacobian = model.action_response(observations, actions).next_state_jacobian[:, VELOCITIES]
        found.append(float(jacobian.diagonal(dim1=1, dim2=2).mean()))
    return found


def errors(arrays: Transitions, count: int, updates: int, masks: str, seed: int = 0) -> tuple[float, float]:
    """
    :param arrays: Transitions
    :param count: How many of them are learned from
    :param updates: Updates
    :param masks: ``open``, or those that ``partial_r2`` finds in the same transitions, ``scaled`` or ``drawn``
    :param seed: Seed
    :return: Squared error of the next state by that of "nothing changes", mean over variables, and squared error of the reward
        by its variance, both on other transitions
    """
    th.manual_seed(seed)
    order = th.randperm(len(arrays["actions"]))
    few = dict(zip(("observations", "actions", "next_observations", "rewards"), rows_of(arrays, order[:count]), strict=True))
    model = MaskedWorldModel(arrays["observations"].shape[1], arrays["actions"].shape[1])
    if masks != "open":
        model.set_masks(*_discovered(few))
    for _ in trained(model, few, [updates], masks == "drawn"):
        state, action, next_state, reward = rows_of(arrays, order[-TESTED:])
        with th.no_grad():
            predicted, _ = model.predict_next_state(state, action)
            predicted_reward, _ = model.predict_reward(next_state, action)
    still = (next_state - state).square().mean(dim=0)
    error = ((predicted - next_state).square().mean(dim=0) / still).mean()
    return float(error), float((predicted_reward - reward).square().mean() / reward.var())


def _discovered(arrays: Transitions) -> list[th.Tensor]:
    n, d = arrays["observations"].shape[1], arrays["actions"].shape[1]
    variables = TransitionVariables(tuple(f"s[{i}]" for i in range(n)), tuple(f"a[{i}]" for i in range(d)))
    graph = discover("partial_r2", variables.stack(*(values.numpy() for values in arrays.values())), variables)
    masks = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
    return [th.as_tensor(mask, dtype=th.float32) for mask in masks]


def _print_row(*cells: object) -> None:
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param argv: Its arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", nargs="*", type=float, default=[1.0, 0.3, 0.03, 0.003, 0.0])
    parser.add_argument("--updates", nargs="+", type=int, default=[500, 1_000, 2_000, 4_000])
    parser.add_argument("--counts", nargs="*", type=int, default=[300, 1_000, 3_000, 10_000], help="transitions learned from")
    parser.add_argument("--seeds", type=int, default=3, help="of the second table")
    parser.add_argument("--dataset-steps", type=int, default=1_000_000)
    args = parser.parse_args(argv)
    arrays = transitions(ensure_dataset(TASK, args.dataset_steps))
    tensors = {name: th.as_tensor(np.asarray(values, dtype=np.float32)) for name, values in arrays.items()}
    updates = sorted(args.updates)
    _print_row("mask", "masks are", *(f"{count:,}" for count in updates))
    _print_row(*["---"] * (2 + len(updates)))
    for mask in args.masks:
        for name in ("scaled", "drawn"):
            _print_row(f"{mask:g}", name, *(f"{one:.3f}" for one in responses(tensors, mask, updates, name == "drawn")))
    print()
    _print_row("transitions", "masks", "error of the next state", "error of the reward")
    _print_row(*["---"] * 4)
    for count in args.counts:
        for name in ("open", "scaled", "drawn"):
            found = np.array([errors(tensors, count, updates[-1], name, seed) for seed in range(args.seeds)])
            cells = (f"{mean:.4f} +- {std:.4f}" for mean, std in zip(found.mean(axis=0), found.std(axis=0), strict=True))
            _print_row(f"{count:,}", name, *cells)


if __name__ == "__main__":
    main()
