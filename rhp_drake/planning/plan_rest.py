"""What is left of a plan while a policy executes it."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhp_drake.planning.policy import Decision
from rhp_drake.task import allowed_actions, object_positions

# m: from the hand's origin to a fingertip, which a wrong heading takes astray.
_FINGERTIP: Final = 0.08


@dataclass(frozen=True)
class PlanRest:
    """What is left of a plan: the memory of policies that execute one.

    Attributes:
        actions: Shape (L,).
        states: Where the plan expects to be before each action and at the end, shape
            (L + 1, 3 + 3 m).
    """

    actions: np.ndarray
    states: np.ndarray

    def decision(self) -> Decision:
        """The next action, of L > 0; the plan's rest is its one roll-out."""
        value = -float(len(self.actions))
        rest = PlanRest(self.actions[1:], self.states[1:])
        return Decision(
            int(self.actions[0]), value, self.states[None], np.array([value]), rest
        )

    def holds(self, state: np.ndarray, tolerance: float) -> bool:
        """Whether the next action can be executed from the state, as planned.

        Args:
            state: Shape (3 + 3 m,).
            tolerance: The `deviation` up to which the state is as expected, m.
        """
        return bool(
            len(self.actions)
            and deviation(state, self.states[0]) <= tolerance
            and allowed_actions(state, self.actions[:1]).all()
        )


def deviation(state: np.ndarray, expected: np.ndarray) -> float:
    """How far the body that is farthest off is from where it is expected, m.

    An object counts by its position; how it is turned matters little to where it is
    pushed.  The hand counts by its position or, by how far its heading takes a
    fingertip astray.

    Args:
        state: Shape (3 + 3 m,).
        expected: Shape (3 + 3 m,).
    """
    objects = np.linalg.norm(
        object_positions(state) - object_positions(expected), axis=-1
    )
    hand = np.linalg.norm(state[:2] - expected[:2])
    heading = _FINGERTIP * abs(state[2] - expected[2])
    return float(max(hand, heading, objects.max()))
