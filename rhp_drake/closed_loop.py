"""The closed loop: one diagram of station and systems."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from rhp_drake.errors import InputError
from rhp_drake.planning.policy import Policy
from rhp_drake.scenario import Scenario
from rhp_drake.station.hardware_station import Arm, MakeHardwareStation, Tracker
from rhp_drake.station.simulated_station import MakeSimulatedStation
from rhp_drake.systems.command_guard import CommandGuard
from rhp_drake.systems.hand_servo import HandServo
from rhp_drake.systems.receding_horizon_planner import RecedingHorizonPlanner
from rhp_drake.systems.state_estimator import StateEstimator

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat


@dataclass(frozen=True)
class Hardware:
    """What takes the simulation's place: drivers that run.

    Attributes:
        arm: The robot's.
        tracker: The tracker's.
    """

    arm: Arm
    tracker: Tracker


def MakeStation(
    scenario: Scenario,
    meshcat: "Meshcat | None" = None,
    hardware: Hardware | None = None,
) -> Diagram:
    """Makes the scenario's station, simulated or real, with the same ports.

    Args:
        scenario: Says of what.
        meshcat: Where to show it, if anywhere.
        hardware: The drivers; None to simulate.

    Raises:
        InputError: If there is no such station.
    """
    try:
        if hardware is None:
            return MakeSimulatedStation(scenario.station, meshcat)
        return MakeHardwareStation(
            scenario.station, hardware.arm, hardware.tracker, meshcat
        )
    except (RuntimeError, ValueError, SystemExit) as error:
        # Words of Drake's about models and settings that come from the scenario.  A
        # failed assertion in Drake comes as a SystemExit.
        raise InputError(f"station: {error}") from error


def MakeClosedLoop(
    scenario: Scenario,
    policy: Policy,
    meshcat: "Meshcat | None" = None,
    hardware: Hardware | None = None,
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
        hardware: The drivers of a real robot and its tracker; None to simulate.

    Raises:
        InputError: If there is no such station.
    """
    m = len(scenario.station.objects)
    builder = DiagramBuilder()
    station = MakeStation(scenario, meshcat, hardware)
    builder.AddNamedSystem("station", station)
    estimator = builder.AddNamedSystem("state_estimator", StateEstimator(m))
    goals = builder.AddNamedSystem("goals", ConstantVectorSource(np.zeros(2 * m)))
    planner = builder.AddNamedSystem("planner", RecedingHorizonPlanner(policy, m))
    servo = builder.AddNamedSystem("hand_servo", HandServo())
    guard = builder.AddNamedSystem("command_guard", CommandGuard(scenario.guard, m))

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
    for ours, theirs in (
        ("ur5.age", "arm_age"),
        ("ur5.fault", "arm_fault"),
        ("object_poses", "object_poses"),
        ("object_ages", "object_ages"),
    ):
        builder.Connect(station.GetOutputPort(ours), guard.GetInputPort(theirs))
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
