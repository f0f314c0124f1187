"""Perceptrons side by side, one for each output, whose inputs are masked."""

from typing import NamedTuple

import torch as th
from torch import nn

from sb3_causalgdp.acceleration.activations import tanh_
from sb3_causalgdp.acceleration.products import linear

WeightAndBias = tuple[th.Tensor, th.Tensor]


class Chosen(NamedTuple):
    """Some of the outputs and inputs of masked blocks, by their indices; None stands for all."""

    output_indices: th.Tensor | None = None
    input_indices: th.Tensor | None = None

    def outputs(self, values: th.Tensor, dim: int = 0) -> th.Tensor:
        """
        :param values: One for each output along a dimension
        :param dim: Which
        :return: Those of the chosen outputs
        """
        return values if self.output_indices is None else values.index_select(dim, self.output_indices)

    def inputs(self, values: th.Tensor, dim: int) -> th.Tensor:
        """
        :param values: One for each input along a dimension
        :param dim: Which
        :return: Those of the chosen inputs
        """
        return values if self.input_indices is None else values.index_select(dim, self.input_indices)


ALL = Chosen()


class _BlockLayers(NamedTuple):
    input_weight: th.Tensor
    """Times the mask, shape ``(m, w, p)``."""
    input_bias: th.Tensor
    """Shape ``(m, w)``."""
    hidden: list[WeightAndBias]
    """Of shapes ``(m, w, w)`` and ``(m, 1, w)``."""
    output_weight: th.Tensor
    """Shape ``(m, w)``."""
    output_bias: th.Tensor
    """Shape ``(m,)``."""


class MaskedBlocks(nn.Module):
    """
    One small multi-layer perceptron per output, evaluated for all outputs at once.

    Output j computes ``f_j(mask[j] * x)``. Masking the input of block j is masking its columns of the first layer, so all
    layers are batched products of small matrices. Blocks share nothing: the derivative of output j by an input whose mask is
    0 is exactly 0, and one backward pass gives the Jacobian of all outputs.

    :param n_inputs: Number of inputs p
    :param n_outputs: Number of outputs m
    :param width: Hidden units w of one block
    :param depth: Number of hidden layers, at least 1
    """

    def __init__(self, n_inputs: int, n_outputs: int, width: int, depth: int) -> None:
        super().__init__()
        self.n_outputs = n_outputs
        self.width = width
        self.input_layer = nn.Linear(n_inputs, n_outputs * width)
        bound = width**-0.5
        self.hidden_weights = nn.ParameterList(
            nn.Parameter(th.empty(n_outputs, width, width).uniform_(-bound, bound)) for _ in range(depth - 1)
        )
        self.hidden_biases = nn.ParameterList(
            nn.Parameter(th.empty(n_outputs, 1, width).uniform_(-bound, bound)) for _ in range(depth - 1)
        )
        self.output_weight = nn.Parameter(th.empty(n_outputs, width).uniform_(-bound, bound))
        self.output_bias = nn.Parameter(th.zeros(n_outputs))

    def _layers(self, mask: th.Tensor, chosen: Chosen) -> _BlockLayers:
        """Of the chosen blocks, with the mask in the weights of the chosen inputs."""
        weight, bias = self.input_layer.weight.view(self.n_outputs, self.width, -1), self.input_layer.bias
        return _BlockLayers(
            chosen.inputs(chosen.outputs(weight), 2) * mask.unsqueeze(1),
            chosen.outputs(bias.view(self.n_outputs, self.width)),
            [(chosen.outputs(w), chosen.outputs(b)) for w, b in zip(self.hidden_weights, self.hidden_biases, strict=True)],
            chosen.outputs(self.output_weight),
            chosen.outputs(self.output_bias),
        )

    def _hidden_layers(self, inputs: th.Tensor, of: _BlockLayers) -> list[th.Tensor]:
        """Each of shape ``(m, batch, w)``: in this order, no product of the forward and backward pass needs a copy."""
        # tanh is smooth, as a Jacobian has to be, and cheaper than GELU or SiLU
        # In place: half of the memory, which then stays in the cache
        repeated = inputs.expand(len(of.input_weight), -1, -1)
        layers = [tanh_(th.baddbmm(of.input_bias.unsqueeze(1), repeated, of.input_weight.mT))]
        for hidden_weight, bias in of.hidden:
            layers.append(tanh_(th.baddbmm(bias, layers[-1], hidden_weight)))
        return layers

    def _outputs(self, hidden: th.Tensor, of: _BlockLayers) -> th.Tensor:
        return th.baddbmm(of.output_bias.view(-1, 1, 1), hidden, of.output_weight.unsqueeze(2)).squeeze(2).t()

    def forward(self, inputs: th.Tensor, mask: th.Tensor, chosen: Chosen = ALL) -> th.Tensor:
        """
        :param inputs: The chosen ones, shape ``(batch, p)``
        :param mask: Of the chosen outputs and inputs, shape ``(m, p)``
        :param chosen: Of the outputs and inputs
        :return: The chosen outputs, shape ``(batch, m)``
        """
        layers = self._layers(mask, chosen)
        return self._outputs(self._hidden_layers(inputs, layers)[-1], layers)

    @th.no_grad()
    def forward_and_jacobian(
        self, inputs: th.Tensor, mask: th.Tensor, columns: slice, scale: th.Tensor, chosen: Chosen = ALL
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param inputs: The chosen ones, shape ``(batch, p)``
        :param mask: Of the chosen outputs and inputs, shape ``(m, p)``
        :param columns: Those of these inputs by which to differentiate, q of them
        :param scale: What the outputs are multiplied with before they are differentiated, shape ``(m, 1)``
        :param chosen: Of the outputs and inputs
        :return: The outputs, shape ``(batch, m)``, and their Jacobian, shape ``(batch, m, q)``, both without a graph
        """
        of = self._layers(mask, chosen)
        layers = self._hidden_layers(inputs, of)
        jacobian = self._input_jacobian(layers, of.input_weight[:, :, columns], of.hidden, scale * of.output_weight)
        return self._outputs(layers[-1], of), jacobian

    def _input_jacobian(
        self, layers: list[th.Tensor], input_weight: th.Tensor, hidden: list[WeightAndBias], output_weight: th.Tensor
    ) -> th.Tensor:
        # Each hidden unit belongs to one output: back-propagating all outputs at once keeps their derivatives apart
        gradient = _through_tanh(output_weight.unsqueeze(1), layers[-1])
        for (hidden_weight, _), values in zip(reversed(hidden), reversed(layers[:-1]), strict=True):
            gradient = _through_tanh(th.bmm(gradient, hidden_weight.mT), values)
        return th.bmm(gradient, input_weight).transpose(0, 1)


class ManyMaskedBlocks(MaskedBlocks):
    """
    The same where blocks are many and narrow: the batch is the last dimension of the hidden layers, shape ``(m, w, batch)``,
    so that the first one is one large product that no transposition follows, and the others can be vectorised.
    """

    def _hidden_layers(self, inputs: th.Tensor, of: _BlockLayers) -> list[th.Tensor]:
        first = linear(of.input_weight.flatten(0, 1), inputs) + of.input_bias.flatten().unsqueeze(1)
        layers = [tanh_(first.view(len(of.input_weight), self.width, -1))]
        for hidden_weight, bias in of.hidden:
            layers.append(tanh_(th.baddbmm(bias.mT, hidden_weight.mT, layers[-1])))
        return layers

    def _outputs(self, hidden: th.Tensor, of: _BlockLayers) -> th.Tensor:
        # Of batched products with one row each, PyTorch makes as many calls
        return ((hidden * of.output_weight.unsqueeze(2)).sum(dim=1) + of.output_bias.unsqueeze(1)).t()

    def _input_jacobian(
        self, layers: list[th.Tensor], input_weight: th.Tensor, hidden: list[WeightAndBias], output_weight: th.Tensor
    ) -> th.Tensor:
        gradient = _through_tanh(output_weight.unsqueeze(2), layers[-1])
        for (hidden_weight, _), values in zip(reversed(hidden), reversed(layers[:-1]), strict=True):
            gradient = _through_tanh(th.bmm(hidden_weight, gradient), values)
        return th.bmm(gradient.mT, input_weight).transpose(0, 1)


def _through_tanh(gradient: th.Tensor, output: th.Tensor) -> th.Tensor:
    """``gradient (1 - output^2)`` in one pass over the memory."""
    return th.ops.aten.tanh_backward(gradient, output)


class ActionResponse(NamedTuple):
    """
    What the world model predicts at an action, and how that moves with the action, in raw units and without a graph. It is
    about m of the n states.
    """

    next_state: th.Tensor
    """Mean of the next state, shape ``(batch, n)``; what it is not about is as in the state."""
    next_state_std: th.Tensor
    """Standard deviation of the next state, shape ``(m,)``."""
    standardised_jacobian: th.Tensor
    """d next state / d action in these standard deviations, shape ``(batch, m, d)``."""
    reward: th.Tensor
    """Mean of the reward at the predicted next state, shape ``(batch,)``."""
    reward_std: th.Tensor
    """Standard deviation of the reward, shape ``()``."""
    reward_by_next_state: th.Tensor
    """Partial derivative of the reward by the next state, shape ``(batch, m)``."""
    reward_by_action: th.Tensor
    """Partial derivative of the reward by the action, shape ``(batch, d)``."""
    states: Chosen = ALL
    """What it is about, as outputs of the transition model."""

    @property
    def next_state_jacobian(self) -> th.Tensor:
        """d next state / d action, shape ``(batch, m, d)``."""
        return self.next_state_std.unsqueeze(1) * self.standardised_jacobian

    @property
    def reward_jacobian(self) -> th.Tensor:
        """d reward / d action, the path through the next state included, shape ``(batch, d)``."""
        return self.reward_by_action + self.through_next_state(self.reward_by_next_state)

    def through_next_state(self, *gradients: th.Tensor) -> th.Tensor:
        """
        The chain rule, for several gradients in one pass over the Jacobian.

        :param gradients: Of something by the next state, each of shape ``(batch, m)``
        :return: Of the same by the action, shape ``(batch, d)``; of several, shape ``(batch, q, d)``
        """
        rows = th.stack(gradients, dim=1) * self.next_state_std
        products = rows @ self.standardised_jacobian
        return products if len(gradients) > 1 else products.squeeze(1)
