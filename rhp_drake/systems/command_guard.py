"""The last check before the robot: only safe joint commands pass."""

from dataclasses import dataclass
import math
from typing import Final

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from rhp_drake.errors import InputError
from rhp_drake.safety import Fault, JointLimits, check_command, to_fault
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS
from rhp_drake.station.ur5_kinematics import (
    NOMINAL,
    PUSHING_HEIGHT,
    Ur5Kinematics,
)
from rhp_drake.systems.latching import latch_position
from rhp_drake.task import (
    TABLE_LOWER,
    TABLE_UPPER,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
)

# The hand's z axis may lean by so much: its fingers reach 0.1 m around it.
_LEAST_UPRIGHT: Final = math.cos(math.radians(2))
# An object's: far more than a tracker errs by.  What looks ahead knows none that lie.
_LEAST_STANDING: Final = math.cos(math.radians(15))
# m from tick to tick.  A pushed object goes 1 mm; two that a tracker takes for each
# other are at least a box's side apart, 6 cm.
_LONGEST_JUMP: Final = 0.03


@dataclass
class CommandGuardConfig(JointLimits):
    """The limits of `CommandGuard`, beside those of the joints.

    Attributes:
        workspace_margin: How far a command may take the hand out of its workspace, m.
        height_tolerance: How far above or below its pushing height, m.
        object_age_limit: How long an object may not have been seen, s.
        arm_age_limit: How long the arm may not have been heard of, s.
    """

    workspace_margin: float = 0.02
    height_tolerance: float = 0.004
    object_age_limit: float = 0.08
    arm_age_limit: float = 0.05

    def validate(self, where: str = "guard.") -> None:
        """Raises an InputError if a limit is impossible, or no limit at all."""
        super().validate(where)
        for name, largest in (
            ("workspace_margin", 0.1),
            ("height_tolerance", PUSHING_HEIGHT),
            ("object_age_limit", 5.0),
            ("arm_age_limit", 5.0),
        ):
            value = getattr(self, name)
            if not 0 < value <= largest:
                raise InputError(
                    f"{where}{name} is {value}; it must be positive, and at most "
                    f"{largest:g}."
                )


class CommandGuard(LeafSystem):
    """Passes joint commands on as long as they are safe.

    At each tick the desired position becomes the command, unless it breaks a limit of
    the configuration, a measurement is too old or not finite, an object is tipped or
    elsewhere at once, or the robot has a fault of its own.  Then the last command is
    held, and the fault stays until the simulator is initialized again.  The command
    starts as the measured position, so that a first desired position far away is
    refused, too.

    Initialization raises a RuntimeError if the measured position is not finite: there
    is nothing safe to command.  Before initialization the command is nan.

    .. pydrake_system::

        name: CommandGuard
        input_ports:
        - position
        - position_measured
        - arm_age
        - arm_fault
        - object_poses
        - object_ages
        output_ports:
        - position
        - fault

    The positions have size 6 (rad), the ages (s) size 1 and m; `arm_fault` and `fault`
    have size 1, a value of `safety.Fault`; an `arm_fault` that is none counts as
    `NOT_RUNNING`.  `object_poses` is a list of the m poses X_WB, z of B upwards.

    Args:
        config: The limits.
        num_objects: m, the target included.
        kinematics: The arm's.
    """

    def __init__(
        self,
        config: CommandGuardConfig,
        num_objects: int,
        kinematics: Ur5Kinematics = NOMINAL,
    ) -> None:
        super().__init__()
        config.validate()
        self._config = config
        self._kinematics = kinematics
        self._desired_port = self.DeclareVectorInputPort(
            name="position", size=NUM_JOINTS
        )
        self._measured_port = self.DeclareVectorInputPort(
            name="position_measured", size=NUM_JOINTS
        )
        self._arm_age_port = self.DeclareVectorInputPort(name="arm_age", size=1)
        self._arm_fault_port = self.DeclareVectorInputPort(name="arm_fault", size=1)
        self._object_poses_port = self.DeclareAbstractInputPort(
            name="object_poses", model_value=AbstractValue.Make([RigidTransform()])
        )
        self._object_ages_port = self.DeclareVectorInputPort(
            name="object_ages", size=num_objects
        )
        position = self.DeclareDiscreteState(np.full(NUM_JOINTS, np.nan))
        fault = self.DeclareDiscreteState(np.array([float(Fault.NONE)]))
        # Where the objects were at the last tick: (x, y) of each, m in W.
        objects = self.DeclareDiscreteState(np.full(2 * num_objects, np.nan))
        self.DeclareStateOutputPort(name="position", state_index=position)
        self.DeclareStateOutputPort(name="fault", state_index=fault)
        self._position, self._fault = int(position), int(fault)
        self._objects = int(objects)
        self.DeclareInitializationDiscreteUpdateEvent(update=self._Initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec=COMMAND_PERIOD, offset_sec=0.0, update=self._Update
        )

    def _Initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        measured = latch_position(self._measured_port, context)
        discrete_state.set_value(self._position, measured)
        discrete_state.set_value(self._fault, np.array([float(Fault.NONE)]))
        discrete_state.set_value(self._objects, self._EvalObjects(context).ravel())

    def _EvalObjects(self, context: Context) -> np.ndarray:
        """Where the objects are, shape (m, 2), m in W."""
        poses = self._object_poses_port.Eval(context)
        return np.array([X_WB.translation()[:2] for X_WB in poses])

    def _Update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if context.get_discrete_state(self._fault).value()[0] != Fault.NONE:
            return
        desired = self._desired_port.Eval(context)
        fault = self._CheckArm(context)
        if fault == Fault.NONE:
            fault = self._CheckObjects(context)
        if fault == Fault.NONE:
            fault = check_command(
                self._config,
                COMMAND_PERIOD,
                desired,
                accepted=context.get_discrete_state(self._position).value(),
                measured=self._measured_port.Eval(context),
            )
        if fault == Fault.NONE:
            fault = self._CheckHand(desired)
        if fault == Fault.NONE:
            discrete_state.set_value(self._position, desired)
            discrete_state.set_value(self._objects, self._EvalObjects(context).ravel())
        else:
            discrete_state.set_value(self._fault, np.array([float(fault)]))

    def _CheckArm(self, context: Context) -> Fault:
        """Finds what is wrong with the robot."""
        arm_fault = to_fault(self._arm_fault_port.Eval(context)[0])
        if arm_fault != Fault.NONE:
            return arm_fault
        # Written so that nan is too old, too.
        if not self._arm_age_port.Eval(context)[0] <= self._config.arm_age_limit:
            return Fault.STALE_MEASUREMENT
        return Fault.NONE

    def _CheckObjects(self, context: Context) -> Fault:
        """Finds what is wrong with what is known of the scene."""
        # Written so that nan is too old, too.
        ages = self._object_ages_port.Eval(context)
        if not (ages <= self._config.object_age_limit).all():
            return Fault.STALE_POSE
        poses = np.array(
            [X_WB.GetAsMatrix34() for X_WB in self._object_poses_port.Eval(context)]
        )
        # What is nan would be neither on the table nor tipped.
        if not np.isfinite(poses).all():
            return Fault.NOT_FINITE
        positions, upright = poses[:, :2, 3], poses[:, 2, 2]
        before = context.get_discrete_state(self._objects).value().reshape(-1, 2)
        jumps = np.linalg.norm(positions - before, axis=1)
        # Beyond the table's edge it falls, which is for the planner to see.
        inside = (positions >= TABLE_LOWER) & (positions <= TABLE_UPPER)
        on_table = inside.all(axis=1)
        if (on_table & (jumps > _LONGEST_JUMP)).any():
            return Fault.OBJECT_JUMPED
        if (on_table & (upright < _LEAST_STANDING)).any():
            return Fault.OBJECT_TILTED
        return Fault.NONE

    def _CheckHand(self, desired: np.ndarray) -> Fault:
        """Whether a command, shape (6,), has the hand upright where it may be."""
        X_WH = self._kinematics.forward_kinematics(desired)
        inside = hand_is_inside(self._config, X_WH)
        return Fault.NONE if inside else Fault.HAND_OUTSIDE


def hand_is_inside(
    config: CommandGuardConfig, X_WH: np.ndarray, rounding: float = 0.0
) -> bool:
    """Whether a pose of the hand, shape (4, 4), is upright where the hand may be.

    Args:
        config: The limits.
        X_WH: The pose, m.
        rounding: How much further out it may be, m.
    """
    margin = config.workspace_margin + rounding
    return bool(
        (X_WH[:2, 3] >= WORKSPACE_LOWER - margin).all()
        and (X_WH[:2, 3] <= WORKSPACE_UPPER + margin).all()
        and abs(X_WH[2, 3] - PUSHING_HEIGHT) <= config.height_tolerance + rounding
        and X_WH[2, 2] >= _LEAST_UPRIGHT - rounding
    )
