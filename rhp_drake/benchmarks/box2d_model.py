"""The push model's scene in Box2D, for comparison."""

import math
from typing import Final

import Box2D
import numpy as np

from rhp_drake.benchmarks.comparator import GYRATION_RADIUS, Comparator
from rhp_drake.physics import NOMINAL_FRICTION
from rhp_drake.task import BOX_SIDE, HAND_RECTANGLES

# Box2D's lengths are metres, of which it neglects 5 mm; ours are so many times larger.
_SCALE: Final = 100.0
# s: the time step; any will do where velocities are forgotten.
_TIME_STEP: Final = 1.0
# At the given number of pieces of a path; see `rhp bench push-model`.
_STEPS_PER_PIECE: Final = 1
_SETTLING_STEPS: Final = 2
_VELOCITY_ITERATIONS: Final = 8
_POSITION_ITERATIONS: Final = 3
# 1/s: forgets the velocity of the step before.
_DAMPING: Final = 1e9


class Box2DModel(Comparator):
    """Boxes that a kinematic hand pushes, in one world of Box2D.

    Pushes are independent but for the order in which contacts are solved, which the
    world's tree of bounding boxes remembers.  A world for each push would have the same
    results in any order, and take over twice the time.

    Args:
        num_objects: m.
        refinement: How many times more steps than usual; a reference needs more.
    """

    def __init__(self, num_objects: int, refinement: float = 1) -> None:
        super().__init__(
            num_objects,
            _STEPS_PER_PIECE * refinement,
            math.ceil(_SETTLING_STEPS * refinement),
        )
        self._world = Box2D.b2World(gravity=(0, 0), continuousPhysics=False)
        # Shapes have a skin, outside of which contact is kept but for the slop.
        skin = Box2D.b2_polygonRadius - Box2D.b2_linearSlop / 2
        self._hand = self._world.CreateKinematicBody(allowSleep=False)
        for x, y, half_x, half_y in HAND_RECTANGLES * _SCALE:
            self._hand.CreatePolygonFixture(
                box=(half_x - skin, half_y - skin, (x, y), 0.0),
                friction=NOMINAL_FRICTION,
            )
        half = BOX_SIDE / 2 * _SCALE - skin
        self._boxes = []
        for _ in range(num_objects):
            box = self._world.CreateDynamicBody(
                linearDamping=_DAMPING, angularDamping=_DAMPING, allowSleep=False
            )
            box.CreatePolygonFixture(
                box=(half, half), density=1.0, friction=NOMINAL_FRICTION
            )
            box.massData = Box2D.b2MassData(
                mass=1.0, center=(0, 0), I=(GYRATION_RADIUS * _SCALE) ** 2
            )
            self._boxes.append(box)

    def _push(
        self, state: np.ndarray, step_motion: np.ndarray, num_steps: int
    ) -> np.ndarray:
        bodies = [self._hand, *self._boxes]
        for body in bodies:
            # Forgets the contacts and impulses of the push before.
            body.active = False
        for body, (x, y, theta) in zip(
            bodies, state.reshape(-1, 3).tolist(), strict=True
        ):
            body.transform = ((x * _SCALE, y * _SCALE), theta)
        for body in bodies:
            body.active = True
        x, y, theta = step_motion.tolist()
        self._hand.linearVelocity = (x * _SCALE / _TIME_STEP, y * _SCALE / _TIME_STEP)
        self._hand.angularVelocity = theta / _TIME_STEP
        self._advance(num_steps)
        self._hand.linearVelocity = (0.0, 0.0)
        self._hand.angularVelocity = 0.0
        self._advance(self._settling_steps)
        poses = [
            (box.position[0] / _SCALE, box.position[1] / _SCALE, box.angle)
            for box in self._boxes
        ]
        return np.array(poses).ravel()

    def _advance(self, num_steps: int) -> None:
        for _ in range(num_steps):
            self._world.Step(_TIME_STEP, _VELOCITY_ITERATIONS, _POSITION_ITERATIONS)
