"""Accuracy and speed of the push model, beside those of other engines.

All times of a table are taken in turns, so that whatever else the machine does weighs
on all of them alike; they are medians of `_REPEATS` turns, with their range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time
from typing import Final

import numpy as np

from rhp_drake.benchmarks.engines import PUSH_MODEL, make_engine
from rhp_drake.benchmarks.pairs import (
    Pairs,
    errors_of_moved,
    sample_contact_pairs,
)
from rhp_drake.evaluation.statistics import bootstrap_interval
from rhp_drake.planning.receding_horizon import TransitionFunction
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream

REFINEMENTS: Final = (0.5, 1, 2, 4)
# Of the reference that an engine's error is measured against.
FINE: Final = 20
NUMBERS_OF_OBJECTS: Final = (1, 3, 5, 10)
BATCH_SIZES: Final = (1, 4, 16, 64, 256, 1024)

_REPEATS: Final = 5
# Pairs for each m, and at least so many in all for each size of a batch.
_PAIRS_OF_GROWTH: Final = 200


@dataclass(frozen=True)
class Spread:
    """Median and range of repeated measurements."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Errors:
    """Errors of moved boxes after one action, m.

    Attributes:
        boxes: How many moved.
        mean: With its 95 % bootstrap interval `low` to `high`.
        median: Of all moved boxes.
        p95: The 95th percentile.
    """

    boxes: int
    mean: float
    low: float
    high: float
    median: float
    p95: float


@dataclass(frozen=True)
class Accuracy:
    """What an engine does with so many steps an action.

    Attributes:
        engine: Its name.
        refinement: How many times more steps than usual; 0.5 are half as many.
        seconds: Of an action, in one thread.
        slowness: `seconds` over those of the push model as it is, turn by turn.
        own: Against the same engine at `FINE`.
        push_model: Against the push model at `FINE`.
    """

    engine: str
    refinement: float
    seconds: Spread
    slowness: Spread
    own: Errors
    push_model: Errors


@dataclass(frozen=True)
class Speed:
    """How many actions a second are done.

    Attributes:
        pairs: What kind.
        num_objects: m.
        batch: How many at once.
        threads: How many.
        actions_per_second: In all threads together.
    """

    pairs: str
    num_objects: int
    batch: int
    threads: int
    actions_per_second: Spread


def measure_accuracy(
    engines: Sequence[str], pairs: Pairs, num_objects: int
) -> list[Accuracy]:
    """Error against cost of the engines, the push model among them.

    Args:
        engines: Names of `engines.available_engines`.
        pairs: Contact-rich ones.
        num_objects: m.
    """
    states, actions = pairs
    fine = {
        engine: make_engine(engine, num_objects, FINE).step(states, actions)
        for engine in engines
    }
    cases = [(engine, k) for engine in engines for k in REFINEMENTS]
    models = [make_engine(engine, num_objects, k) for engine, k in cases]
    results = [model.step(states, actions) for model in models]
    seconds = _in_turns([_stepping(model, pairs) for model in models]) / len(states)
    base = seconds[cases.index((PUSH_MODEL, 1))]
    return [
        Accuracy(
            engine,
            refinement,
            spread_of(seconds[i]),
            spread_of(seconds[i] / base),
            _summarize(states, results[i], fine[engine]),
            _summarize(states, results[i], fine[PUSH_MODEL]),
        )
        for i, (engine, refinement) in enumerate(cases)
    ]


def measure_threads(
    pairs_by_kind: dict[str, Pairs], num_objects: int, threads: Sequence[int]
) -> list[Speed]:
    """Speed of the push model by kind of pairs and number of threads.

    Args:
        pairs_by_kind: What to step, each in one batch.
        num_objects: m.
        threads: Their numbers.
    """
    cases = [(kind, n) for kind in pairs_by_kind for n in threads]
    models = {n: PushModel(num_objects, num_threads=n) for n in threads}
    seconds = _in_turns([_stepping(models[n], pairs_by_kind[k]) for k, n in cases])
    speeds = []
    for (kind, n), of_case in zip(cases, seconds, strict=True):
        count = len(pairs_by_kind[kind][1])
        speeds.append(Speed(kind, num_objects, count, n, spread_of(count / of_case)))
    return speeds


def measure_objects(seed: int) -> list[Speed]:
    """Speed of the push model by the number of objects, in one thread."""
    cases = [
        (m, sample_contact_pairs(_PAIRS_OF_GROWTH, m, seed)) for m in NUMBERS_OF_OBJECTS
    ]
    seconds = _in_turns([_stepping(PushModel(m), pairs) for m, pairs in cases])
    count = _PAIRS_OF_GROWTH
    return [
        Speed("contact", m, count, 1, spread_of(count / of_case))
        for (m, _), of_case in zip(cases, seconds, strict=True)
    ]


def measure_batches(pairs: Pairs, num_objects: int) -> list[Speed]:
    """Speed of the push model by the size of the batch, in one thread.

    Args:
        pairs: Contact-rich ones, repeated as need be.
        num_objects: m.
    """
    states, actions = pairs
    push_model = PushModel(num_objects)

    def step_batches(size: int, count: int) -> Callable[[], None]:
        columns = np.arange(size * count) % len(actions)
        batches = [
            (states[part], actions[part]) for part in columns.reshape(count, size)
        ]

        def step_all() -> None:
            for batch in batches:
                push_model.step(*batch)

        return step_all

    counts = [max(1, _PAIRS_OF_GROWTH // size) for size in BATCH_SIZES]
    seconds = _in_turns(
        [step_batches(*case) for case in zip(BATCH_SIZES, counts, strict=True)]
    )
    return [
        Speed("contact", num_objects, size, 1, spread_of(size * count / of_case))
        for size, count, of_case in zip(BATCH_SIZES, counts, seconds, strict=True)
    ]


def _stepping(engine: TransitionFunction, pairs: Pairs) -> Callable[[], None]:
    def step() -> None:
        engine.step(*pairs)

    return step


def _in_turns(functions: Sequence[Callable[[], None]]) -> np.ndarray:
    """Times of the functions, shape (len(functions), `_REPEATS`), s."""
    seconds = np.empty((len(functions), _REPEATS))
    for function in functions:
        function()  # Builds contexts and fills caches.
    for turn in range(_REPEATS):
        for i, function in enumerate(functions):
            begin = time.perf_counter()
            function()
            seconds[i, turn] = time.perf_counter() - begin
    return seconds


def spread_of(values: np.ndarray) -> Spread:
    """Median and range of the values."""
    return Spread(float(np.median(values)), float(values.min()), float(values.max()))


def _summarize(
    states: np.ndarray, results: np.ndarray, references: np.ndarray
) -> Errors:
    groups = errors_of_moved(states, results, references)
    errors = np.concatenate(groups)
    low, high = bootstrap_interval(groups, stream(0, "bootstrap"))
    return Errors(
        len(errors),
        float(errors.mean()),
        low,
        high,
        float(np.median(errors)),
        float(np.percentile(errors, 95)),
    )
