"""The last check before the robot: only safe joint commands pass."""

from dataclasses import dataclass, field
import enum
import math

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from rhp_drake.errors import InputError
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS
from rhp_drake.systems.latching import latch_position


class Fault(enum.IntEnum):
    """Why a command was refused."""

    NONE = 0
    NOT_FINITE = 1
    POSITION_LIMIT = 2
    VELOCITY_LIMIT = 3
    TRACKING_ERROR = 4


@dataclass
class CommandGuardConfig:
    """The limits of `CommandGuard`.

    Attributes:
        position_limits: Largest angle of each joint, either way, rad.
        velocity_limit: Largest change of any joint's command, rad/s.  The arm itself
            stops at pi rad/s.
        tracking_limit: Largest distance of any measured joint from its command, rad.
    """

    # The elbow turns half as far as the others.
    position_limits: list[float] = field(
        default_factory=lambda: [math.tau, math.tau, math.pi, *[math.tau] * 3]
    )
    velocity_limit: float = 1.5
    tracking_limit: float = 0.2


class CommandGuard(LeafSystem):
    """Passes joint commands on as long as they are safe.

    At each tick the desired position becomes the command, unless it breaks a limit
    of the configuration.  Then the last command is held, and the fault stays until
    the simulator is initialized again.  The command starts as the measured position,
    so that a first desired position far away is refused, too.

    Initialization raises a RuntimeError if the measured position is not finite: there
    is nothing safe to command.  Before initialization the command is nan.

    .. pydrake_system::

        name: CommandGuard
        input_ports:
        - position
        - position_measured
        output_ports:
        - position
        - fault

    The positions have size 6 (rad); `fault` has size 1, a value of `Fault`.
    """

    def __init__(self, config: CommandGuardConfig) -> None:
        super().__init__()
        limits = [*config.position_limits, config.velocity_limit, config.tracking_limit]
        # Written so that nan is refused, too.
        if len(config.position_limits) != NUM_JOINTS or not all(x > 0 for x in limits):
            raise InputError(
                f"the command guard needs {NUM_JOINTS} position limits, and all "
                f"limits positive; it got {config}."
            )
        self._position_limits = np.array(config.position_limits)
        self._step_limit = config.velocity_limit * COMMAND_PERIOD
        self._tracking_limit = config.tracking_limit

        self._desired_port = self.DeclareVectorInputPort(
            name="position", size=NUM_JOINTS
        )
        self._measured_port = self.DeclareVectorInputPort(
            name="position_measured", size=NUM_JOINTS
        )
        position = self.DeclareDiscreteState(np.full(NUM_JOINTS, np.nan))
        fault = self.DeclareDiscreteState(np.array([float(Fault.NONE)]))
        self.DeclareStateOutputPort(name="position", state_index=position)
        self.DeclareStateOutputPort(name="fault", state_index=fault)
        self._position, self._fault = int(position), int(fault)
        self.DeclareInitializationDiscreteUpdateEvent(update=self._Initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec=COMMAND_PERIOD, offset_sec=0.0, update=self._Update
        )

    def _Initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        measured = latch_position(self._measured_port, context)
        discrete_state.set_value(self._position, measured)
        discrete_state.set_value(self._fault, np.array([float(Fault.NONE)]))

    def _Update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if context.get_discrete_state(self._fault).value()[0] != Fault.NONE:
            return
        desired = self._desired_port.Eval(context)
        fault = self._Check(
            desired=desired,
            measured=self._measured_port.Eval(context),
            accepted=context.get_discrete_state(self._position).value(),
        )
        if fault == Fault.NONE:
            discrete_state.set_value(self._position, desired)
        else:
            discrete_state.set_value(self._fault, np.array([float(fault)]))

    def _Check(
        self, desired: np.ndarray, measured: np.ndarray, accepted: np.ndarray
    ) -> Fault:
        """Finds what is wrong; `accepted` is the command before, all of shape (6,)."""
        if not (np.isfinite(desired).all() and np.isfinite(measured).all()):
            return Fault.NOT_FINITE
        if (np.abs(desired) > self._position_limits).any():
            return Fault.POSITION_LIMIT
        if (np.abs(desired - accepted) > self._step_limit).any():
            return Fault.VELOCITY_LIMIT
        # What was commanded before is what the arm can have reached by now.
        if (np.abs(accepted - measured) > self._tracking_limit).any():
            return Fault.TRACKING_ERROR
        return Fault.NONE
