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
    IMITATION,
    REINFORCEMENT,
    TABLE1,
    PaperCell,
)
from rhp_drake.evaluation.statistics import (
    format_rate,
    mcnemar,
    t_interval,
    wilson_interval,
)

# How the Q-networks that come with the package learned.
_LEARNED = {
    "": "",
    "imitation": IMITATION,
    "imitation_set": IMITATION,
    "paper": REINFORCEMENT,
    "best": REINFORCEMENT,
}


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

    @property
    def wilson(self) -> tuple[float, float]:
        """Wilson's 95 % interval, %."""
        low, high = wilson_interval(self.successes, self.trials)
        return 100 * low, 100 * high

    @property
    def rate(self) -> str:
        """Success with Wilson's interval, for people."""
        return format_rate(self.successes, self.trials)

    @cached_property
    def plus_minus(self) -> float:
        """Half of the 95 % interval of the mean of batches of 20 instances, %.

        As in Figure 4 of the paper; nan of fewer than two batches.
        """
        batches: dict[int, list[bool]] = {}
        for trial, episode in self.results:
            batches.setdefault(trial.index // BATCH_SIZE, []).append(episode.succeeded)
        if len(batches) < 2:
            return float("nan")
        low, high = t_interval([_mean(batch) for batch in batches.values()])
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
    key = column.policy, _LEARNED.get(column.weights, "unknown")
    return TABLE1.get(key, {}).get(level)


def compare(first: Cell, second: Cell) -> tuple[int, int, float] | None:
    """`statistics.mcnemar` over the trials of both cells; None if there are none."""
    successes = [
        {(t.index, t.number): e.succeeded for t, e in cell.results}
        for cell in (first, second)
    ]
    common = sorted(successes[0].keys() & successes[1].keys())
    if not common:
        return None
    ours, theirs = (np.array([of[key] for key in common]) for of in successes)
    return mcnemar(ours, theirs)


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
