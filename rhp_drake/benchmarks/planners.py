"""Planners side by side: on the same instances, in the same push model."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Final

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.planning.best_first import plan_best_first
from rhp_drake.planning.kinodynamic_rrt import IMPROVEMENT, plan
from rhp_drake.planning.policy_config import DEFAULT_Q_NETWORK
from rhp_drake.planning.receding_horizon import ValueFunction
from rhp_drake.planning.search import Plan, leads_to_goal
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.resources import resolve
from rhp_drake.task import TaskInstance
from rhp_drake.value.weights import load_q_network
from rhp_drake.workers import run_over


@dataclass(frozen=True)
class Found:
    """What a planner says.

    Attributes:
        actions: The plan, shape (L,); None if there is none.
        num_transitions: Actions simulated.
        seconds: Time of the whole search.
        first_seconds: When the first plan was found, s after the search began; nan
            without one.
    """

    actions: np.ndarray | None
    num_transitions: int
    seconds: float
    first_seconds: float


def _rrt(
    push_model: PushModel,
    task: TaskInstance,
    generator: np.random.Generator,
    time_limit: float,
    *,
    improvement: int,
) -> Found:
    found = plan(
        push_model,
        task.initial_state,
        task.goals,
        generator,
        improvement=improvement,
        time_limit=time_limit,
    )
    return _found(found)


@lru_cache(maxsize=1)
def _q_network() -> ValueFunction:
    return load_q_network(resolve(DEFAULT_Q_NETWORK), NUM_OBJECTS)


def _best_first(
    push_model: PushModel,
    task: TaskInstance,
    generator: np.random.Generator,
    time_limit: float,
) -> Found:
    found = plan_best_first(
        push_model,
        _q_network(),
        task.initial_state,
        task.goals,
        max_transitions=1_000_000,
        time_limit=time_limit,
    )
    return _found(found)


def _found(found: Plan) -> Found:
    return Found(
        found.actions, len(found.search.actions), found.seconds, found.first_seconds
    )


def _ompl(
    push_model: PushModel,
    task: TaskInstance,
    generator: np.random.Generator,
    time_limit: float,
    *,
    name: str,
) -> Found:
    from rhp_drake.benchmarks.ompl_planners import plan_with_ompl

    return plan_with_ompl(name, push_model, task, generator, time_limit=time_limit)


Planner = Callable[[PushModel, TaskInstance, np.random.Generator, float], Found]

# By name: the planner, which gets a limit of computation in seconds.  "rrt_first" stops
# at its first plan; "best_first" is guided by the package's own Q-network.
PLANNERS: Final[dict[str, Planner]] = {
    "rrt": partial(_rrt, improvement=IMPROVEMENT),
    "rrt_first": partial(_rrt, improvement=0),
    "best_first": _best_first,
    "ompl_rrt": partial(_ompl, name="rrt"),
    "ompl_sst": partial(_ompl, name="sst"),
}


@dataclass(frozen=True)
class PlannerTrial:
    """One of `PLANNERS` on one instance.

    Attributes:
        planner: Its name.
        instances: Name of the set of instances.
        index: Of the instance in its set.
    """

    planner: str
    instances: str
    index: int


@dataclass(frozen=True)
class PlannerResult:
    """What came of it.

    Attributes:
        solved: Whether a plan was found in time, and the last one leads to the goal
            when replayed.
        seconds: Time of the whole search.
        first_seconds: When the first plan was found, s; nan without one.
        num_transitions: Actions simulated.
        num_actions: Of the plan; 0 without one.
    """

    solved: bool
    seconds: float
    first_seconds: float
    num_transitions: int
    num_actions: int


def check_planners(names: Sequence[str]) -> None:
    """Whether there are such planners.

    Raises:
        InputError: If not, or if OMPL is needed and not installed.
    """
    for name in names:
        if name not in PLANNERS:
            raise InputError(
                f"--planners: {name!r} is not one of {', '.join(PLANNERS)}."
            )
        if name.startswith("ompl_") and not find_spec("ompl"):
            raise InputError(
                f"--planners: {name} needs OMPL: "
                'pip install -c constraints.txt -e ".[bench]".'
            )


def compare_planners(
    names: Sequence[str],
    instances: str,
    count: int,
    time_limit: float,
    seed: int,
    num_workers: int,
) -> Iterator[tuple[PlannerTrial, PlannerResult]]:
    """Plans for the first `count` instances of a set with each of `PLANNERS`.

    Args:
        names: Of the planners.
        instances: Name of the set.
        count: Instances.
        time_limit: Limit of computation for each search, s.
        seed: Of the searches.
        num_workers: Processes.
    """
    # What else the machine does in these minutes meets all planners alike.
    trials = [
        PlannerTrial(name, instances, index) for index in range(count) for name in names
    ]
    return run_over(
        partial(_run, time_limit=time_limit, seed=seed), trials, num_workers
    )


@lru_cache(maxsize=1)
def _push_model() -> PushModel:
    return PushModel(NUM_OBJECTS)


def _run(trial: PlannerTrial, time_limit: float, seed: int) -> PlannerResult:
    task = load_instances(trial.instances)[trial.index]
    generator = stream(seed, trial.instances, trial.index, "planners", trial.planner)
    found = PLANNERS[trial.planner](_push_model(), task, generator, time_limit)
    solved = (
        found.actions is not None
        # A search that goes on for a shorter plan may end just after the limit.
        and found.first_seconds <= time_limit
        and leads_to_goal(_push_model(), task, found.actions)
    )
    num_actions = 0 if found.actions is None else len(found.actions)
    return PlannerResult(
        solved, found.seconds, found.first_seconds, found.num_transitions, num_actions
    )
