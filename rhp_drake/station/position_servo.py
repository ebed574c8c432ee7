"""The command side of the simulated UR5: what its controller does with a position."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS


class PositionServo(LeafSystem):
    """Takes a joint position every `COMMAND_PERIOD` and derives the desired state.

    The desired velocity, the difference quotient of the commands, spares the joints
    the lag behind a moving command.  As long as nothing is connected to the input the
    position of the state stays, and the arm holds it.

    .. pydrake_system::

        name: PositionServo
        input_ports:
        - position (rad, optional)
        output_ports:
        - desired_state (rad, rad/s)
        - position_commanded (rad)
    """

    def __init__(self, default_position: np.ndarray) -> None:
        """Makes the servo hold `default_position`, shape (6,), until commanded."""
        super().__init__()
        self._position = self.DeclareVectorInputPort("position", NUM_JOINTS)
        self._state = self.DeclareDiscreteState(
            np.concatenate([default_position, np.zeros(NUM_JOINTS)])
        )
        self.DeclareStateOutputPort("desired_state", self._state)
        self.DeclareVectorOutputPort(
            "position_commanded",
            NUM_JOINTS,
            self._CalcPositionCommanded,
            {self.discrete_state_ticket(self._state)},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(COMMAND_PERIOD, 0.0, self._Update)

    def Hold(self, context: Context, position: np.ndarray) -> None:
        """Makes `position`, shape (6,), the command so far."""
        context.SetDiscreteState(
            self._state, np.concatenate([position, np.zeros(NUM_JOINTS)])
        )

    def _Update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if not self._position.HasValue(context):
            return
        last = context.get_discrete_state(self._state).value()[:NUM_JOINTS]
        position = self._position.Eval(context)
        velocity = (position - last) / COMMAND_PERIOD
        discrete_state.set_value(self._state, np.concatenate([position, velocity]))

    def _CalcPositionCommanded(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state(self._state).value()
        output.SetFromVector(state[:NUM_JOINTS])
