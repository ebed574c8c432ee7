"""An arm with figures of its own behind estimator, servo and guard."""

from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
import pytest

from rhp_drake import hardware
from rhp_drake.closed_loop import AddRobot, Hardware
from rhp_drake.commands.driver import driver
from rhp_drake.drivers.measurements import ArmMeasurement, ObjectPose
from rhp_drake.errors import InputError
from rhp_drake.safety import Fault
from rhp_drake.scenario import Scenario
from rhp_drake.station.hardware_station import MeasureStation
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import (
    NOMINAL,
    PUSHING_HEIGHT,
    DhDeltas,
    Ur5Kinematics,
)

START = np.array([0.40, 0.0, 0.0])
TARGET = np.array([0.45, 0.03, 0.2])
# Moves the hand millimetres to the side, tilts it, and lifts it by more than the 4 mm
# that the guard allows.
DELTAS = DhDeltas(
    delta_d=[0.006, 0.3, -0.25, -0.047, 0.0, 0.0],
    delta_alpha=[1e-3, 1e-3, -1e-3, 1e-3, 2e-3, 0.0],
)


class IdealArm:
    """A driver whose arm is where it was commanded to be.

    Its hand is where the arm's true figures have it, whatever the loop believes.
    """

    def __init__(self, truth):
        self.truth = truth
        self.position = truth.inverse_kinematics(START)

    def command(self, position, engaged):
        self.position = position

    def read(self):
        return ArmMeasurement(self.position, np.zeros(6), Fault.NONE, 0.002)

    @property
    def hand(self):
        """Where H is, shape (3,)."""
        return self.truth.forward_kinematics(self.position)[:3, 3]


class Table:
    """A tracker of boxes that stand out of the way."""

    def read(self):
        return [
            ObjectPose(RigidTransform([0.7, y, 0.03]), 0.004) for y in (-0.2, 0.0, 0.2)
        ]


def go_to_target(believed):
    """Sends a calibrated arm to TARGET, returns it, and the last state and fault."""
    arm = IdealArm(Ur5Kinematics(DELTAS))
    builder = DiagramBuilder()
    robot = AddRobot(builder, Scenario(), hardware=Hardware(arm, Table(), believed))
    target = builder.AddSystem(ConstantVectorSource(TARGET))
    builder.Connect(target.get_output_port(), robot.hand_target)
    builder.ExportOutput(robot.state, "state")
    builder.ExportOutput(robot.fault, "fault")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    station = diagram.GetSubsystemByName("station")
    MeasureStation(station, station.GetMyMutableContextFromRoot(context))
    simulator.Initialize()
    simulator.AdvanceTo(200.5 * COMMAND_PERIOD)
    state = diagram.GetOutputPort("state").Eval(context)
    fault = Fault(int(diagram.GetOutputPort("fault").Eval(context)[0]))
    return arm, state, fault


def test_the_hand_goes_where_it_is_sent():
    arm, state, fault = go_to_target(Ur5Kinematics(DELTAS))
    assert fault == Fault.NONE
    np.testing.assert_allclose(arm.hand, [*TARGET[:2], PUSHING_HEIGHT], atol=1e-9)
    np.testing.assert_allclose(state[:3], TARGET, atol=1e-9)
    # With the joints of a nominal arm it would be elsewhere.
    arm.position = NOMINAL.inverse_kinematics(TARGET)
    miss = arm.hand - [*TARGET[:2], PUSHING_HEIGHT]
    assert np.hypot(*miss[:2]) > 0.002
    assert miss[2] > 0.004


def test_the_guard_knows_the_height_that_the_hand_has():
    # A loop that takes the arm for a nominal one has the hand too high or too low.
    arm, _, fault = go_to_target(NOMINAL)
    assert fault == Fault.HAND_OUTSIDE
    np.testing.assert_allclose(arm.hand, [*START[:2], PUSHING_HEIGHT], atol=1e-9)


class Driver:
    """Anything that is started and stopped."""

    def __init__(self, *arguments):
        pass

    def start(self):
        pass

    def stop(self):
        pass


def test_figures_of_the_file_reach_the_loop(tmp_path, monkeypatch):
    path = tmp_path / "lab.yaml"
    path.write_text(
        "lab:\n"
        "  ur: {host: robot}\n"
        "  natnet: {bodies: [box]}\n"
        "  kinematics:\n"
        # As the robot's own file has them, but for the colons.
        "    delta_theta: [ -8.20642406610186392e-05, 0, 0, 0, 0, 9.749995611e-07]\n"
        "    delta_d: [ 0.000505390894843998906, 11.1984514757821, -11.198, 0, 0, 0]\n"
    )
    config = hardware.load_hardware(path)
    monkeypatch.setattr(hardware, "NatNetDriver", Driver)
    monkeypatch.setattr(hardware, "UrDriver", Driver)
    expected = Ur5Kinematics(
        DhDeltas(
            delta_theta=[-8.20642406610186392e-05, 0, 0, 0, 0, 9.749995611e-07],
            delta_d=[0.000505390894843998906, 11.1984514757821, -11.198, 0, 0, 0],
        )
    )
    q = expected.inverse_kinematics(TARGET)
    with hardware.running_hardware(config, 1) as running:
        X_WH = running.kinematics.forward_kinematics(q)
    np.testing.assert_array_equal(X_WH, expected.forward_kinematics(q))
    config = replace(config, kinematics=DhDeltas())
    with hardware.running_hardware(config, 1) as running:
        X_WH = running.kinematics.forward_kinematics(q)
    np.testing.assert_array_equal(X_WH, NOMINAL.forward_kinematics(q))


def test_figures_of_another_arm_are_refused(tmp_path):
    path = tmp_path / "lab.yaml"
    path.write_text(
        "lab: {ur: {host: robot}, kinematics: {delta_a: [0, -0.2, 0, 0, 0, 0]}}"
    )
    with pytest.raises(InputError, match="lab: kinematics: the deltas move the hand"):
        hardware.load_hardware(path)


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_driver_over_lcm_says_that_the_planner_needs_the_figures(
    calibrated, tmp_path, monkeypatch, capsys
):
    path = tmp_path / "lab.yaml"
    figures = "kinematics: {delta_a: [0, 1.0e-4, 0, 0, 0, 0]}" if calibrated else ""
    known = "ur: {host: robot}, natnet: {bodies: [a]}"
    path.write_text(f"lab: {{{known}, {figures}}}")

    def refuse(config, num_objects):
        raise InputError("no robot.")

    monkeypatch.setattr(hardware, "running_hardware", refuse)
    with pytest.raises(InputError, match="no robot"):
        driver(path)
    told = "this file's `kinematics` in its own file" in capsys.readouterr().out
    assert told == calibrated
