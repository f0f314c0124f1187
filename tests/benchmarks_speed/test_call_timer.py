import sys
import types

import pytest

from benchmarks.speed.workers.call_timer import OTHER, CallTimer, Part

PARTS = (Part("optimizer", "step$", "always"), Part("target", "target", "firm"), Part("critics", "update_critics", "loose"))


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def package():
    """What a package looks like whose functions call each other; every one of them takes one second by itself."""
    clock = Clock()
    module = types.ModuleType("timed_package")
    source = """
def critic(): spend()
def step(): spend()
def td_target():
    spend()
    critic()
def update_critics():
    spend()
    td_target()
    critic()
    step()
class Model:
    def train(self):
        spend()
        update_critics()
"""
    module.spend = lambda: setattr(clock, "now", clock.now + 1.0)
    module.spend.__module__ = "elsewhere"
    exec(compile(source, "timed_package", "exec"), module.__dict__)
    sys.modules["timed_package"] = module
    yield module, clock
    del sys.modules["timed_package"]


def test_time_goes_to_the_part_that_asked_for_it(package):
    module, clock = package
    timer = CallTimer(PARTS, clock)
    with timer.attached(("timed_package",)):
        module.Model().train()
    assert timer.seconds == {OTHER: 1.0, "critics": 2.0, "target": 2.0, "optimizer": 1.0}
    assert sum(timer.seconds.values()) == clock.now
    critic = timer.functions["timed_package.critic"]
    assert (critic.calls, critic.exclusive, critic.inclusive) == (2, 2.0, 2.0)
    assert timer.functions["timed_package.update_critics"].inclusive == 5.0


def test_a_method_that_an_object_keeps_is_timed_too(package):
    module, clock = package
    model = module.Model()
    model.kept = model.train
    timer = CallTimer(PARTS, clock)
    with timer.attached(("timed_package",), owner=model):
        model.kept()
    assert timer.functions["timed_package.Model.kept"].inclusive == clock.now == 6.0
    assert "kept" in vars(model) and model.kept == model.train


def test_everything_is_as_before_afterwards(package):
    module, clock = package
    before = module.critic, module.Model.train
    with CallTimer(PARTS, clock).attached(("timed_package",)):
        assert module.critic is not before[0]
    assert (module.critic, module.Model.train) == before
