"""Tests of rhp_drake.drivers.shared_memory."""

import math
import multiprocessing
import time

import numpy as np
import pytest

from rhp_drake.drivers.shared_memory import SharedVector

SIZE = 500  # Large, so that a torn copy is likely.
PATIENCE = 60  # s: a busy machine starts a process slowly.


def count_up(vector):
    """Writes 1, 1, ...; 2, 2, ...; and so on until killed."""
    number = 0
    while True:
        number += 1
        vector.write(np.full(SIZE, float(number)))


@pytest.fixture
def vector_and_writer():
    vector = SharedVector(SIZE)
    writer = multiprocessing.get_context("spawn").Process(
        target=count_up, args=(vector,), daemon=True
    )
    writer.start()
    deadline = time.monotonic() + PATIENCE
    while math.isnan(vector.read()[1]) and time.monotonic() < deadline:
        time.sleep(0.01)
    yield vector, writer
    writer.kill()
    writer.join()


def test_nan_before_the_first_write():
    values, stamp = SharedVector(3).read()
    np.testing.assert_array_equal(values, np.full(3, math.nan))
    assert math.isnan(stamp)


def test_reads_what_was_written_last():
    dut = SharedVector(3)
    for number in range(4):
        before = time.monotonic()
        dut.write(np.array([1.0, math.nan, number]))
        values, stamp = dut.read()
        np.testing.assert_array_equal(values, [1.0, math.nan, number])
        assert before <= stamp <= time.monotonic()


def test_a_copy_is_the_readers_own():
    dut = SharedVector(2)
    written = np.zeros(2)
    dut.write(written)
    written[0] = 1.0
    dut.read()[0][1] = 2.0
    np.testing.assert_array_equal(dut.read()[0], np.zeros(2))


@pytest.mark.parametrize("values", [np.zeros(2), np.zeros((1, 3)), 1.0])
def test_wrong_shape(values):
    dut = SharedVector(3)
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        dut.write(values)
    assert math.isnan(dut.read()[1])


def test_needs_an_element():
    with pytest.raises(ValueError, match="at least one"):
        SharedVector(0)


def test_no_copy_is_torn_and_time_goes_on(vector_and_writer):
    dut, _ = vector_and_writer
    last_number, last_stamp = 0.0, 0.0
    numbers = set()
    for _ in range(20_000):
        values, stamp = dut.read()
        assert (values == values[0]).all()
        assert values[0] >= last_number
        assert stamp >= last_stamp
        last_number, last_stamp = values[0], stamp
        numbers.add(last_number)
    assert len(numbers) > 10


def test_a_killed_writer_leaves_a_whole_vector(vector_and_writer):
    dut, writer = vector_and_writer
    writer.kill()
    writer.join()
    values, stamp = dut.read()
    assert values[0] >= 1
    assert (values == values[0]).all()
    assert stamp <= time.monotonic()
    # Another writer goes on.
    dut.write(np.zeros(SIZE))
    np.testing.assert_array_equal(dut.read()[0], np.zeros(SIZE))


def test_a_reader_without_a_copy_keeps_the_last():
    dut = SharedVector(2)
    dut.write(np.array([1.0, 2.0]))
    before = dut.read()
    # As if a writer were always in the middle of both.
    dut._slots[:, -1] = 3.0
    values, stamp = dut.read()
    np.testing.assert_array_equal(values, [1.0, 2.0])
    assert stamp == before[1]
