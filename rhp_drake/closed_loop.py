"""The closed loop: one diagram of station and systems."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    InputPort,
    OutputPort,
)
from pydrake.systems.primitives import ConstantVectorSource

from rhp_drake.planning.policy import Policy
from rhp_drake.scenario import Scenario
from rhp_drake.station.hardware_station import Arm, MakeHardwareStation, Tracker
from rhp_drake.station.simulated_station import MakeSimulatedStation
from rhp_drake.station.ur5_kinematics import NOMINAL, Ur5Kinematics
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
        kinematics: The arm's.
    """

    arm: Arm
    tracker: Tracker
    kinematics: Ur5Kinematics = NOMINAL


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
    if hardware is None:
        return MakeSimulatedStation(scenario.station, meshcat)
    return MakeHardwareStation(
        scenario.station, hardware.arm, hardware.tracker, meshcat
    )


@dataclass(frozen=True)
class Robot:
    """Ports of a robot that goes where its hand is sent.

    Attributes:
        state: Output of size 3 + 3 m.
        at_rest: Output of size 1.
        fault: Output of size 1, a `safety.Fault`.
        hand_target: Input of size 3.
    """

    state: OutputPort
    at_rest: OutputPort
    fault: OutputPort
    hand_target: InputPort


def AddRobot(
    builder: DiagramBuilder,
    scenario: Scenario,
    meshcat: "Meshcat | None" = None,
    hardware: Hardware | None = None,
) -> Robot:
    """Adds the loop but for who decides: station, estimator, servo and guard.

    Args:
        builder: Gets the systems.
        scenario: Says which station.
        meshcat: Where to show it, if anywhere.
        hardware: The drivers; None to simulate.

    Raises:
        InputError: If there is no such station.
    """
    m = len(scenario.station.objects)
    kinematics = NOMINAL if hardware is None else hardware.kinematics
    station = MakeStation(scenario, meshcat, hardware)
    builder.AddNamedSystem("station", station)
    estimator = builder.AddNamedSystem("state_estimator", StateEstimator(m, kinematics))
    servo = builder.AddNamedSystem("hand_servo", HandServo(kinematics))
    guard = builder.AddNamedSystem(
        "command_guard", CommandGuard(scenario.guard, m, kinematics)
    )
    for theirs, system, ours in (
        ("ur5.position_measured", estimator, "position_measured"),
        ("ur5.velocity_estimated", estimator, "velocity_estimated"),
        ("object_poses", estimator, "object_poses"),
        ("ur5.position_measured", servo, "position_measured"),
        ("ur5.position_measured", guard, "position_measured"),
        ("ur5.age", guard, "arm_age"),
        ("ur5.fault", guard, "arm_fault"),
        ("object_poses", guard, "object_poses"),
        ("object_ages", guard, "object_ages"),
    ):
        builder.Connect(station.GetOutputPort(theirs), system.GetInputPort(ours))
    builder.Connect(servo.GetOutputPort("position"), guard.GetInputPort("position"))
    builder.Connect(
        guard.GetOutputPort("position"), station.GetInputPort("ur5.position")
    )
    return Robot(
        state=estimator.GetOutputPort("state"),
        at_rest=estimator.GetOutputPort("at_rest"),
        fault=guard.GetOutputPort("fault"),
        hand_target=servo.GetInputPort("hand_target"),
    )


def AddClosedLoop(
    builder: DiagramBuilder,
    scenario: Scenario,
    policy: Policy,
    meshcat: "Meshcat | None" = None,
    hardware: Hardware | None = None,
) -> None:
    """Adds the loop: station -> estimator -> planner -> servo -> guard -> station.

    `builder.GetSubsystemByName` finds the systems: `station`, `state_estimator`,
    `planner`, `hand_servo`, `command_guard`, `goals`, and `overlay` where there is a
    meshcat.  Whatever else is in the builder may use their ports.

    The loop knows no task: `run_closed_loop` puts it into the context, so that one
    diagram serves any number of tasks.  Until then its goals are nan, and the planner
    refuses to plan.

    Args:
        builder: Gets the systems.
        scenario: Says which station.
        policy: Who decides.
        meshcat: Where to show it; None to show nothing, which changes nothing else.
        hardware: The drivers of a real robot and its tracker; None to simulate.

    Raises:
        InputError: If there is no such station.
    """
    m = len(scenario.station.objects)
    robot = AddRobot(builder, scenario, meshcat, hardware)
    unknown = np.full(2 * m, np.nan)
    goals = builder.AddNamedSystem("goals", ConstantVectorSource(unknown))
    planner = builder.AddNamedSystem("planner", RecedingHorizonPlanner(policy, m))
    builder.Connect(robot.state, planner.GetInputPort("state"))
    builder.Connect(robot.at_rest, planner.GetInputPort("at_rest"))
    builder.Connect(goals.get_output_port(), planner.GetInputPort("goals"))
    builder.Connect(planner.GetOutputPort("hand_target"), robot.hand_target)

    if meshcat is not None:
        # Imported here because a run without pictures needs none of it.
        from rhp_drake.systems.meshcat_overlay import MeshcatOverlay

        overlay = builder.AddNamedSystem("overlay", MeshcatOverlay(meshcat, m))
        builder.Connect(robot.state, overlay.GetInputPort("state"))
        builder.Connect(goals.get_output_port(), overlay.GetInputPort("goals"))
        builder.Connect(
            planner.GetOutputPort("decision"), overlay.GetInputPort("decision")
        )
        builder.Connect(robot.fault, overlay.GetInputPort("fault"))


def MakeClosedLoop(
    scenario: Scenario,
    policy: Policy,
    meshcat: "Meshcat | None" = None,
    hardware: Hardware | None = None,
) -> Diagram:
    """Makes a diagram of nothing but the loop; see `AddClosedLoop`."""
    builder = DiagramBuilder()
    AddClosedLoop(builder, scenario, policy, meshcat, hardware)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram
