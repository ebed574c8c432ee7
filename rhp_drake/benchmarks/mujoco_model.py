"""The push model's scene in MuJoCo, for comparison."""

import math
from typing import Final

import mujoco
import numpy as np

from rhp_drake.benchmarks.comparator import GYRATION_RADIUS, Comparator
from rhp_drake.physics import NOMINAL_FRICTION
from rhp_drake.task import BOX_SIDE, HAND_RECTANGLES

# Tuned as `Box2DModel`; see `rhp bench push-model`.
_STEPS_PER_PIECE: Final = 1
_SETTLING_STEPS: Final = 2
_ITERATIONS: Final = 20
# s: the time step; any will do where velocities are forgotten.
_TIME_STEP: Final = 1.0
# Of an overlap, resolved in each step.
_RELAXATION: Final = 0.8
# Constraints as hard as MuJoCo has them.
_IMPEDANCE: Final = 0.99
_HAND_MASS: Final = 1e4  # Of a box's; no push changes its velocity.


class MuJoCoModel(Comparator):
    """Boxes that a heavy hand pushes, in one model of MuJoCo.

    The hand is heavy rather than a mocap body, which would have no velocity in
    contact: friction would hold boxes where they are instead of taking them along.

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
        self._model = mujoco.MjModel.from_xml_string(_scene(num_objects))
        self._data = mujoco.MjData(self._model)

    def _push(
        self, state: np.ndarray, step_motion: np.ndarray, num_steps: int
    ) -> np.ndarray:
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = state
        velocities = np.zeros(len(state))
        velocities[:3] = step_motion / _TIME_STEP
        self._advance(velocities, num_steps)
        self._advance(0 * velocities, self._settling_steps)
        return self._data.qpos[3:].copy()

    def _advance(self, velocities: np.ndarray, num_steps: int) -> None:
        for _ in range(num_steps):
            self._data.qvel[:] = velocities
            mujoco.mj_step(self._model, self._data)


def _scene(num_objects: int) -> str:
    """The scene as MJCF; positions are ordered as a task state."""
    hand = "".join(
        f'<geom pos="{x} {y} 0" size="{half_x} {half_y} 0.05" mass="0"/>'
        for x, y, half_x, half_y in HAND_RECTANGLES
    )
    half = BOX_SIDE / 2
    box = f'<geom size="{half} {half} 0.03" mass="0"/>'
    bodies = _body(hand, _HAND_MASS) + num_objects * _body(box, 1.0)
    # Stiffness and damping that end a step with the velocity of touching bodies
    # cancelled, and part of their overlap resolved.
    stiffness, damping = _RELAXATION / _TIME_STEP**2, 1 / _TIME_STEP
    return f"""
<mujoco>
  <compiler angle="radian" boundmass="0" autolimits="false"/>
  <option timestep="{_TIME_STEP}" gravity="0 0 0" cone="elliptic"
    solver="PGS" iterations="{_ITERATIONS}"/>
  <default>
    <geom type="box" condim="3" friction="{NOMINAL_FRICTION} 0 0"
      solref="{-stiffness} {-damping}"
      solimp="{_IMPEDANCE} {_IMPEDANCE} 0.001 0.5 1"/>
  </default>
  <worldbody>{bodies}</worldbody>
</mujoco>
"""


def _body(geoms: str, mass: float) -> str:
    """A body on a planar joint, of such mass and the limit surface's inertia."""
    inertia = mass * GYRATION_RADIUS**2
    return f"""
    <body>
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <joint type="hinge" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{mass}"
        diaginertia="{inertia} {inertia} {inertia}"/>
      {geoms}
    </body>"""
