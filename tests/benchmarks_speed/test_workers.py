import io
import json
from pathlib import Path

import pytest

from benchmarks.speed.client import Contestant, Field
from benchmarks.speed.data import save, synthetic
from benchmarks.speed.workers.causalgdp import CausalGDPContestant, supported
from benchmarks.speed.workers.diffusion_ql import DiffusionQLContestant
from benchmarks.speed.workers.protocol import NotAvailable, serve

SMALL = {"policy_kwargs": {"net_arch": [8]}}


@pytest.fixture
def config(tmp_path):
    transitions = save(tmp_path / "rows.npz", synthetic(n_states=3, n_actions=2, n_rows=300))
    return {"transitions": transitions, "batch_size": 16, "kwargs": SMALL}


def test_causalgdp_is_measured_with_a_filled_buffer_and_a_graph(config):
    contestant = CausalGDPContestant(config)
    assert contestant.model.replay_buffer.size() == 300
    assert contestant.about()["settings"]["guided"]
    contestant.update(3)
    assert contestant.model._n_updates == 3


def test_updates_can_be_asked_for_one_at_a_time(config):
    contestant = CausalGDPContestant({**config, "updates_per_call": 1})
    calls = []
    contestant.model.train = lambda **kwargs: calls.append(kwargs)
    contestant.update(3)
    assert calls == [{"gradient_steps": 1, "batch_size": 16}] * 3


def test_the_parts_of_an_update_make_up_all_of_it(config):
    profile = CausalGDPContestant(config).profile(5)
    assert sum(profile["parts"].values()) == pytest.approx(profile["wrapped"])
    # Not more, because a processor's clock may tick in milliseconds
    assert profile["wrapped"] >= profile["functions"]["sb3_causalgdp.causalgdp.CausalGDP.train"]["inclusive"] > 0.0
    assert {"critics", "TD target", "optimizers", "sample", "targets", "world model"} <= set(profile["parts"])


def test_an_argument_that_does_not_exist_is_not_available():
    assert supported({"eta": 1.0}) == {"eta": 1.0}
    with pytest.raises(NotAvailable, match="no argument of_tomorrow='yes'"):
        supported({"of_tomorrow": "yes"})


def test_a_worker_answers_every_line():
    class Adder:
        def __init__(self, start):
            self.total = start

        def about(self):
            return {"total": self.total}

        def add(self, n):
            self.total += n
            return self.total

    def make(config):
        if config < 0:
            raise NotAvailable("nothing below 0")
        return Adder(config)

    requests = [("setup", {"config": -1}), ("setup", {"config": 1}), ("add", {"n": 2}), ("add", {"n": "two"})]
    lines = [json.dumps({"call": call, "arguments": arguments}) for call, arguments in requests]
    sink = io.StringIO()
    serve(make, io.StringIO("\n".join(lines)), sink)
    answers = [json.loads(line) for line in sink.getvalue().splitlines()]
    assert [answer["status"] for answer in answers] == ["not available", "ok", "ok", "failed"]
    assert [answer.get("value") for answer in answers] == [None, {"total": 1}, 3, None]
    assert answers[2]["cpu"] >= 0.0


def test_processes_take_turns_and_who_is_absent_is_named(config, tmp_path):
    who = [Contestant("SAC", "sb3", {"algorithm": "SAC", "kwargs": SMALL}), Contestant("nobody", "no_such_module")]
    shared = {key: config[key] for key in ("transitions", "batch_size")}
    with Field(who, Path(tmp_path / "log"), **shared) as field:
        seconds = field.interleaved(2, lambda worker: worker.ask("update", n=2)["cpu"])
    assert list(seconds) == ["SAC"] and len(seconds["SAC"]) == 2 and min(seconds["SAC"]) > 0.0
    assert field.absent["nobody"]["status"] == "failed"
    assert "No module named" in (tmp_path / "log").read_text()


def test_a_checkout_that_is_not_there_is_not_available(tmp_path):
    with pytest.raises(NotAvailable, match="has no module"):
        DiffusionQLContestant({"path": str(tmp_path), "diffusion_steps": 5})
