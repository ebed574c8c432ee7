"""What was simulated in search of a plan, as data to learn from."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Search:
    """T simulated actions: what a planner looked at, be it good or bad.

    Attributes:
        states: Shape (T, 3 + 3 m).
        actions: Shape (T,).
        next_states: Shape (T, 3 + 3 m).
        origins: For each, which one led to its state; -1 at a root.  Shape (T,).
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    origins: np.ndarray


class SearchRecord:
    """Collects what is simulated."""

    def __init__(self, state_size: int) -> None:
        self._states = [np.empty((0, state_size))]
        self._actions = [np.empty(0, int)]
        self._next_states = [np.empty((0, state_size))]
        self._origins = [np.empty(0, int)]
        self.num_transitions = 0

    def add(
        self,
        state: np.ndarray,
        actions: np.ndarray,
        children: np.ndarray,
        origin: int,
    ) -> np.ndarray:
        """Adds the children (A, 3 + 3 m) that actions (A,) led to from one state.

        Returns:
            The transitions' indices, shape (A,).
        """
        self._states.append(np.repeat(state[None], len(actions), axis=0))
        self._actions.append(actions)
        self._next_states.append(children)
        self._origins.append(np.full(len(actions), origin))
        first = self.num_transitions
        self.num_transitions += len(actions)
        return np.arange(first, self.num_transitions)

    def search(self) -> Search:
        """All of them, in order."""
        return Search(
            np.concatenate(self._states),
            np.concatenate(self._actions),
            np.concatenate(self._next_states),
            np.concatenate(self._origins),
        )
