"""What other engines' models of the push model's scene have in common.

They are asked the push model's own question: the hand's motion is prescribed, physics
starts just before the first touch, and the table is its limit surface.  Where the push
model's boxes take a hundredth of a second to stop, theirs stop at once: their velocity
is forgotten at every step, so that an impulse gives a box the velocity which the limit
surface gives it for that force, if only its inertia over its mass is the square of the
limit surface's length.  No engine needs to know of damping then, and none is hindered
by integrating it explicitly.
"""

from abc import ABC, abstractmethod
import math
from typing import Final

import numpy as np

from rhp_drake.physics import nominal_physics
from rhp_drake.push_model.diagram import limit_surface_length
from rhp_drake.push_model.touch import STEPS_PER_ACTION, first_touches
from rhp_drake.task import BOX_SIDE, hand_targets

# m: the radius of gyration that does what is said above.
GYRATION_RADIUS: Final = limit_surface_length(BOX_SIDE, BOX_SIDE)


class Comparator(ABC):
    """A model of the push model's scene in another engine, of nominal boxes.

    Args:
        num_objects: m.
        steps_per_piece: Of the engine, for each of the `STEPS_PER_ACTION` pieces of a
            path.
        settling_steps: Of the engine, in which the hand stands at its target.
    """

    def __init__(
        self, num_objects: int, steps_per_piece: float, settling_steps: int
    ) -> None:
        self.num_objects = num_objects
        self._side_lengths = nominal_physics(num_objects).side_lengths
        self._steps_per_piece = steps_per_piece
        self._settling_steps = settling_steps

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The states in which everything rests after the actions.

        Args:
            states: Shape (N, 3 + 3 m).
            actions: Integers of shape (N,).

        Returns:
            The next states, shape (N, 3 + 3 m).
        """
        results = states.copy()
        results[:, :3] = hand_targets(states, actions)
        sides = np.broadcast_to(
            self._side_lengths, (len(states), *self._side_lengths.shape)
        )
        touches = first_touches(states, actions, sides)
        for column in np.flatnonzero(touches < STEPS_PER_ACTION):
            touch = int(touches[column])
            state = states[column].copy()
            state[:3] += (results[column, :3] - state[:3]) * (touch / STEPS_PER_ACTION)
            num_steps = math.ceil((STEPS_PER_ACTION - touch) * self._steps_per_piece)
            step_motion = (results[column, :3] - state[:3]) / num_steps
            results[column, 3:] = self._push(state, step_motion, num_steps)
        return results

    @abstractmethod
    def _push(
        self, state: np.ndarray, step_motion: np.ndarray, num_steps: int
    ) -> np.ndarray:
        """Simulates a push, starting afresh.

        Args:
            state: Where it starts, shape (3 + 3 m,).
            step_motion: Of the hand in each step of the engine, shape (3,).
            num_steps: Of the engine; the settling ones come on top.

        Returns:
            The objects' poses in the end, shape (3 m,).
        """
