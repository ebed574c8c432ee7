"""Statistics that every table here uses."""

from collections.abc import Sequence
import math

import numpy as np
from scipy.stats import binomtest, norm, t


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate.

    Numbers need not be whole, see `grouped_wilson_interval`.
    """
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    z = float(norm.ppf(0.975))
    shrinkage = 1 / (1 + z**2 / trials)
    center = shrinkage * (rate + z**2 / (2 * trials))
    variance = rate * (1 - rate) / trials + (z / (2 * trials)) ** 2
    half_width = shrinkage * z * math.sqrt(variance)
    # But for rounding, it is around the rate and within 0 and 1 anyway.
    low, high = min(rate, center - half_width), max(rate, center + half_width)
    return max(0.0, low), min(1.0, high)


def grouped_wilson_interval(
    successes: np.ndarray, trials: np.ndarray
) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate whose trials come in groups.

    Trials of the same task go alike, and say less than as many of different tasks.
    They count as so many independent ones as would have the same variance (Korn and
    Graubard 1998): as many as there are groups at least, so also where all succeed, and
    as there are trials at most.  Of one trial a group it is `wilson_interval`.

    Args:
        successes: Of each group, shape (K,), K >= 1.
        trials: Of each group, shape (K,), at least 1 each.
    """
    groups, total = len(trials), float(trials.sum())
    rate = float(successes.sum()) / total
    independent = float(groups)
    if groups > 1 and 0 < rate < 1:
        residuals = successes - rate * trials
        variance = groups / (groups - 1) * float((residuals**2).sum()) / total**2
        # Where all groups have the same rate, nothing says that trials go alike.
        independent = rate * (1 - rate) / variance if variance > 0 else total
        independent = min(max(independent, groups), total)
    return wilson_interval(rate * independent, independent)


def format_grouped_rate(succeeded: np.ndarray) -> str:
    """As `format_rate`, of trials (T, K) on K tasks; see `grouped_wilson_interval`."""
    trials = np.full(succeeded.shape[1], len(succeeded))
    low, high = grouped_wilson_interval(succeeded.sum(axis=0), trials)
    return f"{100 * succeeded.mean():.1f} ({100 * low:.1f}-{100 * high:.1f})"


def format_rate(successes: int, trials: int) -> str:
    """A success rate in percent with its Wilson interval, e.g. ``88.0 (84.9-90.6)``."""
    low, high = wilson_interval(successes, trials)
    return f"{100 * successes / trials:.1f} ({100 * low:.1f}-{100 * high:.1f})"


def t_interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """95 % confidence interval of the mean of at least two values, by Student's t.

    The mean plus and minus the standard error times the 97.5 % quantile of the t
    distribution, of one degree of freedom less than there are values.
    """
    count = len(values)
    standard_error = np.std(values, ddof=1) / np.sqrt(count)
    half_width = t.ppf(0.975, count - 1) * standard_error
    mean = np.mean(values)
    return float(mean - half_width), float(mean + half_width)


def mcnemar(first: np.ndarray, second: np.ndarray) -> tuple[int, int, float]:
    """McNemar's exact test of whether two policies succeed equally often.

    Args:
        first: Whether the first policy succeeded in each trial, booleans (N,).
        second: Whether the second one did in the same trials, booleans (N,).

    Returns:
        In how many trials the first alone succeeded, in how many the second alone, and
        the p-value, two-sided: that of a fair coin's so many heads and tails.
    """
    first_alone = int((first & ~second).sum())
    second_alone = int((second & ~first).sum())
    trials = first_alone + second_alone
    if trials == 0:
        return 0, 0, 1.0
    return first_alone, second_alone, float(binomtest(first_alone, trials).pvalue)


def bonferroni(p: float, num_tests: int) -> float:
    """A p-value that holds for the smallest of so many tests."""
    return min(1.0, p * num_tests)


def bootstrap_interval(
    groups: Sequence[np.ndarray], generator: np.random.Generator
) -> tuple[float, float]:
    """95 % bootstrap confidence interval of the mean of all values.

    Args:
        groups: The values, shape (n_i,), grouped by what they depend on in common;
            whole groups are drawn.
        generator: Where the draws come from.
    """
    sums = np.array([group.sum() for group in groups])
    sizes = np.array([len(group) for group in groups])
    draws = generator.integers(len(groups), size=(10_000, len(groups)))
    means = sums[draws].sum(axis=1) / sizes[draws].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
