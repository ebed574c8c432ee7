"""Batches of transitions of what was simulated.

A transition of the push model is true whatever was meant by it.  So every action that
a search or a roll-out ever simulated teaches the value of its task's goals.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from rhp_drake.learning.dataset import Dataset


@dataclass(frozen=True)
class Samples:
    """N transitions and the goals of their tasks.

    Attributes:
        states: Shape (N, 3 + 3 m).
        actions: Shape (N,).
        next_states: Shape (N, 3 + 3 m).
        goals: Shape (N, m, 2).
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    goals: np.ndarray


def sample(
    sources: Sequence[Dataset], num_samples: int, generator: np.random.Generator
) -> Samples:
    """Draws N transitions, as many from each source.

    Args:
        sources: What was simulated.
        num_samples: N.
        generator: Draws them.
    """
    shares = np.diff(np.arange(len(sources) + 1) * num_samples // len(sources))
    parts = [
        _sample(source, int(share), generator)
        for source, share in zip(sources, shares, strict=True)
    ]
    return Samples(
        **{
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Samples)
        }
    )


def _sample(data: Dataset, num_samples: int, generator: np.random.Generator) -> Samples:
    rows = generator.integers(len(data.search_actions), size=num_samples)
    return Samples(
        data.search_states[rows],
        data.search_actions[rows],
        data.search_next_states[rows],
        data.goals[data.search_tasks[rows]],
    )
