"""Statistics that every table here uses, and the machine they were made on."""

from collections.abc import Sequence
from importlib.metadata import version
import platform

import numpy as np
from scipy.stats import binomtest


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate."""
    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def format_rate(successes: int, trials: int) -> str:
    """A success rate in percent with its Wilson interval, e.g. ``88.0 (84.9-90.6)``."""
    low, high = wilson_interval(successes, trials)
    return f"{100 * successes / trials:.1f} ({100 * low:.1f}-{100 * high:.1f})"


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


def describe_machine(num_workers: int = 1) -> str:
    """One line: processor, cores, workers and the versions that matter to speed."""
    model = platform.processor() or platform.machine()
    cores = 0
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            lines = file.readlines()
        models = [x.split(":", 1)[1].strip() for x in lines if "model name" in x]
        model, cores = models[0], len(models)
    except (OSError, IndexError):
        pass  # Not Linux: say what Python knows.
    return (
        f"{model}, {cores or '?'} cores, {num_workers} worker(s), "
        f"Python {platform.python_version()}, drake {version('drake')}, "
        f"torch {version('torch')}"
    )
