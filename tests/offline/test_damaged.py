"""Recorded transitions that lack a part say which."""

import pytest
from goal_env import GoalEnv
from small_models import SMALL

from sb3_causalgdp import CausalGDP


def test_a_buffer_that_lacks_an_array_says_which():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL).learn(24)
    del model.replay_buffer.timeouts
    with pytest.raises(ValueError, match=r"The replay buffer lacks \['timeouts'\]"):
        CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL).preload(model.replay_buffer)


def test_observations_that_lack_a_part_are_named():
    buffer = CausalGDP("MultiInputPolicy", GoalEnv(), **SMALL).learn(24).replay_buffer
    del buffer.observations["desired_goal"]
    other = CausalGDP("MultiInputPolicy", GoalEnv(), **SMALL)
    with pytest.raises(ValueError, match=r"does not hold what its observation space announces, in episode 0: KeyError"):
        other.preload(buffer)
    assert other.offline_buffer is None
