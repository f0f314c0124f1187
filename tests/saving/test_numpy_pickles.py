"""Pickles whose names are all known, and whose states point anywhere: numpy believes them."""

import io
import os
import pickle
import random
import subprocess
import sys
from collections import OrderedDict

import numpy as np
import pytest
from numpy._core import multiarray
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from sb3_causalgdp.checkpoints.pickles import from_bytes, to_bytes
from sb3_causalgdp.saving.archives import read_pickle
from sb3_causalgdp.saving.numpy_pickles import check_random_state
from sb3_causalgdp.saving.plain import Known, Reader, Writer


class Call:
    """Pickled as a call, and a state that is set afterwards."""

    def __init__(self, *parts):
        self.parts = parts

    def __reduce__(self):
        return self.parts


ADDRESSES = b"\x41" * 16
OBJECTS = {"a": (np.dtype("O"), 0), "b": (np.dtype("O"), 8)}


def with_wild_dtype():
    """A type of two objects that says of itself that it holds none."""
    dtype = Call(np.dtype, ("V16", False, True), (3, "|", None, ("a", "b"), OBJECTS, 16, 1, 0))
    array = Call(multiarray._reconstruct, (np.ndarray, (0,), b"b"), (1, (1,), dtype, False, ADDRESSES))
    return Call(OrderedDict, (array,))


def with_position(kind, name, position):
    generator = kind(0)
    make, arguments, (state, seeds) = generator.__reduce__()
    inner = state if name in state else state["state"]
    inner[name] = position
    return Call(make, arguments, (state, seeds))


def with_position_of_generator():
    """Set behind the back of the bit generator."""
    state = np.random.MT19937(0).state
    state["state"]["pos"] = 10**9
    return Call(np.random.Generator(np.random.MT19937(0)).__reduce__()[0], ("MT19937",), state)


def with_position_of_random_state():
    make, arguments, state = np.random.RandomState(0).__reduce__()
    state["state"]["pos"] = -(10**9)
    return Call(make, arguments, state)


PICKLES = {
    "a type that lies": with_wild_dtype,
    "addresses": lambda: Call(OrderedDict, (Call(np.ndarray, ((1,), "O,O", ADDRESSES)),)),
    "an array of objects": lambda: Call(np.ndarray, ((2,), "O", ADDRESSES)),
    "a scalar that lies": lambda: Call(
        multiarray.scalar, (Call(np.dtype, ("V16", False, True), (3, "|", None, *4 * (None,), 0)), b"")
    ),
    "text": lambda: Call(np.dtype, ("U4", False, True)),
    "a wild position": lambda: with_position(np.random.MT19937, "pos", 10**9),
    "a position below": lambda: with_position(np.random.Philox, "buffer_pos", -(10**9)),
    "a position of a generator": with_position_of_generator,
    "a position of the old generator": with_position_of_random_state,
}
IN_A_PROCESS = """
import io, sys
from sb3_causalgdp.saving.archives import read_pickle
from sb3_causalgdp.checkpoints.pickles import from_bytes
data = sys.stdin.buffer.read()
for read in (lambda: read_pickle(io.BytesIO(data)), lambda: from_bytes(data)):
    try:
        value = read()
        getattr(value, "random", getattr(value, "random_raw", str))()
    except ValueError as error:
        print("refused:", error)
"""


@pytest.mark.parametrize("name", PICKLES)
def test_a_state_that_points_anywhere_is_refused(name):
    # In a process of its own, which it would end
    run = subprocess.run(
        [sys.executable, "-c", IN_A_PROCESS],
        input=pickle.dumps(PICKLES[name](), 4),
        capture_output=True,
        timeout=120,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert run.returncode == 0, run.stderr.decode()
    assert run.stdout.decode().count("refused:") == 2, run.stdout.decode() + run.stderr.decode()


VALUES = [
    np.arange(6, dtype=np.int64).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(10.0)[::2],
    np.array([True, False]),
    np.array([{}, {"a": 1.0}], dtype=object),
    np.array(1.5, dtype=np.float16),
    np.float32(2.5),
    np.zeros((0, 3)),
]


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("value", VALUES, ids=lambda value: f"{value.dtype}{value.shape}")
def test_arrays_of_numbers_come_back(value, protocol):
    found = read_pickle(io.BytesIO(pickle.dumps(value, protocol)))
    assert type(found) is type(value) and found.dtype == value.dtype
    np.testing.assert_array_equal(found, value)
    if isinstance(found, np.ndarray) and found.size > 0 and protocol < 5:
        assert found.flags.f_contiguous == value.flags.f_contiguous or not value.flags.contiguous


@pytest.mark.parametrize("kind", ["MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64"])
def test_random_numbers_go_on_where_they_were(kind):
    generator = np.random.Generator(getattr(np.random, kind)(3))
    generator.normal(size=5)
    once = read_pickle(io.BytesIO(pickle.dumps(generator, 4)))
    # And once more, from what was read
    twice = from_bytes(to_bytes(once))
    expected = generator.normal(size=2_000)
    np.testing.assert_array_equal(once.normal(size=2_000), expected)
    np.testing.assert_array_equal(twice.normal(size=2_000), expected)
    assert type(pickle.loads(pickle.dumps(twice)).bit_generator) is getattr(np.random, kind)


def test_the_old_random_numbers_go_on_where_they_were():
    generator = np.random.RandomState(3)
    generator.normal(size=5)
    found = from_bytes(to_bytes(generator))
    again = read_pickle(io.BytesIO(pickle.dumps(found, 4)))
    expected = generator.normal(size=2_000)
    np.testing.assert_array_equal(found.normal(size=2_000), expected)
    np.testing.assert_array_equal(again.normal(size=2_000), expected)


@pytest.mark.parametrize("position", [-1, 625, 10**9, None, "1", 0.5])
def test_positions_outside_of_the_memory_are_refused(position):
    state = np.random.MT19937(0).state
    state["state"]["pos"] = position
    with pytest.raises(ValueError, match="pos of random numbers must be from 0 to 624"):
        check_random_state(state)
    legacy = list(np.random.RandomState(0).get_state())
    legacy[2] = position
    with pytest.raises(ValueError, match="pos of random numbers must be from 0 to 624"):
        check_random_state(tuple(legacy))


@pytest.mark.parametrize("make", [lambda: np.random.Generator(np.random.MT19937(0)), lambda: np.random.RandomState(0)])
def test_plain_data_is_looked_at_too(make):
    writer = Writer(Known([]))
    content = writer.encode(make())
    assert Reader(Known([]), b"".join(writer.blocks)).decode(content).random() == make().random()
    text = pickle.dumps(content)
    changed = pickle.loads(text)
    _set_position(changed)
    assert changed != content
    with pytest.raises(ValueError, match="pos of random numbers"):
        Reader(Known([]), b"".join(writer.blocks)).decode(changed)


def _set_position(tree):
    for one in tree if isinstance(tree, list) else tree.values():
        if isinstance(one, list) and len(one) == 2 and one[0] == "pos":
            one[1] = 10**6
        elif isinstance(one, list | dict):
            _set_position(one)


def test_a_bit_in_ten_is_a_file_that_is_refused_or_read():
    generator = random.Random(0)
    data = pickle.dumps({"a": np.arange(50.0), "b": np.random.Generator(np.random.MT19937(0))}, 4)
    n_read = 0
    for _ in range(200):
        changed = bytearray(data)
        changed[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
        try:
            read_pickle(io.BytesIO(bytes(changed)))
            n_read += 1
        except Exception as error:
            assert not isinstance(error, SystemError)
    assert 0 < n_read < 200


READERS = {
    "archives": lambda data: read_pickle(io.BytesIO(data)),
    "checkpoints": lambda data: from_bytes(data, allowed=[GoalSelectionStrategy]),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_member_of_an_enumeration_is_read_as_python_3_11_0_to_3_11_3_write_it(reader):
    data = pickle.dumps(Call(getattr, (GoalSelectionStrategy, "FUTURE")))
    assert READERS[reader](data) is GoalSelectionStrategy.FUTURE


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("of", "name"),
    [
        (bytearray, "fromhex"),
        (GoalSelectionStrategy, "mro"),
        (GoalSelectionStrategy, "__class__"),
        ({}, "pop"),
        (np.float64, "fromhex"),
    ],
)
def test_getattr_gives_nothing_else(reader, of, name):
    with pytest.raises(ValueError, match="no enumeration, which could run code"):
        READERS[reader](pickle.dumps(Call(getattr, (of, name))))
