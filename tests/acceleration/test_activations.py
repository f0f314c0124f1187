"""Fast activations compute what PyTorch's do."""

import pytest
import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_causalgdp.acceleration.activations import FastMish, exponential, fast, tanh_
from sb3_causalgdp.diffusion.denoisers import MLPDenoiser


@pytest.mark.parametrize("is_compiling", [False, True])
@pytest.mark.parametrize("dtype, tolerance", [(th.float32, 2e-6), (th.float64, 1e-14)])
def test_mish_and_its_gradient_are_those_of_pytorch(dtype, tolerance, is_compiling, monkeypatch):
    # What a compiler would see, as operations of their own
    monkeypatch.setattr(th.compiler, "is_compiling", lambda: is_compiling)
    x = th.linspace(-90.0, 90.0, 20_001, dtype=dtype, requires_grad=True)
    ours, theirs = FastMish()(x), F.mish(x)
    th.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)
    gradient_of = [th.autograd.grad(y.square().sum(), x)[0] for y in (ours, theirs)]
    th.testing.assert_close(*gradient_of, rtol=10 * tolerance, atol=10 * tolerance)


def test_mish_without_gradients_leaves_its_input_alone():
    x = th.randn(50)
    before = x.clone()
    with th.no_grad():
        th.testing.assert_close(FastMish()(x), F.mish(before), rtol=1e-6, atol=1e-6)
        large = th.linspace(-90.0, 90.0, 2_001)
        th.testing.assert_close(FastMish()(large), F.mish(large), rtol=1e-6, atol=90 * 1e-7)
    th.testing.assert_close(x, before, rtol=0, atol=0)


def test_mish_in_forward_mode():
    x, tangent = th.randn(50, dtype=th.float64), th.randn(50, dtype=th.float64)
    with th.no_grad():
        pairs = [th.func.jvp(function, (x,), (tangent,)) for function in (FastMish(), F.mish)]
    th.testing.assert_close(*pairs)


def test_networks_of_the_user_s_mish_are_fast_and_keep_their_weights_names():
    denoiser = MLPDenoiser(2, 3, 5, [8, 8], nn.Mish)
    assert sum(type(layer) is FastMish for layer in denoiser.network) == 2
    assert list(denoiser.network.state_dict()) == ["1.weight", "1.bias", "3.weight", "3.bias"]
    assert isinstance(fast(nn.Mish)(), nn.Mish)


def test_other_activations_are_themselves():
    assert fast(nn.Tanh) is nn.Tanh
    assert type(fast(nn.ReLU)()) is nn.ReLU


@pytest.mark.parametrize("dtype, tolerance", [(th.float32, 2e-6), (th.float64, 1e-14)])
def test_exponentials_are_those_of_pytorch(dtype, tolerance):
    x = th.linspace(-20.0, 20.0, 10_001, dtype=dtype)
    before = x.clone()
    th.testing.assert_close(exponential(x), x.exp(), rtol=2 * tolerance, atol=0)
    assert th.equal(x, before)
    assert exponential(th.tensor([-1e4, 1e4], dtype=dtype)).tolist() == [0.0, float("inf")]


@pytest.mark.parametrize("is_compiling", [False, True])
@pytest.mark.parametrize("dtype, tolerance", [(th.float32, 4e-7), (th.float64, 1e-15)])
def test_tanh_and_its_derivatives_are_those_of_pytorch(dtype, tolerance, is_compiling, monkeypatch):
    monkeypatch.setattr(th.compiler, "is_compiling", lambda: is_compiling)
    x = th.linspace(-90.0, 90.0, 20_001, dtype=dtype, requires_grad=True)
    ours, theirs = tanh_(x.clone()), x.tanh()
    th.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)
    first = [th.autograd.grad(y.square().sum(), x, create_graph=True)[0] for y in (ours, theirs)]
    th.testing.assert_close(*first, rtol=0, atol=4 * tolerance)
    second = [th.autograd.grad(slope.sum(), x)[0] for slope in first]
    th.testing.assert_close(*second, rtol=0, atol=20 * tolerance)


def test_tanh_writes_over_what_it_is_given():
    x = th.randn(50)
    expected = x.tanh()
    with th.no_grad():
        assert tanh_(x) is x
    th.testing.assert_close(x, expected)
    leaf = th.randn(50, requires_grad=True)
    hidden = leaf * 1.0
    assert tanh_(hidden).data_ptr() == hidden.data_ptr()
