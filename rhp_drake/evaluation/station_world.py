"""The station as a world: the robot, its servo and contact in three dimensions.

It is the loop of `rhp run`, but that the hand is sent from outside.
"""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from rhp_drake.closed_loop import AddRobot
from rhp_drake.evaluation.world import WorldError
from rhp_drake.physics import ObjectPhysics
from rhp_drake.safety import Fault, describe
from rhp_drake.scenario import Scenario
from rhp_drake.station.simulated_station import SetStationState
from rhp_drake.systems.receding_horizon_planner import (
    PATIENCE,
    PLANNER_PERIOD,
    has_arrived,
)
from rhp_drake.task import TaskInstance, hand_targets, objects_fallen


def MakeStationSimulator() -> Simulator:
    """A simulator of the default station, whose hand goes where it is sent.

    Its diagram has the input `hand_target` and the outputs `state`, `at_rest` and
    `fault`, see `closed_loop.Robot`.  One serves any number of worlds in turn.
    """
    builder = DiagramBuilder()
    robot = AddRobot(builder, Scenario())
    builder.ExportInput(robot.hand_target, "hand_target")
    for name in ("state", "at_rest", "fault"):
        builder.ExportOutput(getattr(robot, name), name)
    return Simulator(builder.Build())


class StationWorld:
    """A `World` in a station; it owns the simulator from its reset to its last step.

    Args:
        simulator: From `MakeStationSimulator`.
        instance: Where it begins.
        physics: Of the objects.
    """

    def __init__(
        self, simulator: Simulator, instance: TaskInstance, physics: ObjectPhysics
    ) -> None:
        self._simulator = simulator
        self._diagram = simulator.get_system()
        self._instance = instance
        self._physics = physics

    @property
    def state(self) -> np.ndarray:
        """See `World`."""
        return self._output("state").copy()

    @property
    def simulated_seconds(self) -> float:
        """See `World`."""
        return self._simulator.get_context().get_time()

    def reset(self) -> None:
        """See `World`."""
        context = self._simulator.get_mutable_context()
        context.SetTime(0.0)
        self._diagram.SetDefaultContext(context)
        station = self._diagram.GetSubsystemByName("station")
        SetStationState(
            station,
            station.GetMyMutableContextFromRoot(context),
            self._instance.initial_state,
            self._physics,
        )
        self._send_hand(self._instance.initial_state[:3])
        self._simulator.Initialize()
        self._wait(self._instance.initial_state[:3])

    def step(self, action: int) -> None:
        """See `World`."""
        target = hand_targets(self.state, np.array(action))
        self._send_hand(target)
        self._wait(target)

    def _send_hand(self, target: np.ndarray) -> None:
        port = self._diagram.GetInputPort("hand_target")
        port.FixValue(self._simulator.get_mutable_context(), target)

    def _wait(self, target: np.ndarray) -> None:
        """Until the hand is at its target and all is at rest, or an object has fallen.

        Raises:
            WorldError: If that takes too long, or the arm was stopped.
        """
        end = self.simulated_seconds + PATIENCE
        while self.simulated_seconds < end:
            # Between two calls Python handles Ctrl-C, so Drake need not look for it.
            self._simulator.AdvanceTo(
                self.simulated_seconds + PLANNER_PERIOD, interruptible=False
            )
            fault = Fault(int(self._output("fault")[0]))
            if fault != Fault.NONE:
                raise WorldError(f"the arm was stopped: {describe(fault)}")
            state = self._output("state")
            if objects_fallen(state):
                return
            if has_arrived(state[:3], target) and self._output("at_rest")[0]:
                return
        raise WorldError(f"the action is not done after {PATIENCE:g} s.")

    def _output(self, name: str) -> np.ndarray:
        return self._diagram.GetOutputPort(name).Eval(self._simulator.get_context())
