"""Policies side by side on the same task instances."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeAlias

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import Episode, PushWorld, run_episode
from rhp_drake.evaluation.statistics import format_rate
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.physics import UNCERTAINTY_LEVELS, ObjectPhysics, draw_physics
from rhp_drake.planning.policy_config import MakePolicy, PolicyConfig
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.task import TaskInstance
from rhp_drake.workers import run_over

PLANAR: Final = "planar"
STATION: Final = "station"
WORLDS: Final = (PLANAR, STATION)

# Table I of the paper: success in % after imitation alone, by policy and uncertainty.
PAPER_SUCCESS: Final = {
    "kdp": {"none": 98.0, "low": 24.5, "medium": 28.5, "high": 15.7},
    "gp": {"none": 48.0, "low": 48.2, "medium": 42.2, "high": 44.7},
    "rhp33": {"none": 78.0, "low": 77.2, "medium": 73.4, "high": 71.5},
    "rhp66": {"none": 88.0, "low": 86.2, "medium": 85.8, "high": 82.8},
}


@dataclass(frozen=True)
class Trial:
    """One policy on one instance.

    Attributes:
        policy: Its name in the table.
        level: How much the world's physics differ from what the policy believes.
        index: Of the instance in its set.
    """

    policy: str
    level: str
    index: int


@dataclass(frozen=True)
class Comparison:
    """What to compare.

    Attributes:
        policies: By their names in the table.
        levels: Of the physics' uncertainty, any of `UNCERTAINTY_LEVELS`.
        instances: Name of a set of instances.
        num_objects: Of each instance.
        num_instances: The first so many of the set.
        world: "planar", the push model, or "station", the whole robot.
        seed: Of the policies' random draws, and of the physics.
    """

    policies: dict[str, PolicyConfig]
    levels: Sequence[str]
    instances: str
    num_objects: int
    num_instances: int
    world: str
    seed: int

    def __post_init__(self) -> None:
        if self.world not in WORLDS:
            raise InputError(f"{self.world!r} is not a world: {', '.join(WORLDS)}.")
        for level in self.levels:
            if level not in UNCERTAINTY_LEVELS:
                known = ", ".join(UNCERTAINTY_LEVELS)
                raise InputError(f"{level!r} is not a level of uncertainty: {known}.")
        if self.num_objects != NUM_OBJECTS and self.world == STATION:
            raise InputError(
                f"the station has {NUM_OBJECTS} objects, not {self.num_objects}."
            )
        available = len(load_instances(self.instances, self.num_objects))
        if not 1 <= self.num_instances <= available:
            raise InputError(
                f"{self.num_instances} instances were asked for; the {self.instances} "
                f"set has {available}."
            )

    def trials(self) -> list[Trial]:
        """All of them, the policies in turn, and of each the levels."""
        return [
            Trial(policy, level, index)
            for policy in self.policies
            for level in self.levels
            for index in range(self.num_instances)
        ]


# Runs an instance, under a seed and with its index in the set, in some physics.
_Runner: TypeAlias = Callable[[TaskInstance, int, int, ObjectPhysics], Episode]
# What a process keeps from trial to trial, by world, number of objects and policy: they
# are dear to make.
_runners: dict[str, _Runner] = {}


def _make_runner(config: PolicyConfig, world: str, num_objects: int) -> _Runner:
    policy = MakePolicy(config, num_objects)
    if world == STATION:
        from rhp_drake.evaluation.station_world import StationWorld

        return StationWorld(policy).run_episode
    push_model = PushModel(num_objects)

    def run(
        instance: TaskInstance, seed: int, index: int, physics: ObjectPhysics
    ) -> Episode:
        executed = PushWorld(push_model, physics)
        return run_episode(executed, policy, instance, seed, index)

    return run


def _run_trial(trial: Trial, comparison: Comparison) -> Episode:
    config, world = comparison.policies[trial.policy], comparison.world
    instance = load_instances(comparison.instances, comparison.num_objects)[trial.index]
    key = f"{world} {instance.num_objects} {config!r}"
    if key not in _runners:
        _runners[key] = _make_runner(config, world, instance.num_objects)
    physics = draw_physics(
        trial.level,
        instance.initial_state,
        # The same draws at each level, more or less spread.
        stream(comparison.seed, trial.index, "world_physics"),
    )
    return _runners[key](instance, comparison.seed, trial.index, physics)


def run_comparison(
    comparison: Comparison, num_workers: int
) -> Iterator[tuple[Trial, Episode]]:
    """Runs all trials; the episodes are the same whatever the number of workers."""
    return run_over(
        partial(_run_trial, comparison=comparison), comparison.trials(), num_workers
    )


_Results: TypeAlias = Sequence[tuple[Trial, Episode]]


def make_table(results: _Results, title: str, num_objects: int = NUM_OBJECTS) -> Table:
    """A table of success and cost, a row a policy and level.

    Beside the success stands what the paper's imitation columns say of the policy, if
    there are as many objects.
    Actions and computation are means over the runs that succeeded; the last number,
    where time flows, is simulated time over the world's own computation.
    """
    paper = PAPER_SUCCESS if num_objects == NUM_OBJECTS else {}
    time_flows = any(episode.simulated_seconds for _, episode in results)
    headings = [
        "success %\n(95 % Wilson)",
        "paper\n%",
        "\nactions",
        "ms a decision\np50 / p95",
        "thinks\ns a run",
        *(["x real\ntime"] if time_flows else []),
    ]

    def cells(policy: str, level: str, episodes: Sequence[Episode]) -> list[str]:
        successes = [episode for episode in episodes if episode.succeeded]
        seconds = [s for episode in episodes for s in episode.decision_seconds]
        # A policy that fails at once has made no decision.
        p50, p95 = 1e3 * np.percentile(seconds or [np.nan], [50, 95])
        row = [
            format_rate(len(successes), len(episodes)),
            str(paper.get(policy, {}).get(level, "")),
            f"{_mean([e.num_actions for e in successes]):.1f}",
            f"{_format_ms(p50)} / {_format_ms(p95)}",
            f"{_mean([sum(e.decision_seconds) for e in successes]):.2f}",
        ]
        if time_flows:
            simulated = sum(e.simulated_seconds for e in episodes)
            row.append(f"{simulated / sum(e.world_seconds for e in episodes):.1f}")
        return row

    return _table_by_policy(results, title, headings, cells)


def make_failure_table(results: _Results) -> Table:
    """How often the runs failed by each cause, a row a policy and level."""
    causes = dict.fromkeys(e.outcome for _, e in results if not e.succeeded)

    def cells(policy: str, level: str, episodes: Sequence[Episode]) -> list[str]:
        outcomes = [episode.outcome for episode in episodes]
        return [str(outcomes.count(cause) or "") for cause in causes]

    # A line a word: the station has many causes.
    headings = [cause.replace(" ", "\n") for cause in causes]
    return _table_by_policy(results, "Failures", headings, cells)


def make_ending_table(results: _Results, count: int) -> Table:
    """The first so many failures one by one."""
    failures = [(t, e) for t, e in results if not e.succeeded]
    title = "Failures one by one"
    if len(failures) > count:
        title = f"The first {count} failures of {len(failures)}"
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    for heading in ("policy", "level", "task", "cause", "ending"):
        table.add_column(heading)
    for trial, episode in failures[:count]:
        table.add_row(
            trial.policy,
            trial.level,
            str(trial.index),
            episode.outcome,
            episode.ending,
        )
    return table


def _table_by_policy(
    results: _Results,
    title: str,
    headings: Sequence[str],
    cells: Callable[[str, str, Sequence[Episode]], list[str]],
) -> Table:
    """A table of what `cells` says of each policy's and level's episodes.

    Levels have a column if there are several.
    """
    # Without frames, it fits into 80 columns.
    table = Table(
        title=title,
        box=SIMPLE_HEAD,
        padding=0,
        show_edge=False,
    )
    several = len({trial.level for trial, _ in results}) > 1
    for heading in ("policy", "level") if several else ("policy",):
        table.add_column(heading, no_wrap=True, vertical="bottom")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    rows: dict[str, dict[str, list[Episode]]] = {}
    for trial, episode in results:
        rows.setdefault(trial.policy, {}).setdefault(trial.level, []).append(episode)
    for policy, by_level in rows.items():
        name = policy
        for level, episodes in by_level.items():
            labels = (name, level) if several else (name,)
            table.add_row(*labels, *cells(policy, level, episodes))
            # Once is enough.
            name = ""
    return table


def _format_ms(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}"


def _mean(values: Sequence[float]) -> float:
    """The mean, nan of nothing."""
    return float(np.mean(values)) if values else float("nan")
