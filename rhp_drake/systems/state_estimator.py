"""From what the station measures to the planar state of the task."""

from typing import Final

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS
from rhp_drake.station.ur5_kinematics import NOMINAL, Ur5Kinematics

REST_WINDOW: Final = 0.1  # s
# What may move within the window.  Twice the noise of a motion-capture system, and
# far less than what a decision depends on.
REST_DISTANCE: Final = 0.0005  # m
REST_ANGLE: Final = 0.005  # rad
REST_JOINT_SPEED: Final = 0.02  # rad/s


class StateEstimator(LeafSystem):
    """Turns joint positions and object poses into the task's state.

    The hand's pose comes from the joints, so its heading counts turns; an object's
    yaw is the direction of its x axis as seen from above.

    The scene is at rest once the joints have been slow and neither hand nor objects
    have moved noticeably for `REST_WINDOW`.  The window starts anew at
    initialization.  A state that is not finite is not at rest.

    Evaluating `state` raises a ValueError if the number of poses is not that of the
    objects.

    .. pydrake_system::

        name: StateEstimator
        input_ports:
        - position_measured
        - velocity_estimated
        - object_poses
        output_ports:
        - state
        - at_rest

    `position_measured` (rad) and `velocity_estimated` (rad/s) have size 6;
    `object_poses` is a list of the m poses X_WB, in the task's order.  `state` has
    size 3 + 3 m, see `rhp_drake.task`; `at_rest` has size 1 and is 0 or 1.

    Args:
        num_objects: m, the target included.
        kinematics: The arm's.
    """

    def __init__(self, num_objects: int, kinematics: Ur5Kinematics = NOMINAL) -> None:
        super().__init__()
        self._kinematics = kinematics
        self._num_objects = num_objects
        size = 3 + 3 * num_objects
        self._position_port = self.DeclareVectorInputPort(
            name="position_measured", size=NUM_JOINTS
        )
        self._velocity_port = self.DeclareVectorInputPort(
            name="velocity_estimated", size=NUM_JOINTS
        )
        self._poses_port = self.DeclareAbstractInputPort(
            name="object_poses", model_value=AbstractValue.Make([RigidTransform()])
        )
        # The state that the scene has stayed close to, and since when it has.
        self._reference = int(self.DeclareDiscreteState(np.full(size, np.nan)))
        self._reference_time = int(self.DeclareDiscreteState(1))
        at_rest = self.DeclareDiscreteState(1)
        self._at_rest = int(at_rest)
        self._state_port = self.DeclareVectorOutputPort(
            name="state",
            size=size,
            calc=self._CalcState,
            prerequisites_of_calc={
                self._position_port.ticket(),
                self._poses_port.ticket(),
            },
        )
        self.DeclareStateOutputPort(name="at_rest", state_index=at_rest)
        self.DeclareInitializationDiscreteUpdateEvent(update=self._Initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec=COMMAND_PERIOD, offset_sec=0.0, update=self._UpdateAtRest
        )

    def _CalcState(self, context: Context, output: BasicVector) -> None:
        poses = self._poses_port.Eval(context)
        if len(poses) != self._num_objects:
            raise ValueError(
                f"object_poses has {len(poses)} poses, not {self._num_objects}."
            )
        position = self._position_port.Eval(context)
        finite = np.isfinite(position).all()
        nowhere = np.full(3, np.nan)
        parts = [self._kinematics.hand_pose(position) if finite else nowhere]
        for X_WB in poses:
            R_WB = X_WB.rotation().matrix()
            yaw = np.arctan2(R_WB[1, 0], R_WB[0, 0])
            parts.append(np.array([*X_WB.translation()[:2], yaw]))
        output.SetFromVector(np.concatenate(parts))

    def _Initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        self._SetReference(context, discrete_state)

    def _SetReference(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._reference, self._state_port.Eval(context))
        discrete_state.set_value(self._reference_time, np.array([context.get_time()]))
        discrete_state.set_value(self._at_rest, np.zeros(1))

    def _UpdateAtRest(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._state_port.Eval(context)
        reference = context.get_discrete_state(self._reference).value()
        moved = (state - reference).reshape(-1, 3)
        angles = np.remainder(moved[:, 2] + np.pi, 2 * np.pi) - np.pi
        # Comparisons that nan fails.
        still = (
            (np.abs(moved[:, :2]) <= REST_DISTANCE).all()
            and (np.abs(angles) <= REST_ANGLE).all()
            and (np.abs(self._velocity_port.Eval(context)) <= REST_JOINT_SPEED).all()
        )
        if not still:
            self._SetReference(context, discrete_state)
            return
        since = context.get_discrete_state(self._reference_time).value()[0]
        # Half a period keeps rounding of times from costing a tick.
        rested = context.get_time() - since >= REST_WINDOW - COMMAND_PERIOD / 2
        discrete_state.set_value(self._at_rest, np.array([float(rested)]))
