import numpy as np
from gymnasium import spaces

from sb3_causalgdp.sources.spaces import flatten_batch, shape_of_arrays

NESTED = spaces.Dict(
    {
        "observation": spaces.Box(-9.0, 9.0, (3,), np.float64),
        "goal": spaces.Dict({"kettle": spaces.Box(-9.0, 9.0, (2,), np.float64), "burner": spaces.Discrete(3, start=1)}),
        "pair": spaces.Tuple((spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2))),
    }
)


def test_batches_are_flattened_as_gymnasium_flattens_one():
    NESTED.seed(0)
    samples = [NESTED.sample() for _ in range(4)]
    batch = {
        "observation": np.stack([one["observation"] for one in samples]),
        "goal": {key: np.stack([one["goal"][key] for one in samples]) for key in ("kettle", "burner")},
        "pair": tuple(np.stack([one["pair"][part] for one in samples]) for part in (0, 1)),
    }
    np.testing.assert_array_equal(flatten_batch(NESTED, batch), np.stack([spaces.flatten(NESTED, one) for one in samples]))


def test_arrays_tell_the_shape_and_the_numbers_of_one_observation():
    arrays = {"camera": np.zeros((4, 8, 8, 3), np.uint8), "pose": {"angle": np.zeros((4, 2)), "gripped": np.zeros(4, bool)}}
    assert shape_of_arrays(arrays) == spaces.Dict(
        camera=spaces.Box(0, 255, (8, 8, 3), np.uint8),
        pose=spaces.Dict(
            angle=spaces.Box(-np.inf, np.inf, (2,), np.float64), gripped=spaces.Box(-np.inf, np.inf, (), np.float32)
        ),
    )
