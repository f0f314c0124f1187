import numpy as np
import pytest
import torch as th
from ones import Ones
from small_models import SMALL
from stable_baselines3.common.callbacks import BaseCallback

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.callbacks.calibration import QErrors, calibrated

DISCOUNT = 0.99


class Saying(BaseCallback):
    """Critics that say these values whatever they are asked."""

    def __init__(self, *values):
        super().__init__()
        self.values = values

    def _on_step(self):
        with th.no_grad():
            for network, value in zip(self.model.critic_target.q_networks, self.values, strict=True):
                network[-1].weight.zero_()
                network[-1].bias.fill_(value)
        return True


def trained(*values, n_steps=200, **kwargs):
    """On rewards of 1 in ten steps, of which 5.4 are obtained in the mean."""
    model = CausalGDP(
        "MlpPolicy",
        Ones(),
        **{**SMALL, "train_freq": 1, "causal_refresh_freq": 20, "gamma": 0.5, "pessimism": "auto", **kwargs},
    )
    return model.learn(n_steps, callback=[Saying(*values), CausalWorldModelCallback(min_transitions=10**6)])


def test_errors_are_those_of_the_mean_and_of_the_smallest():
    errors = QErrors.of(np.array([[1.0, 3.0], [8.0, 4.0]]), np.array([1.0, 5.0]))
    assert errors == (1.0, -0.5, 1.5, 3.0)


def test_a_step_moves_q_by_a_quarter_of_its_error():
    errors = QErrors(of_mean=4.0, of_smallest=0.0, gap=0.4, obtained=0.0)
    moved = calibrated(0.5, errors, DISCOUNT) - 0.5
    # Each backup takes off that much more of the gap, and a hundred of them count
    assert moved * errors.gap / (1.0 - DISCOUNT) == pytest.approx(0.25 * errors.of_mean)
    assert calibrated(0.5, errors._replace(of_mean=-4.0), DISCOUNT) == pytest.approx(0.5 - moved)


@pytest.mark.parametrize("obtained", [-20.0, 20.0])
def test_a_tenth_more_than_was_obtained_is_right(obtained):
    errors = QErrors(of_mean=2.0, of_smallest=0.0, gap=0.1, obtained=obtained)
    assert calibrated(0.5, errors, DISCOUNT) == pytest.approx(0.5)
    assert (
        calibrated(0.5, errors._replace(of_mean=1.0), DISCOUNT) < 0.5 < calibrated(0.5, errors._replace(of_mean=3.0), DISCOUNT)
    )


@pytest.mark.parametrize(("of_mean", "expected"), [(1e9, 0.75), (-1e9, 0.25), (0.0, 0.5)])
def test_no_step_is_longer_than_a_quarter(of_mean, expected):
    assert calibrated(0.5, QErrors(of_mean, of_mean, 1.0, 0.0), DISCOUNT) == pytest.approx(expected)


@pytest.mark.parametrize(("pessimism", "of_mean"), [(0.9, 1e9), (0.1, -1e9)])
def test_it_stays_between_the_mean_and_the_smallest(pessimism, of_mean):
    assert calibrated(pessimism, QErrors(of_mean, of_mean, 1.0, 0.0), DISCOUNT) == float(of_mean > 0)


def test_critics_that_agree_change_nothing():
    assert calibrated(0.3, QErrors(5.0, 5.0, 0.0, 0.0), DISCOUNT) == 0.3


@pytest.mark.parametrize(("values", "expected"), [((9.0, 10.0), 1.0), ((-9.0, -10.0), 0.0)])
def test_targets_get_pessimistic_where_critics_promise_too_much(values, expected):
    model = trained(*values)
    assert model.calibrated_pessimism == expected
    with model._updates.made_fast(lambda *_: {}):
        assert model._updates.pessimism == expected


def test_critics_are_held_to_what_they_say_only_after_some_updates():
    assert trained(9.0, 10.0, n_steps=50).calibrated_pessimism == 0.0


def test_a_number_stays_what_it_is():
    model = trained(9.0, 10.0, pessimism=0.25)
    assert model.calibrated_pessimism == 0.0
    with model._updates.made_fast(lambda *_: {}):
        assert model._updates.pessimism == 0.25


def test_pretraining_takes_the_smallest_and_what_was_calibrated_is_saved(tmp_path):
    source = CausalGDP("MlpPolicy", Ones(), **SMALL).learn(40)
    assert source.calibrated_pessimism == 0.0
    source.save_replay_buffer(tmp_path / "buffer")
    model = CausalGDP("MlpPolicy", Ones(), pessimism="auto", **SMALL)
    model.preload(tmp_path / "buffer.npz")
    model.pretrain(2)
    assert model.calibrated_pessimism == 1.0
    model.save(tmp_path / "model")
    assert CausalGDP.load(tmp_path / "model").calibrated_pessimism == 1.0


@pytest.mark.parametrize("value", [-0.1, 1.1, "yes", None])
def test_other_values_are_refused(value):
    with pytest.raises(ValueError, match="pessimism must be a number from 0 to 1 or 'auto'"):
        CausalGDP("MlpPolicy", Ones(), pessimism=value)


def test_pretraining_takes_the_smallest_whatever_is_set_and_learning_what_is_set(tmp_path):
    source = CausalGDP("MlpPolicy", Ones(), **SMALL).learn(40)
    source.save_replay_buffer(tmp_path / "buffer")
    model = CausalGDP("MlpPolicy", Ones(), pessimism=0.25, **SMALL)
    model.preload(tmp_path / "buffer.npz")
    model.pretrain(2)
    assert model._updates.pessimism == 1.0
    model.learn(40)
    assert model._updates.pessimism == 0.25
