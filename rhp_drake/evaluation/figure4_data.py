"""The numbers of Figure 4, and the table they are kept in.

`figure4.csv` has a row a training:

| column | what |
| --- | --- |
| `plans` | how many plans were imitated |
| `seed` | of the training |
| `success` | share of the tasks that the greedy policy solves |
| `t_low`, `t_high` | 95 % interval of the mean of the batches' shares, Student's t |
| `wilson_low`, `wilson_high` | Wilson's 95 % interval of the share of all tasks |
| `batch_size` | tasks of a batch |
| `batch_1` ... `batch_25` | of these so many were solved |
"""

from collections.abc import Sequence
import csv
from dataclasses import dataclass
import io
from pathlib import Path
from typing import Final

import numpy as np

from rhp_drake.evaluation.statistics import t_interval, wilson_interval
from rhp_drake.files import write_atomically

# Section VII-B.
NUM_BATCHES: Final = 25


@dataclass(frozen=True)
class Point:
    """One training.

    Attributes:
        num_plans: P, how many plans it imitates.
        seed: Of the first weights and of the batches.
    """

    num_plans: int
    seed: int


@dataclass(frozen=True)
class PointResult:
    """What came of a training.

    Attributes:
        point: Which one.
        successes: Tasks that the greedy policy solves, of each batch.
        batch_size: Tasks of a batch.
    """

    point: Point
    successes: tuple[int, ...]
    batch_size: int

    @property
    def rates(self) -> np.ndarray:
        """The share of each batch that was solved."""
        return np.array(self.successes) / self.batch_size


def batch_successes(succeeded: Sequence[bool]) -> tuple[int, ...]:
    """How many tasks of each batch were solved, of all tasks in their order.

    Args:
        succeeded: Of each task whether; as many as make whole batches.
    """
    sums = np.reshape(succeeded, (NUM_BATCHES, -1)).sum(axis=1)
    return tuple(int(number) for number in sums)


@dataclass(frozen=True)
class CurvePoint:
    """All trainings on the same number of plans.

    Attributes:
        num_plans: P.
        seed_rates: Success of each, in the order of the seeds.
        success: Their mean.
        low: Lower end of its 95 % interval, `t_interval` over the batches.  A batch
            counts with its mean over the seeds: its tasks are the same under each.
        high: Upper end.
    """

    num_plans: int
    seed_rates: tuple[float, ...]
    success: float
    low: float
    high: float


def curve(results: Sequence[PointResult]) -> list[CurvePoint]:
    """The curve of the figure, fewest plans first."""
    points = []
    for num_plans in sorted({result.point.num_plans for result in results}):
        same = sorted(
            (result for result in results if result.point.num_plans == num_plans),
            key=lambda result: result.point.seed,
        )
        rates = np.array([result.rates for result in same])
        low, high = t_interval(rates.mean(axis=0))
        seed_rates = tuple(float(rate) for rate in rates.mean(axis=1))
        points.append(CurvePoint(num_plans, seed_rates, float(rates.mean()), low, high))
    return points


def write_results(path: Path, results: Sequence[PointResult]) -> None:
    """Writes the table described above, rows by plans and seed."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    batches = [f"batch_{number + 1}" for number in range(NUM_BATCHES)]
    intervals = ["t_low", "t_high", "wilson_low", "wilson_high"]
    writer.writerow(["plans", "seed", "success", *intervals, "batch_size", *batches])
    for result in sorted(results, key=lambda r: (r.point.num_plans, r.point.seed)):
        total, trials = sum(result.successes), NUM_BATCHES * result.batch_size
        ends = [*t_interval(result.rates), *wilson_interval(total, trials)]
        writer.writerow(
            [
                result.point.num_plans,
                result.point.seed,
                f"{total / trials:.4f}",
                *(f"{end:.4f}" for end in ends),
                result.batch_size,
                *result.successes,
            ]
        )
    write_atomically(path, text.getvalue())


def read_results(path: Path) -> list[PointResult]:
    """Reads what `write_results` wrote."""
    with path.open(newline="") as file:
        return [
            PointResult(
                Point(int(row["plans"]), int(row["seed"])),
                tuple(int(row[f"batch_{k + 1}"]) for k in range(NUM_BATCHES)),
                int(row["batch_size"]),
            )
            for row in csv.DictReader(file)
        ]
