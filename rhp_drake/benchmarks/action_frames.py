"""Plans with translations along the hand's axes, and along the world's."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Final

from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.task import HAND_ACTIONS, WORLD_ACTIONS
from rhp_drake.workers import run_over

ACTION_SETS: Final = {"hand": HAND_ACTIONS, "world": WORLD_ACTIONS}
# A search that simulated so many actions is given up.
_MAX_TRANSITIONS: Final = 6000


@dataclass(frozen=True)
class PlanningTrial:
    """A validation task, to be planned with one of `ACTION_SETS`."""

    frame: str
    index: int


@dataclass(frozen=True)
class PlanningResult:
    """What came of it.

    Attributes:
        solved: Whether a plan was found.
        num_actions: Of the plan; 0 without one.
        num_transitions: Actions simulated.
    """

    solved: bool
    num_actions: int
    num_transitions: int


@lru_cache(maxsize=1)
def _push_model() -> PushModel:
    return PushModel(NUM_OBJECTS)


def _run(trial: PlanningTrial, seed: int) -> PlanningResult:
    instance = load_instances(VALIDATION)[trial.index]
    found = plan(
        _push_model(),
        instance.initial_state,
        instance.goals,
        stream(seed, VALIDATION, trial.index, "action_frames"),
        max_transitions=_MAX_TRANSITIONS,
        improvement=0,
        action_set=ACTION_SETS[trial.frame],
    )
    num_actions = 0 if found.actions is None else len(found.actions)
    return PlanningResult(
        found.actions is not None, num_actions, len(found.search.actions)
    )


def compare_action_frames(
    num_instances: int, seed: int, num_workers: int
) -> Iterator[tuple[PlanningTrial, PlanningResult]]:
    """Plans for the first validation tasks with each set of actions."""
    trials = [
        PlanningTrial(frame, index)
        for frame in ACTION_SETS
        for index in range(num_instances)
    ]
    return run_over(partial(_run, seed=seed), trials, num_workers)
