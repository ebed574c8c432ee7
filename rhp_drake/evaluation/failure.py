"""What can be said of a run that failed, from the states it came through."""

from collections.abc import Sequence

import numpy as np

from rhp_drake.planning.search import near_any
from rhp_drake.task import GOAL_RADIUS, object_positions


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
