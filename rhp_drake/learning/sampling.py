"""Batches of transitions, with goals of their tasks or in hindsight.

A transition of the push model is true whatever the goals are.  So every action that a
search ever simulated teaches the value of any task in which its state may occur.  The
goals of a sample are those of its task, or, in hindsight (Andrychowicz et al. 2017),
places where things went some actions later in the same search; the search then shows
that the goal can be reached in so many actions, a lower bound of the value (He et al.
2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from rhp_drake.learning.dataset import Dataset
from rhp_drake.task import (
    GOAL_RADIUS,
    REWARD,
    goals_reached,
    object_positions,
    objects_fallen,
)

# Hindsight looks at most this many actions ahead.
_FORESIGHT: Final = 20
# m: a target that moved less teaches nothing about pushing it.
_LEAST_MOTION: Final = 0.01


@dataclass(frozen=True)
class Samples:
    """N transitions with the goals they are looked at for.

    Attributes:
        states: Shape (N, 3 + 3 m).
        actions: Shape (N,).
        next_states: Shape (N, 3 + 3 m).
        goals: Shape (N, m, 2).
        least_returns: What the return is known to reach at least, shape (N,).
        later_states: Where a simulated way goes on to, shape (N, 3 + 3 m).
        later_steps: After how many actions, shape (N,).
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    goals: np.ndarray
    least_returns: np.ndarray
    later_states: np.ndarray
    later_steps: np.ndarray


def sample(
    sources: Sequence[Dataset],
    num_samples: int,
    generator: np.random.Generator,
    *,
    hindsight: float = 0.0,
    foresight: int = 1,
) -> Samples:
    """Draws N transitions and their goals, as many from each source.

    Args:
        sources: What was simulated.
        num_samples: N.
        generator: Draws them.
        hindsight: How many of the samples get goals in hindsight, 0 to 1.
    """
    shares = np.diff(np.arange(len(sources) + 1) * num_samples // len(sources))
    parts = [
        _sample(source, int(share), generator, hindsight, foresight)
        for source, share in zip(sources, shares, strict=True)
    ]
    return Samples(
        **{
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Samples)
        }
    )


def _sample(
    data: Dataset,
    num_samples: int,
    generator: np.random.Generator,
    hindsight: float,
    foresight: int,
) -> Samples:
    rows = generator.integers(len(data.search_actions), size=num_samples)
    # The first of them in hindsight.
    changed = slice(int(hindsight * num_samples))
    ends = rows[changed].copy()
    rows[changed], num_actions = _go_back(data, ends, generator)
    goals = data.goals[data.search_tasks[rows]]
    least = np.full(num_samples, -np.inf)
    found, useful = _goals_in_hindsight(
        data.search_states[rows[changed]],
        data.search_next_states[ends],
        goals[changed],
        generator,
    )
    goals[changed][useful] = found[useful]
    least[changed][useful] = REWARD * num_actions[useful]
    later, later_steps = _go_on(data, rows, goals, foresight)
    return Samples(
        data.search_states[rows],
        data.search_actions[rows],
        data.search_next_states[rows],
        goals,
        least,
        data.search_next_states[later],
        later_steps,
    )


def _go_on(
    data: Dataset, rows: np.ndarray, goals: np.ndarray, foresight: int
) -> tuple[np.ndarray, np.ndarray]:
    """Follows a simulated way on, until the goal or up to so many actions in all."""
    later = rows.copy()
    num_actions = np.ones(len(rows), dtype=int)
    for _ in range(foresight - 1):
        states = data.search_next_states[later]
        following = data.followers[later]
        on = (
            (following >= 0) & ~goals_reached(states, goals) & ~objects_fallen(states)
        )
        later[on] = following[on]
        num_actions[on] += 1
    return later, num_actions


def _go_back(
    data: Dataset, ends: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Follows searches back from the transitions `ends`, each a random way.

    Returns:
        Transitions that led there, and how many actions they and those after them are
        up to the end; of the shape of `ends`.
    """
    rows = ends.copy()
    num_actions = np.ones(len(ends), dtype=int)
    wanted = generator.integers(1, _FORESIGHT + 1, size=len(ends))
    for _ in range(_FORESIGHT - 1):
        origins = data.search_origins[rows]
        back = (num_actions < wanted) & (origins >= 0)
        rows[back] = origins[back]
        num_actions[back] += 1
    return rows, num_actions


def _goals_in_hindsight(
    states: np.ndarray,
    ends: np.ndarray,
    goals: np.ndarray,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Goals that the states' futures met.

    Args:
        states: Shape (N, 3 + 3 m).
        ends: What became of them, shape (N, 3 + 3 m).
        goals: Of their tasks, shape (N, m, 2).
        generator: Draws where in its region each object ended.

    Returns:
        Goals (N, m, 2), and whether they teach anything, shape (N,).
    """
    start, end = object_positions(states), object_positions(ends)
    found = _in_disc(end, generator)
    # An obstacle still in its task's region needs no other one.
    kept = np.linalg.norm(end - goals, axis=-1) <= GOAL_RADIUS
    kept[:, 0] = False
    moved = np.linalg.norm(end[:, 0] - start[:, 0], axis=1) > _LEAST_MOTION
    useful = moved & ~objects_fallen(ends)
    return np.where(kept[..., None], goals, found), useful


def _in_disc(centres: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Points uniform in the discs of radius `GOAL_RADIUS` around (..., 2) centres."""
    shape = centres.shape[:-1]
    radius = GOAL_RADIUS * np.sqrt(generator.random(shape))
    angle = 2 * np.pi * generator.random(shape)
    return centres + np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
