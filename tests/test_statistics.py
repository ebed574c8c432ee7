"""Statistics of tables, against published and hand-made values."""

import numpy as np
import pytest

from rhp_drake.evaluation.machine import describe_machine
from rhp_drake.evaluation.statistics import (
    bootstrap_interval,
    format_grouped_rate,
    format_rate,
    t_interval,
    wilson_interval,
)
from rhp_drake.random_streams import stream


# Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in
# Medicine 17 (1998), table I, method 3.
@pytest.mark.parametrize(
    ("successes", "trials", "interval"),
    [
        (81, 263, (0.2553, 0.3662)),
        (15, 148, (0.0624, 0.1605)),
        (0, 20, (0.0000, 0.1611)),
        (1, 29, (0.0061, 0.1718)),
    ],
)
def test_wilson_interval_as_published(successes, trials, interval):
    assert wilson_interval(successes, trials) == pytest.approx(interval, abs=5e-5)


def test_rate_of_nothing_can_be_anything():
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_format_rate():
    assert format_rate(81, 263) == "30.8 (25.5-36.6)"


def test_trials_of_the_same_tasks_say_less():
    """Where all trials of a task go alike, more of them say nothing new."""
    once = np.arange(20) < 15
    alike = np.array([once, once, once])
    assert format_grouped_rate(alike) == format_rate(15, 20)
    # Where they do not, they count as so many of different tasks.
    apart = np.array([np.roll(once, 5 * k) for k in range(4)])
    assert format_grouped_rate(apart) == format_rate(60, 80)


def test_t_interval_by_hand():
    # Mean 2, standard error 1 / sqrt(3), quantile 4.303 for two degrees of freedom.
    assert t_interval([1, 2, 3]) == pytest.approx((-0.484, 4.484), abs=1e-3)
    assert t_interval([0.5, 0.5]) == (0.5, 0.5)


def test_bootstrap_of_independent_values_is_that_of_normal_theory():
    values = stream(0, "test").normal(5.0, 2.0, size=400)
    low, high = bootstrap_interval([np.array([v]) for v in values], stream(1))
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_bootstrap_draws_whole_groups():
    """Ten copies of a value say no more than one."""
    values = stream(0, "test").normal(size=50)
    once = bootstrap_interval([np.array([v]) for v in values], stream(1))
    often = bootstrap_interval([np.full(10, v) for v in values], stream(1))
    assert often == pytest.approx(once)


def test_machine_in_one_line():
    line = describe_machine(3)
    assert "\n" not in line
    for part in ("cores", "3 worker(s)", "Python 3.", "drake 1."):
        assert part in line
