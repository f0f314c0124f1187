"""What is no longer a number, said by name."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch as th

# Optimizers whose states have the shapes of the parameters, a step's number aside. Their kernels read and write as many
# numbers as the parameter has, whatever the state's size
ELEMENTWISE = (
    th.optim.Adadelta,
    th.optim.Adagrad,
    th.optim.Adam,
    th.optim.Adamax,
    th.optim.AdamW,
    th.optim.ASGD,
    th.optim.NAdam,
    th.optim.RAdam,
    th.optim.RMSprop,
    th.optim.Rprop,
    th.optim.SGD,
)


class TrainingDivergedError(ValueError):
    """
    A loss, a parameter, an optimizer's state or an action has become NaN or infinite.

    :param quantity: What was first to, such as ``critic_loss``
    :param value: NaN or infinite
    :param update: Gradient steps until then, as in ``train/n_updates``; None where they are not known
    """

    def __init__(self, quantity: str, value: float, update: int | None = None) -> None:
        self.quantity = quantity
        self.value = value
        self.update = update
        when = "" if update is None else f" at update {update}"
        super().__init__(
            f"The training diverged: {quantity} is {value}{when}. A smaller learning_rate, max_grad_norm, or rewards of a "
            "smaller size (VecNormalize) may prevent it."
        )

    def __reduce__(self) -> tuple[type, tuple]:
        return type(self), (self.quantity, self.value, self.update)


class ParametersError(ValueError, RuntimeError):
    """
    Parameters are not those of the model. As a ``RuntimeError`` it passes through SB3's ``load``, which takes other errors for
    those of old files, and dies of a ``KeyError``.
    """


def first_not_finite(tree: Any, name: str = "", may_be_infinite: Iterable[str] = ()) -> tuple[str, float] | None:
    """
    :param tree: A tensor, a number, or dictionaries, lists and tuples of them
    :param name: Its name
    :param may_be_infinite: Names of tensors in which only NaN is looked for
    :return: Name and value of the first number that is NaN or infinite, None if there is none
    """
    for leaf_name, leaf in _leaves(tree, name):
        if isinstance(leaf, float):
            if not math.isfinite(leaf):
                return leaf_name, leaf
        elif leaf.is_floating_point():
            bad = leaf.isnan() if leaf_name in may_be_infinite else ~leaf.isfinite()
            if bool(bad.any()):
                return leaf_name, float(leaf[bad][0])
    return None


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Tensors and floats, by names such as ``critic.optimizer.state.0.exp_avg``."""
    if isinstance(tree, (th.Tensor, float)):
        yield name, tree
        return
    parts = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, (list, tuple)) else ()
    for key, part in parts:
        yield from _leaves(part, f"{name}.{key}" if name else str(key))


def check_optimizer_state(optimizer: th.optim.Optimizer, state: Mapping[str, Any], name: str) -> None:
    """
    :param optimizer: Of torch, else its states may have any shape
    :param state: What its ``load_state_dict`` is about to be given
    :param name: Its name
    :raises ParametersError: If the state is not one of as many parameters of these sizes
    """
    groups, given = optimizer.param_groups, state.get("param_groups")
    values = state.get("state")
    if not isinstance(given, list) or not isinstance(values, Mapping):
        raise ParametersError(f"{name} must be the state of an optimizer, with 'state' and 'param_groups', got {list(state)}")
    sizes, given_sizes = ([len(group["params"]) for group in some] for some in (groups, given))
    if sizes != given_sizes:
        raise ParametersError(
            f"{name} has parameter groups of {sizes} parameters, and the given state is one of {given_sizes}"
        )
    if not isinstance(optimizer, ELEMENTWISE):
        return
    parameters = [parameter for group in groups for parameter in group["params"]]
    indices = [index for group in given for index in group["params"]]
    for index, parameter in zip(indices, parameters, strict=True):
        for key, value in values.get(index, {}).items():
            if isinstance(value, th.Tensor) and key not in ("step", "eta", "mu") and value.shape != parameter.shape:
                raise ParametersError(
                    f"{name}.state.{index}.{key} has the shape {tuple(value.shape)}, its parameter {tuple(parameter.shape)}"
                )


def check_losses(losses: Sequence[tuple[str, float]], last_step: int, delays: Mapping[str, int], delay: int) -> None:
    """
    :param losses: Of some gradient steps, with their names; each step has one of the critics
    :param last_step: Number of gradient steps up to the last of these
    :param delays: A loss of this name comes once every so many steps
    :param delay: The same for all other names
    :raises TrainingDivergedError: With the first that is NaN or infinite
    """
    first = last_step - sum(name == "critic_loss" for name, _ in losses) + 1
    steps: dict[str, Iterator[int]] = {}
    found = []
    for place, (name, value) in enumerate(losses):
        every = delays.get(name, delay)
        step = next(steps.setdefault(name, (step for step in range(first, last_step + 1) if step % every == 0)))
        if not math.isfinite(value):
            found.append((step, place, name, value))
    if found:
        step, _, name, value = min(found)
        raise TrainingDivergedError(name, value, step)
