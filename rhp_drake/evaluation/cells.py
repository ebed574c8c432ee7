"""What the episodes of one policy at one level of uncertainty add up to."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.experiment import BATCH_SIZE, Column, Trial
from rhp_drake.evaluation.paper_results import (
    SHIPPED_WEIGHTS,
    TABLE1,
    PaperCell,
)
from rhp_drake.evaluation.statistics import (
    grouped_wilson_interval,
    mcnemar,
    t_interval,
)


@dataclass(frozen=True)
class Cell:
    """All episodes of a policy at a level.

    Attributes:
        results: Trials and their episodes.
    """

    results: Sequence[tuple[Trial, Episode]]

    @property
    def trials(self) -> int:
        """How many."""
        return len(self.results)

    @cached_property
    def successes(self) -> int:
        """How many succeeded."""
        return sum(episode.succeeded for _, episode in self.results)

    @property
    def percent(self) -> float:
        """Success, %."""
        return 100 * self.successes / self.trials

    @cached_property
    def _by_instance(self) -> dict[int, list[bool]]:
        """Which trials on each instance succeeded."""
        instances: dict[int, list[bool]] = {}
        for trial, episode in self.results:
            instances.setdefault(trial.index, []).append(episode.succeeded)
        return instances

    @cached_property
    def wilson(self) -> tuple[float, float]:
        """Wilson's 95 % interval, %; trials on the same instance go alike."""
        of_instances = self._by_instance.values()
        low, high = grouped_wilson_interval(
            np.array([sum(succeeded) for succeeded in of_instances]),
            np.array([len(succeeded) for succeeded in of_instances]),
        )
        return 100 * low, 100 * high

    @property
    def rate(self) -> str:
        """Success with Wilson's interval, for people."""
        low, high = self.wilson
        return f"{self.percent:.1f} ({low:.1f}-{high:.1f})"

    @cached_property
    def plus_minus(self) -> float:
        """Half of the 95 % interval of the mean of batches of 20 instances, %.

        As in Figure 4 of the paper.  Student's t is for batches that vary alike: only
        whole ones count.  nan of fewer than two.
        """
        batches: dict[int, list[list[bool]]] = {}
        for index, succeeded in self._by_instance.items():
            batches.setdefault(index // BATCH_SIZE, []).append(succeeded)
        rates = [
            _mean([one for succeeded in batch for one in succeeded])
            for batch in batches.values()
            if len(batch) == BATCH_SIZE
        ]
        if len(rates) < 2:
            return float("nan")
        low, high = t_interval(rates)
        return 50 * (high - low)

    @cached_property
    def seconds(self) -> float:
        """Mean computation of a run that succeeded, policy and world; nan of none."""
        return _mean([e.seconds for _, e in self.results if e.succeeded])

    @cached_property
    def num_actions(self) -> float:
        """Mean number of actions of a run that succeeded; nan of none."""
        return _mean([e.num_actions for _, e in self.results if e.succeeded])

    @cached_property
    def thinking_seconds(self) -> float:
        """Mean computation of the policy in a run that succeeded; nan of none."""
        return _mean([sum(e.decision_seconds) for _, e in self.results if e.succeeded])

    @cached_property
    def mean_decision_milliseconds(self) -> float:
        """Of the computation of all decisions; nan of none."""
        return 1e3 * _mean([s for _, e in self.results for s in e.decision_seconds])

    def decision_milliseconds(self, percentile: float) -> float:
        """Of the computation of all decisions; nan of none."""
        # A policy that fails at once has made no decision.
        seconds = [s for _, e in self.results for s in e.decision_seconds]
        return 1e3 * float(np.percentile(seconds or [np.nan], percentile))

    @property
    def real_time_rate(self) -> float | None:
        """Simulated time over the world's own computation; None where no time flows."""
        simulated = sum(e.simulated_seconds for _, e in self.results)
        computed = sum(e.world_seconds for _, e in self.results)
        return simulated / computed if simulated else None

    @cached_property
    def causes(self) -> Counter[str]:
        """How often the failures had each cause."""
        return Counter(e.outcome for _, e in self.results if not e.succeeded)


Cells: TypeAlias = dict[Column, dict[str, Cell]]


def group(results: Sequence[tuple[Trial, Episode]]) -> Cells:
    """Cells by column and level, in the order in which the results have them."""
    rows: dict[Column, dict[str, list[tuple[Trial, Episode]]]] = {}
    for trial, episode in results:
        by_level = rows.setdefault(trial.column, {})
        by_level.setdefault(trial.level, []).append((trial, episode))
    return {
        column: {level: Cell(of_level) for level, of_level in by_level.items()}
        for column, by_level in rows.items()
    }


def paper_cell(column: Column, level: str) -> PaperCell | None:
    """What Table I of the paper says of a policy, None if it has no such one."""
    key = column.policy, SHIPPED_WEIGHTS.get(column.weights, column.weights)
    return TABLE1.get(key, {}).get(level)


def compare(first: Cell, second: Cell) -> tuple[int, int, float] | None:
    """McNemar's exact test of two policies, in the trials that both cells have.

    An instance counts once, for whoever succeeded in more of its trials: they go alike,
    and ten of them are not ten times the evidence.

    Returns:
        See `statistics.mcnemar`; None if there are no such trials.
    """
    theirs = {(t.index, t.number): e.succeeded for t, e in second.results}
    leads: Counter[int] = Counter()
    for trial, episode in first.results:
        if (key := (trial.index, trial.number)) in theirs:
            leads[trial.index] += episode.succeeded - theirs[key]
    if not leads:
        return None
    values = np.array([*leads.values()])
    return mcnemar(values > 0, values < 0)


def failure_causes(cells: Mapping[Column, Mapping[str, Cell]]) -> list[str]:
    """All causes of failures, the most frequent first."""
    total: Counter[str] = Counter()
    for by_level in cells.values():
        for cell in by_level.values():
            total += cell.causes
    return [cause for cause, _ in total.most_common()]


def _mean(values: Sequence[float]) -> float:
    """The mean, nan of nothing."""
    return float(np.mean(values)) if values else float("nan")
