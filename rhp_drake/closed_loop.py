"""The closed loop: one diagram of station and systems, and how a task runs in it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from rhp_drake import task
from rhp_drake.errors import InputError
from rhp_drake.physics import ObjectPhysics
from rhp_drake.planning.policy import Policy
from rhp_drake.scenario import Scenario
from rhp_drake.station.simulated_station import MakeSimulatedStation, SetStationState
from rhp_drake.systems.command_guard import CommandGuard, Fault
from rhp_drake.systems.hand_servo import HandServo
from rhp_drake.systems.receding_horizon_planner import (
    PLANNER_PERIOD,
    DecisionRecord,
    RecedingHorizonPlanner,
    Status,
)
from rhp_drake.systems.state_estimator import StateEstimator

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

SUCCEEDED: Final = Status.SUCCEEDED.name.lower()


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        status: The planner's `Status`, in lower case, or "guard_fault", "time_limit".
        message: Why it ended, one sentence.
        num_actions: How many actions were executed.
        time: Simulated time, s.
        target_distance: From the target to the centre of its goal region, m.
    """

    status: str
    message: str
    num_actions: int
    time: float
    target_distance: float

    @property
    def succeeded(self) -> bool:
        """Whether all objects ended at their goals."""
        return self.status == SUCCEEDED


def MakeClosedLoop(
    scenario: Scenario, policy: Policy, meshcat: "Meshcat | None" = None
) -> Diagram:
    """Builds the diagram: station -> estimator -> planner -> servo -> guard -> station.

    The diagram knows no task: `run_closed_loop` puts it into the context, so that one
    diagram serves any number of tasks.

    The diagram has these output ports, each named as in the system it comes from:
    `state`, `goals`, `decision`, `status`, `message`, `fault`.

    Args:
        scenario: Says which station.
        policy: Who decides.
        meshcat: Where to show it; None to show nothing, which changes nothing else.

    Raises:
        InputError: If there is no such station.
    """
    m = len(scenario.station.objects)
    builder = DiagramBuilder()
    try:
        station = MakeSimulatedStation(scenario.station, meshcat)
    except (RuntimeError, ValueError, SystemExit) as error:
        # Words of Drake's about models and settings that come from the scenario.  A
        # failed assertion in Drake comes as a SystemExit.
        raise InputError(f"station: {error}") from error
    builder.AddNamedSystem("station", station)
    estimator = builder.AddNamedSystem("state_estimator", StateEstimator(m))
    goals = builder.AddNamedSystem("goals", ConstantVectorSource(np.zeros(2 * m)))
    planner = builder.AddNamedSystem("planner", RecedingHorizonPlanner(policy, m))
    servo = builder.AddNamedSystem("hand_servo", HandServo())
    guard = builder.AddNamedSystem("command_guard", CommandGuard(scenario.guard))

    state = estimator.GetOutputPort("state")
    goal_vector = goals.get_output_port()
    decision = planner.GetOutputPort("decision")
    measured = station.GetOutputPort("ur5.position_measured")

    builder.Connect(measured, estimator.GetInputPort("position_measured"))
    builder.Connect(
        station.GetOutputPort("ur5.velocity_estimated"),
        estimator.GetInputPort("velocity_estimated"),
    )
    builder.Connect(
        station.GetOutputPort("object_poses"), estimator.GetInputPort("object_poses")
    )
    builder.Connect(state, planner.GetInputPort("state"))
    builder.Connect(estimator.GetOutputPort("at_rest"), planner.GetInputPort("at_rest"))
    builder.Connect(goal_vector, planner.GetInputPort("goals"))
    builder.Connect(
        planner.GetOutputPort("hand_target"), servo.GetInputPort("hand_target")
    )
    builder.Connect(measured, servo.GetInputPort("position_measured"))
    builder.Connect(servo.GetOutputPort("position"), guard.GetInputPort("position"))
    builder.Connect(measured, guard.GetInputPort("position_measured"))
    builder.Connect(
        guard.GetOutputPort("position"), station.GetInputPort("ur5.position")
    )

    if meshcat is not None:
        # Imported here because a run without pictures needs none of it.
        from rhp_drake.systems.meshcat_overlay import MeshcatOverlay

        overlay = builder.AddNamedSystem("overlay", MeshcatOverlay(meshcat, m))
        builder.Connect(state, overlay.GetInputPort("state"))
        builder.Connect(goal_vector, overlay.GetInputPort("goals"))
        builder.Connect(decision, overlay.GetInputPort("decision"))

    builder.ExportOutput(state, "state")
    builder.ExportOutput(goal_vector, "goals")
    for name in ("decision", "status", "message"):
        builder.ExportOutput(planner.GetOutputPort(name), name)
    builder.ExportOutput(guard.GetOutputPort("fault"), "fault")
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram


def run_closed_loop(
    simulator: Simulator,
    instance: task.TaskInstance,
    physics: ObjectPhysics,
    *,
    seed: int,
    time_limit: float = np.inf,
    on_decision: Callable[[DecisionRecord], None] = lambda record: None,
) -> Outcome:
    """Runs a task from its start to its end.

    The same arguments give the same run, whatever ran in the simulator before.

    Args:
        simulator: Of a diagram that `MakeClosedLoop` made.
        instance: The task.
        physics: Of the objects in the world.
        seed: Of the policy's random draws.
        time_limit: When to give up, in simulated seconds.
        on_decision: Called soon after each decision.
    """
    diagram, context = simulator.get_system(), simulator.get_mutable_context()
    _reset(simulator, instance, physics, seed)
    simulator.Initialize()
    status = diagram.GetOutputPort("status")
    decision = diagram.GetOutputPort("decision")
    fault = diagram.GetOutputPort("fault")

    num_actions = 0
    ticks = 0
    end, message = "", ""
    while not end:
        ticks += 1
        # Between two calls Python handles Ctrl-C, so Drake need not look for it.
        simulator.AdvanceTo(ticks * PLANNER_PERIOD, interruptible=False)
        record = decision.Eval(context)
        if record.index == num_actions:
            num_actions += 1
            on_decision(record)
        planner_status = Status(int(status.Eval(context)[0]))
        guard_fault = Fault(int(fault.Eval(context)[0]))
        if guard_fault != Fault.NONE:
            end = "guard_fault"
            message = f"the command guard stopped the arm: {guard_fault.name}."
        elif planner_status != Status.RUNNING:
            end = planner_status.name.lower()
            message = diagram.GetOutputPort("message").Eval(context)
        elif context.get_time() >= time_limit:
            end = "time_limit"
            message = f"not done after {time_limit:g} simulated seconds."

    state = diagram.GetOutputPort("state").Eval(context)
    offset = task.object_positions(state)[0] - instance.goals[0]
    return Outcome(
        status=end,
        message=message,
        num_actions=num_actions,
        time=context.get_time(),
        target_distance=float(np.linalg.norm(offset)),
    )


def _reset(
    simulator: Simulator,
    instance: task.TaskInstance,
    physics: ObjectPhysics,
    seed: int,
) -> None:
    """Puts the task into the simulator's context, at time 0."""
    diagram, context = simulator.get_system(), simulator.get_mutable_context()
    context.SetTime(0.0)
    diagram.SetDefaultContext(context)
    station = diagram.GetSubsystemByName("station")
    SetStationState(
        station,
        station.GetMyMutableContextFromRoot(context),
        instance.initial_state,
        physics,
    )
    goals = diagram.GetSubsystemByName("goals")
    goals.get_mutable_source_value(
        goals.GetMyMutableContextFromRoot(context)
    ).set_value(instance.goals.ravel())
    planner = diagram.GetSubsystemByName("planner")
    planner.set_seed(planner.GetMyMutableContextFromRoot(context), seed)
