"""Gradients of losses, and what compiles them."""

import pytest
import torch as th

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration.gradients import compiled, gradients_of


def make_network():
    return th.nn.Sequential(th.nn.Linear(3, 4), th.nn.Tanh(), th.nn.Linear(4, 1))


def test_gradients_are_those_of_backward_and_of_this_module_alone():
    network, judge, unused = make_network(), th.nn.Linear(1, 1), th.nn.Linear(2, 2)
    network[0].bias.requires_grad_(False)
    module = th.nn.ModuleList([network, unused])
    inputs = th.randn(5, 3)

    def loss():
        return judge(network(inputs)).square().mean()

    gradients = gradients_of(module, loss())
    assert all(parameter.grad is None for parameter in (*module.parameters(), *judge.parameters()))
    loss().backward()
    assert [gradient is None for gradient in gradients] == [False, True, False, False, True, True]
    for parameter, gradient in zip(module.parameters(), gradients, strict=True):
        th.testing.assert_close(gradient, parameter.grad, rtol=0, atol=0)


class Trainer:
    def __init__(self):
        self.network = make_network()

    def gradients(self, inputs):
        noise = th.randn(len(inputs), 1)
        return gradients_of(self.network, (self.network(inputs) - noise).square().mean())


def test_every_object_has_graphs_of_its_own_however_many_there_are(monkeypatch):
    compile_, n_graphs = th.compile, []

    def count(graph, _):
        n_graphs.append(1)
        return graph

    monkeypatch.setattr(th, "compile", lambda function, options, **kwargs: compile_(function, backend=count, **kwargs))
    for index in range(2 * th._dynamo.config.recompile_limit):
        gradients = compiled(Trainer().gradients, True, th.device("cpu"))
        gradients(th.randn(5, 3)), gradients(th.randn(5, 3))
        assert len(n_graphs) == index + 1


def test_compile_says_that_a_compiler_is_missing_but_a_saved_model_plays_without(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", compile=True)
    model.save(tmp_path / "model")
    message = "compile=True needs a C.. compiler such as g.., and none was found"
    with th._inductor.config.patch({"cpp.cxx": ("no-such-compiler",)}):
        with pytest.raises(ValueError, match=message):
            CausalGDP("MlpPolicy", "Pendulum-v1", compile=True)
        loaded = CausalGDP.load(tmp_path / "model", env=model.get_env())
        assert loaded.predict(loaded.get_env().reset())[0].shape == (1, 1)
        with pytest.raises(ValueError, match=message):
            loaded.learn(1)
        plain = CausalGDP.load(tmp_path / "model", env=model.get_env(), custom_objects={"compile": False})
        assert plain.learn(1).num_timesteps == 1


@pytest.mark.parametrize("mode", ["fast", 2, None])
def test_unknown_compile_modes_are_named(mode):
    with pytest.raises(ValueError, match=r"compile must be True(,| or) False(,| or) 'auto' or (one|a mode) of"):
        CausalGDP("MlpPolicy", "Pendulum-v1", compile=mode)


def test_compile_says_which_pytorch_it_needs(monkeypatch):
    monkeypatch.delattr(th._dynamo.config, "trace_autograd_ops", raising=False)
    monkeypatch.setattr(th, "compile", lambda model, mode=None: model)
    with pytest.raises(ValueError, match=r"needs PyTorch 2\.13 or newer"):
        CausalGDP("MlpPolicy", "Pendulum-v1", compile=True)
