"""What can be said of a run that failed, from the states it came through."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhp_drake.planning.search import near_any
from rhp_drake.task import GOAL_RADIUS, object_positions

OBSTACLE_MOVED: Final = "obstacle moved"


def cause_of_failure(ended: str, state: np.ndarray, goals: np.ndarray) -> str:
    """Why a run failed that ended without the goal.

    Args:
        ended: What ended it, such as "out of actions".
        state: The last one, shape (3 + 3 m,).
        goals: Shape (m, 2).

    Returns:
        The same, or `OBSTACLE_MOVED` if the target is home all the same.
    """
    offsets = np.linalg.norm(object_positions(state) - goals, axis=-1)
    return OBSTACLE_MOVED if offsets[0] <= GOAL_RADIUS < offsets.max() else ended


def describe_ending(states: Sequence[np.ndarray], goals: np.ndarray) -> str:
    """How far from the goal a run ended, and how much of it went round in circles.

    Args:
        states: Those it came through, each of shape (3 + 3 m,), the last one last.
        goals: Shape (m, 2).

    Returns:
        For example "target 3.1 cm outside, 12 of 41 states seen before".
    """
    offsets = np.linalg.norm(object_positions(states[-1]) - goals, axis=-1)
    outside = 100 * (offsets - GOAL_RADIUS)
    parts = [
        f"{'target' if i == 0 else f'obstacle {i}'} {distance:.1f} cm outside"
        for i, distance in enumerate(outside)
        if distance > 0
    ]
    # The same scene with the hand at the same place: nothing was won in between.
    seen = sum(
        near_any(state, np.array(states[:k])) for k, state in enumerate(states) if k
    )
    return ", ".join([*parts, f"{seen} of {len(states)} states seen before"])
