import math

import pytest
import torch as th
from torch import nn

from sb3_causalgdp.diffusion import MLPDenoiser
from sb3_causalgdp.diffusion.denoisers import sinusoidal_embedding

N_STEPS = 5


@pytest.fixture
def inputs():
    th.manual_seed(0)
    return th.randn(6, 3), th.randn(6, 4)


def make(net_arch=(16, 8), **kwargs):
    th.manual_seed(1)
    return MLPDenoiser(3, 4, N_STEPS, list(net_arch), **kwargs)


@pytest.mark.parametrize("net_arch", [[], [16], [16, 8]])
def test_equals_the_network_on_concatenated_inputs(net_arch, inputs):
    denoiser, (action, condition) = make(net_arch), inputs
    step = th.tensor([0, 1, 2, 3, 4, 2])
    embedded = denoiser.time_mlp(denoiser.time_table[step])
    expected = denoiser.network(denoiser.input_layer(th.cat([action, embedded, condition], dim=1)))
    th.testing.assert_close(denoiser(action, step, condition), expected)


@pytest.mark.parametrize("net_arch", [[], [16, 8]])
@pytest.mark.parametrize("step", [0, 3, th.tensor([0, 1, 2, 3, 4, 2])])
def test_bound_to_a_condition_it_predicts_the_same(net_arch, step, inputs):
    denoiser, (action, condition) = make(net_arch), inputs
    th.testing.assert_close(denoiser.bind(condition)(action, step), denoiser(action, step, condition), rtol=0.0, atol=0.0)


def test_steps_per_sample_equal_one_step_for_all(inputs):
    denoiser, (action, condition) = make(), inputs
    for step in range(N_STEPS):
        per_sample = denoiser(action, th.full((len(action),), step), condition)
        th.testing.assert_close(per_sample, denoiser(action, step, condition))
    mixed = denoiser(action, th.tensor([0, 1, 2, 3, 4, 2]), condition)
    for row, step in enumerate([0, 1, 2, 3, 4, 2]):
        th.testing.assert_close(mixed[row], denoiser(action, step, condition)[row])


def test_without_hidden_layers_it_is_affine_in_action_and_condition(inputs):
    denoiser, (action, condition) = make([]), inputs
    zero = denoiser(th.zeros_like(action), 2, th.zeros_like(condition))
    double = denoiser(2 * action, 2, 2 * condition)
    th.testing.assert_close(double - zero, 2 * (denoiser(action, 2, condition) - zero))
    assert not th.allclose(double, zero)


def test_step_action_and_condition_all_matter(inputs):
    denoiser, (action, condition) = make(), inputs
    outputs = [denoiser(action, step, condition) for step in range(N_STEPS)]
    for first in range(N_STEPS):
        for second in range(first):
            assert not th.allclose(outputs[first], outputs[second])
    assert not th.allclose(outputs[0], denoiser(action + 1.0, 0, condition))
    assert not th.allclose(outputs[0], denoiser(action, 0, condition + 1.0))


def test_gradient_reaches_every_parameter(inputs):
    denoiser, (action, condition) = make(), inputs
    denoiser(action, 3, condition).square().sum().backward()
    for name, parameter in denoiser.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0.0, name


def test_activation_is_the_one_asked_for(inputs):
    action, condition = inputs
    assert not th.allclose(make()(action, 1, condition), make(activation_fn=nn.ReLU)(action, 1, condition))
    assert any(isinstance(module, nn.ReLU) for module in make(activation_fn=nn.ReLU).network)


def test_time_table_is_not_saved():
    assert not any("time_table" in key for key in make().state_dict())


def test_embedding_is_sines_and_cosines_of_falling_frequencies():
    table = sinusoidal_embedding(7, 8)
    assert table.shape == (7, 8)
    for step in range(7):
        for index in range(4):
            angle = step * 10_000 ** (-index / 3)
            assert table[step, index].item() == pytest.approx(math.sin(angle), abs=1e-5)
            assert table[step, 4 + index].item() == pytest.approx(math.cos(angle), abs=1e-5)


@pytest.mark.parametrize("dimension", [0, 2, 5])
def test_an_odd_or_tiny_embedding_is_refused(dimension):
    with pytest.raises(ValueError, match="time_embedding_dim must be an even number of at least 4"):
        make(time_embedding_dim=dimension)
