"""Linear layers compute the same on either library, with and without gradients, and fall back where one cannot."""

import copy
import subprocess
import sys
from pathlib import Path

import pytest
import torch as th
import torch.nn.functional as F
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration import products
from sb3_causalgdp.acceleration.gradients import compiled, gradients_of
from sb3_causalgdp.acceleration.products import Linear, linear, make_layers_fast, use_library, uses_onednn

has_onednn = pytest.mark.skipif(products._onednn_product() is None, reason="this PyTorch has no linear layers of oneDNN")


@pytest.fixture(autouse=True)
def library_as_before():
    use_library("auto")
    yield
    use_library("auto")


@pytest.fixture
def onednn_calls(monkeypatch):
    """Counts the products that oneDNN gets."""
    calls, product = [], products._onednn_product()

    def count(*args):
        calls.append(args)
        return product(*args)

    monkeypatch.setattr(products, "_onednn_product", lambda: count)
    use_library("onednn")
    return calls


def close(ours, theirs):
    scale = theirs.abs().max().item()
    th.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5 * scale)


def layer(batch, inputs, outputs):
    return (
        th.randn(batch, inputs, requires_grad=True),
        nn.Parameter(th.randn(outputs, inputs)),
        nn.Parameter(th.randn(outputs)),
    )


@has_onednn
@pytest.mark.parametrize("sizes", [(256, 256, 256), (64, 17, 31), (16, 16, 16), (256, 365, 256)])
@pytest.mark.parametrize("with_bias", [True, False])
def test_values_and_gradients_are_those_of_pytorch(sizes, with_bias, onednn_calls):
    x, weight, bias = layer(*sizes)
    leaves = (x, weight, bias) if with_bias else (x, weight)
    gradient = th.randn(sizes[0], sizes[2])
    ours, theirs = linear(*leaves), F.linear(*leaves)
    assert len(onednn_calls) == 1
    close(ours, theirs)
    for found, expected in zip(*(th.autograd.grad(y, leaves, gradient) for y in (ours, theirs)), strict=True):
        close(found, expected)
    assert len(onednn_calls) == 3
    with th.no_grad():
        close(linear(*leaves), theirs)


@has_onednn
def test_only_the_gradients_that_are_asked_for_are_computed(onednn_calls):
    x, weight, bias = layer(32, 32, 32)
    th.autograd.grad(linear(x.detach(), weight, bias).sum(), (weight, bias))
    assert len(onednn_calls) == 2
    th.autograd.grad(linear(x, weight.detach(), bias.detach()).sum(), x)
    assert len(onednn_calls) == 4


@has_onednn
def test_derivatives_of_derivatives_are_those_of_pytorch(onednn_calls):
    x, weight, bias = layer(32, 24, 16)
    second = []
    for function in (linear, F.linear):
        (slope,) = th.autograd.grad(function(x, weight, bias).tanh().sum(), x, create_graph=True)
        second.append(th.autograd.grad(slope.square().sum(), (x, weight)))
    for found, expected in zip(*second, strict=True):
        close(found, expected)


@has_onednn
def test_a_part_of_a_larger_matrix_is_copied_first(onednn_calls):
    # With strides of the larger one, oneDNN takes hundreds of times as long
    x, weight = th.randn(256, 17), th.randn(64, 39)[:, 20:37]
    with th.no_grad():
        close(linear(x, weight), F.linear(x, weight))
    ((_, used, _),) = onednn_calls
    assert used.is_contiguous()


def in_forward_mode(function, x, weight):
    return th.func.jvp(lambda inputs: function(inputs, weight), (x,), (th.ones_like(x),))[1]


def in_vmap(function, x, weight):
    return th.func.vmap(lambda inputs: function(inputs, weight))(x.expand(3, -1, -1))


def in_a_trace(function, x, weight):
    # Otherwise it runs the plain function once more, to compare
    return th.jit.trace(function, (x, weight), check_trace=False)(x, weight)


def in_an_exported_program(function, x, weight):
    class Module(nn.Module):
        def forward(self, x, weight):
            return function(x, weight)

    return th.export.export(Module(), (x, weight)).module()(x, weight)


def in_a_counter(function, x, weight):
    with FlopCounterMode(display=False) as counter:
        y = function(x, weight)
    assert counter.get_total_flops() == 2 * 32**3
    return y


def in_autocast(function, x, weight):
    with th.autocast("cpu", dtype=th.bfloat16):
        return function(x, weight)


@has_onednn
@pytest.mark.parametrize("way", [in_forward_mode, in_vmap, in_autocast, in_a_trace, in_an_exported_program, in_a_counter])
def test_what_onednn_cannot_do_is_left_to_pytorch(way, onednn_calls):
    x, weight = th.randn(32, 32), th.randn(32, 32)
    with th.no_grad():
        th.testing.assert_close(way(linear, x, weight), way(F.linear, x, weight), rtol=0, atol=0)
    assert not onednn_calls


@has_onednn
@pytest.mark.parametrize(
    "x, weight",
    [
        (th.ones(32, 32, dtype=th.float64), th.ones(32, 32, dtype=th.float64)),
        (th.ones(32, 4), th.ones(32, 4)),
        (th.ones(4, 32), th.ones(32, 32)),
        (th.ones(32, 32), th.ones(1, 32)),
        (th.ones(2, 32, 32), th.ones(32, 32)),
    ],
    ids=["double precision", "few inputs", "few rows", "one output", "three dimensions"],
)
def test_other_products_are_pytorchs_own(x, weight, onednn_calls):
    th.testing.assert_close(linear(x, weight), F.linear(x, weight), rtol=0, atol=0)
    assert not onednn_calls


def test_without_onednn_everything_is_pytorchs_own(monkeypatch):
    monkeypatch.setattr(products, "_onednn_product", lambda: None)
    products._onednn_is_faster.cache_clear()
    assert not uses_onednn()
    x, weight, bias = layer(64, 64, 64)
    th.testing.assert_close(linear(x, weight, bias), F.linear(x, weight, bias), rtol=0, atol=0)
    with pytest.raises(ValueError, match="has no linear layers of oneDNN here, got 'onednn': take 'auto' or 'default'"):
        use_library("onednn")
    products._onednn_is_faster.cache_clear()


def test_an_unknown_library_is_named():
    with pytest.raises(ValueError, match=r"Unknown library 'mkl': it must be one of \['auto', 'default', 'onednn'\]"):
        use_library("mkl")


@has_onednn
@pytest.mark.parametrize("speedup, expected", [(2.0, True), (1.1, False), (0.7, False)])
def test_onednn_is_chosen_where_it_is_faster_by_far(speedup, expected, monkeypatch):
    monkeypatch.setattr(
        products, "_seconds", lambda function: 1.0 / speedup if "product" in function.__code__.co_freevars else 1.0
    )
    products._onednn_is_faster.cache_clear()
    assert uses_onednn() is expected
    products._onednn_is_faster.cache_clear()


def test_fast_layers_have_the_parameters_of_the_plain_ones_and_draw_no_random_numbers():
    network = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 1, bias=False))
    names, parameters, state = list(network.state_dict()), list(network.parameters()), th.get_rng_state()
    plain = copy.deepcopy(network)
    make_layers_fast(network)
    assert th.equal(th.get_rng_state(), state)
    assert [type(one) for one in network] == [Linear, nn.ReLU, Linear]
    assert list(network.state_dict()) == names
    assert all(after is before for after, before in zip(network.parameters(), parameters, strict=True))
    x = th.randn(5, 3)
    th.testing.assert_close(network(x), plain(x), rtol=0, atol=0)


def changes_of_an_update(library):
    use_library(library)
    arguments = {"learning_starts": 250, "causal_refresh_freq": 205, "batch_size": 64, "seed": 0}
    # Batch statistics and Adam's first step make more of a rounding
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **arguments, policy_kwargs={"critic_normalization": "layer"})
    model.learn(250)
    assert model.policy.is_guided
    before = th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()
    model.train(gradient_steps=2, batch_size=64)
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach() - before


@has_onednn
def test_an_update_with_guidance_is_the_same_on_both_libraries():
    theirs, ours = (changes_of_an_update(library) for library in ("default", "onednn"))
    assert (ours - theirs).norm() < 1e-3 * theirs.norm()


class Trainer:
    def __init__(self):
        self.network = nn.Sequential(nn.Linear(24, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 1))

    def gradients(self, inputs):
        return gradients_of(self.network, self.network(inputs).square().mean())


@has_onednn
def test_a_compiled_graph_has_its_products_from_onednn_and_the_same_gradients(onednn_calls):
    trainer, inputs = Trainer(), th.randn(64, 24)
    for found, expected in zip(
        compiled(trainer.gradients, True, th.device("cpu"))(inputs), trainer.gradients(inputs), strict=True
    ):
        close(found, expected)
    # Forward and by its weight for two layers, and by its input for one
    assert len(onednn_calls) == 5


def test_a_process_measures_no_library_before_a_large_product():
    program = (
        "from sb3_causalgdp.acceleration import products; from sb3_causalgdp import CausalGDP; import torch as th\n"
        "products.linear(th.ones(2, 3), th.ones(4, 3))\n"
        "assert products._onednn_is_faster.cache_info().misses == 0\n"
        "products.linear(th.ones(32, 32), th.ones(32, 32))\n"
        "assert products._onednn_is_faster.cache_info().misses == 1\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parent)
