"""The hardware station: the ports of the simulated one, and what stands behind them."""

from contextlib import nullcontext
from dataclasses import replace
import json
import math
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import EventStatus
import pytest

from rhp_drake import cli, typed_yaml
from rhp_drake.closed_loop import Hardware, MakeClosedLoop, MakeStation
from rhp_drake.drivers.measurements import ArmMeasurement, ObjectPose
from rhp_drake.errors import InputError
from rhp_drake.hardware import load_hardware
from rhp_drake.planning.policy import Decision
from rhp_drake.run_closed_loop import goals_of, run_on_hardware
from rhp_drake.safety import Fault
from rhp_drake.scenario import Scenario, load_scenario, make_task_instance
from rhp_drake.station.hardware_station import HardwareConfig, MeasureStation
from rhp_drake.station.ports import COMMAND_PERIOD, declared_ports, station_ports
from rhp_drake.station.ur5_kinematics import hand_pose, inverse_kinematics
from rhp_drake.systems.meshcat_overlay import MeshcatOverlay
from rhp_drake.task import Action, hand_targets

HAND = np.array([0.40, 0.0, 0.0])
BOXES = np.array([[0.60, 0.20, 0.3], [0.60, -0.20, 0.0], [0.30, 0.20, 0.0]])


class IdealArm:
    """A driver whose arm is where it was commanded to be."""

    def __init__(self):
        self.position = inverse_kinematics(HAND)
        self.commands = []
        self.fault = Fault.NONE
        self.age = 0.002

    def command(self, position, engaged):
        assert engaged
        self.commands.append(position)
        self.position = position

    def read(self):
        return ArmMeasurement(self.position, np.zeros(6), self.fault, self.age)


class Table:
    """A tracker of boxes that stand still."""

    def __init__(self):
        self.ages = [0.004] * 3

    def read(self):
        return [
            ObjectPose(RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, 0.03]), age)
            for (x, y, yaw), age in zip(BOXES, self.ages, strict=True)
        ]


class Forward:
    """Pushes on."""

    def decide(self, state, goals, generator, memory=None):
        return Decision(int(Action.FORWARD), np.nan)


@pytest.fixture
def hardware():
    return Hardware(IdealArm(), Table())


def run(hardware, monkeypatch, policy=None, **options):
    """In a diagram whose clock on the wall is the simulated one."""
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    loop = MakeClosedLoop(Scenario(), policy or Forward(), hardware=hardware)
    simulator = Simulator(loop)
    goal = np.array([0.7, 0.25])
    values = {"seed": 0, "time_limit": 1.0} | options
    return simulator, run_on_hardware(simulator, goal, **values)


def test_ports_are_those_of_the_simulation_less_what_only_that_can_know(hardware):
    wanted = {
        (p.name, p.direction, p.size)
        for p in station_ports(num_objects=3)
        if not p.simulation_only
    }
    assert declared_ports(MakeStation(Scenario(), hardware=hardware)) == wanted
    simulated = declared_ports(MakeStation(Scenario()))
    extras = {p.name for p in station_ports(num_objects=3) if p.simulation_only}
    assert {name for name, _, _ in simulated - wanted} == extras


def test_outputs_are_what_the_drivers_measure(hardware):
    station = MakeStation(Scenario(), hardware=hardware)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    hold = inverse_kinematics(HAND)
    station.GetInputPort("ur5.position").FixValue(context, hold)
    hardware.tracker.ages = [0.1, 0.2, math.inf]
    hardware.arm.fault = Fault.PROTECTIVE_STOP
    MeasureStation(station, context)

    def value(name):
        return station.GetOutputPort(name).Eval(context)

    np.testing.assert_array_equal(value("ur5.position_measured"), hold)
    np.testing.assert_array_equal(value("ur5.velocity_estimated"), np.zeros(6))
    np.testing.assert_array_equal(value("ur5.state_estimated"), [*hold, *np.zeros(6)])
    assert value("ur5.age") == [0.002]
    assert value("ur5.fault") == [Fault.PROTECTIVE_STOP]
    np.testing.assert_array_equal(value("object_ages"), [0.1, 0.2, math.inf])
    for X_WB, (x, y, yaw) in zip(value("object_poses"), BOXES, strict=True):
        expected = [x, y, 0.03]
        np.testing.assert_allclose(X_WB.translation(), expected, atol=1e-12)
        assert X_WB.rotation().ToRollPitchYaw().yaw_angle() == pytest.approx(yaw)


def test_nothing_is_commanded_until_there_is_a_command(hardware):
    station = MakeStation(Scenario(), hardware=hardware)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    position = station.GetInputPort("ur5.position")
    position.FixValue(context, np.full(6, math.nan))
    simulator.AdvanceTo(3.5 * COMMAND_PERIOD)
    assert not hardware.arm.commands
    target = inverse_kinematics(HAND)
    position.FixValue(context, target)
    simulator.AdvanceTo(4.5 * COMMAND_PERIOD)
    (command,) = hardware.arm.commands
    np.testing.assert_array_equal(command, target)


def test_the_loop_moves_the_arm_and_takes_its_goals_from_what_it_sees(
    hardware, monkeypatch
):
    simulator, outcome = run(hardware, monkeypatch, time_limit=0.85)
    assert outcome.status == "time_limit"
    assert outcome.num_actions == 1
    expected = hand_targets(HAND, np.array(Action.FORWARD))
    np.testing.assert_allclose(hand_pose(hardware.arm.position), expected, atol=1e-3)
    goals = goals_of(simulator).ravel()
    np.testing.assert_allclose(goals, [0.7, 0.25, *BOXES[1:, :2].ravel()])
    steps = np.diff(hardware.arm.commands, axis=0)
    assert np.abs(steps).max() / COMMAND_PERIOD < 1.0


def test_each_period_has_one_command(hardware, monkeypatch):
    counts = []
    monkeypatch.setattr(
        "time.sleep", lambda seconds: counts.append(len(hardware.arm.commands))
    )
    simulator = Simulator(MakeClosedLoop(Scenario(), Forward(), hardware=hardware))
    run_on_hardware(simulator, np.array([0.7, 0.25]), seed=0, time_limit=1.0)
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) == pytest.approx(1.0 / COMMAND_PERIOD, abs=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda hw: setattr(hw.arm, "fault", Fault.CONNECTION_LOST), "the connection"),
        (lambda hw: setattr(hw.arm, "age", 0.2), "the arm has not been heard of"),
        (lambda hw: setattr(hw.tracker, "ages", [0, 0, 1]), "an object has not been"),
    ],
)
def test_what_goes_wrong_stops_the_arm(change, message, hardware, monkeypatch):
    class Changing(Forward):
        def decide(self, *arguments):
            change(hardware)
            return super().decide(*arguments)

    _, outcome = run(hardware, monkeypatch, Changing())
    assert outcome.status == "guard_fault"
    assert message in outcome.message
    # Nothing was commanded but to stay.
    np.testing.assert_allclose(np.ptp(hardware.arm.commands, axis=0), 0, atol=1e-12)


def test_an_object_that_is_not_seen_keeps_the_run_from_starting(hardware, monkeypatch):
    hardware.tracker.ages = [0.0, math.inf, 0.0]
    with pytest.raises(InputError, match=r"does not see the objects \[1\]"):
        run(hardware, monkeypatch)
    assert not hardware.arm.commands


def test_an_arm_that_nobody_has_heard_of_is_not_moved(hardware, monkeypatch):
    hardware.arm.position = np.full(6, math.nan)
    with pytest.raises(RuntimeError, match="not finite"):
        run(hardware, monkeypatch)


def test_a_hand_that_is_too_high_keeps_the_run_from_starting(hardware, monkeypatch):
    hardware.arm.position = inverse_kinematics(HAND, 0.05)
    with pytest.raises(InputError, match="the hand does not stand upright"):
        run(hardware, monkeypatch)
    assert not hardware.arm.commands


def test_a_fault_is_not_drawn_before_the_arm_was_stopped(hardware, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        MeshcatOverlay, "_ShowFault", lambda overlay, fault, time: drawn.append(fault)
    )
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    loop = MakeClosedLoop(Scenario(), Forward(), meshcat, hardware)
    simulator = Simulator(loop)
    hardware.arm.fault = Fault.PROTECTIVE_STOP
    outcome = run_on_hardware(simulator, np.array([0.7, 0.25]), seed=0)
    assert outcome.fault == Fault.PROTECTIVE_STOP
    assert drawn == []
    loop.ForcedPublish(simulator.get_context())
    assert drawn == [Fault.PROTECTIVE_STOP]


def test_meshcat_shows_what_is_measured(hardware):
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    station = MakeStation(Scenario(), meshcat, hardware)
    simulator = Simulator(station)
    station.GetInputPort("ur5.position").FixValue(
        simulator.get_mutable_context(), inverse_kinematics(HAND)
    )
    simulator.AdvanceTo(0.01)
    for name in ("ur5", "hand", "target", "obstacle_1"):
        assert meshcat.HasPath(f"/drake/visualizer/{name}")


def test_goal_regions_are_drawn_where_they_are(hardware, monkeypatch):
    drawn = []

    def draw_discs(overlay, context):
        drawn.append(overlay.GetInputPort("goals").Eval(context).copy())
        return EventStatus.Succeeded()

    monkeypatch.setattr(MeshcatOverlay, "_PublishDiscs", draw_discs)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    loop = MakeClosedLoop(Scenario(), Forward(), meshcat, hardware)
    goal = np.array([0.7, 0.25])
    run_on_hardware(Simulator(loop), goal, seed=0, time_limit=0.05)
    np.testing.assert_allclose(drawn, [[*goal, *BOXES[1:, :2].ravel()]])


def test_bad_models(hardware):
    scenario = Scenario()
    scenario.station = replace(scenario.station, objects=["green_box"])
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    with pytest.raises(InputError, match="add no model named 'green_box'"):
        MakeStation(scenario, meshcat, hardware)


def test_the_record_says_what_hardware_it_was(hardware, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr(
        "rhp_drake.hardware.running_hardware",
        lambda config, num_objects: nullcontext(hardware),
    )
    path = tmp_path / "first" / "run.json"

    def rhp(command, *arguments):
        options = ("--no-meshcat", "--scenario-text", "{time_limit: 0.5}")
        monkeypatch.setattr("sys.argv", ["rhp", command, *arguments, *options])
        with pytest.raises(SystemExit) as info:
            cli.main()
        return info.value.code

    on_lab = ("--policy", "random", "--hardware", "virtual_lab", "--out")
    assert rhp("run", "three_boxes", *on_lab, str(path.parent)) == 1
    record = json.loads(path.read_text())
    config = typed_yaml.merge(record["hardware"], HardwareConfig(), "run.json")
    expected = load_hardware(Path("virtual_lab"))
    assert typed_yaml.expand(config) == typed_yaml.expand(expected)
    # Obstacles are to stay where they were.
    np.testing.assert_allclose(record["goals"][1:], BOXES[1:, :2], atol=1e-9)
    goal = make_task_instance(load_scenario("three_boxes")[1]).goals[0]
    assert record["goals"][0] == goal.tolist()

    # That is not what a simulation would do.
    capsys.readouterr()
    again = (str(path), "--name", "scenario")
    for command in ("run", "plan"):
        assert rhp(command, *again) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert lines[0].startswith(f"rhp: {path}: this run was on hardware ")
    # On hardware it is.
    assert rhp("run", *again, *on_lab, str(tmp_path / "second")) == 1
    second = json.loads((tmp_path / "second" / "run.json").read_text())
    assert second["goals"] == record["goals"]
