"""Inside networks, when an input or an output is hidden or shown again: nothing jumps, and nothing old comes back."""

from collections.abc import Iterable, Iterator

import torch as th
from torch import nn

SECOND_MOMENTS = ("sq", "sum")  # in the names that optimizers give to means of squared gradients


def forget_inputs(
    network: Iterable[nn.Module],
    columns: th.Tensor,
    known: th.Tensor,
    unit: tuple[th.Tensor, th.Tensor],
    optimizer: th.optim.Optimizer | None,
) -> None:
    """
    Let a network begin anew with inputs that were 0 for a while: their weights become 0, and what a batch normalisation gave
    for them moves into the bias, so that the network's output stays what it was.

    :param network: Its modules in their order: the first linear layer, perhaps behind a batch normalisation
    :param columns: Which inputs begin anew, boolean, shape ``(inputs,)``
    :param known: Which inputs were seen before, boolean, shape ``(inputs,)``
    :param unit: Mean and variance that the inputs will have, each of shape ``(inputs,)``
    :param optimizer: Of its parameters, None if it has none
    """
    modules = list(network)
    layer = next(module for module in modules if isinstance(module, nn.Linear))
    norm = modules[0]
    if isinstance(norm, nn.BatchNorm1d):
        assert norm.running_mean is not None and norm.running_var is not None
        scale = norm.weight / (norm.running_var + norm.eps).sqrt()
        of_zeros = norm.bias - norm.running_mean * scale
        layer.bias.add_(layer.weight @ th.where(columns, of_zeros, 0.0))
        norm.weight[columns], norm.bias[columns] = 1.0, 0.0
        # Those of a constant would magnify what now comes by up to 1 / sqrt(eps)
        norm.running_mean[columns], norm.running_var[columns] = unit[0][columns], unit[1][columns]
        for parameter in (norm.weight, norm.bias):
            _forget_moments(optimizer, parameter, columns, known)
    layer.weight[:, columns] = 0.0
    _forget_moments(optimizer, layer.weight, columns, known)


def forget_outputs(layer: nn.Linear, rows: th.Tensor, optimizer: th.optim.Optimizer | None) -> None:
    """
    Let outputs of a linear layer be 0, and stay there as long as no gradient moves them.

    :param layer: The last layer of a network
    :param rows: Which outputs, boolean, shape ``(outputs,)``
    :param optimizer: Of its parameters, None if it has none
    """
    for parameter in (layer.weight, layer.bias):
        parameter[rows] = 0.0
        for moment in _moments(optimizer, parameter):
            moment[1][rows] = 0.0


def forget_rows(
    parameters: Iterable[th.Tensor], rows: th.Tensor, known: th.Tensor, optimizer: th.optim.Optimizer | None
) -> None:
    """
    Let networks that lie in rows of common parameters, and were not trained for a while, go on with what they know and a
    memory of gradients like that of the others, and not one that has died away.

    :param parameters: Those of shape ``(rows * a, ...)`` hold ``a`` entries for each network
    :param rows: Which networks go on, boolean, shape ``(rows,)``
    :param known: Which were trained, boolean, shape ``(rows,)``
    :param optimizer: Of the parameters, None if there is none
    """
    if not bool(rows.any()):
        return
    for parameter in parameters:
        for name, moment in _moments(optimizer, parameter):
            of_rows = moment.view(len(rows), -1)
            others: float | th.Tensor = 0.0
            if name.endswith(SECOND_MOMENTS) and bool(known.any()):
                others = of_rows[known].mean()
            of_rows[rows] = others


def _forget_moments(optimizer: th.optim.Optimizer | None, parameter: th.Tensor, columns: th.Tensor, known: th.Tensor) -> None:
    for name, moment in _moments(optimizer, parameter):
        others: float | th.Tensor = 0.0
        if name.endswith(SECOND_MOMENTS) and bool(known.any()):
            # With 0, Adam's first steps would be up to 30 times as long as all others
            others = moment[..., known].mean(dim=-1, keepdim=True)
        moment[..., columns] = others


def _moments(optimizer: th.optim.Optimizer | None, parameter: th.Tensor) -> Iterator[tuple[str, th.Tensor]]:
    """What the optimizer keeps for each entry of a parameter, by name."""
    states = {} if optimizer is None else optimizer.state.get(parameter, {})
    for name, value in states.items():
        if isinstance(value, th.Tensor) and value.shape == parameter.shape:
            yield name, value
