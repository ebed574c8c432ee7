"""The virtual lab: a station behind protocols, faults by their words, a whole run."""

import json
from pathlib import Path
import subprocess
import sys
import time

import numpy as np
import pytest

from rhp_drake import cli, hardware
from rhp_drake.drivers import ur_stream
from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.errors import InputError
from rhp_drake.frozen_instances import load_instances
from rhp_drake.hardware import load_hardware
from rhp_drake.lab.faults import FAULTS, inject
from rhp_drake.lab.modes import RobotMode, SafetyMode
from rhp_drake.lab.natnet_server import Freeze
from rhp_drake.lab.rtde_server import Stream
from rhp_drake.lab.virtual_lab import VirtualLab
from rhp_drake.physics import nominal_physics
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.resources import scenarios_path
from rhp_drake.station.station_models import StationConfig
from rhp_drake.station.ur5_kinematics import hand_pose
from rhp_drake.systems.command_guard import CommandGuardConfig

# Of this module alone: the robot's ports are fixed.
HOST, RUN_HOST = "127.0.0.25", "127.0.0.26"
INSTANCE = load_instances(VALIDATION)[0]


@pytest.fixture(scope="module")
def lab():
    lab = VirtualLab(
        StationConfig(), INSTANCE, nominal_physics(3), HOST, 0, stream(0, "faults")
    )
    yield lab
    lab.close()


def test_the_robot_is_where_the_task_begins_and_stays_there(lab):
    for _ in range(25):
        lab.step()
    outputs = lab.controller.outputs()
    np.testing.assert_allclose(
        hand_pose(np.array(outputs["actual_q"])), INSTANCE.initial_state[:3], atol=1e-4
    )
    assert outputs["timestamp"] == pytest.approx(0.192, abs=0.009)


def test_faults_by_their_words(lab):
    inject(lab, "protective_stop")
    lab.step()
    assert lab.controller.safety_mode == SafetyMode.PROTECTIVE_STOP
    inject(lab, "robot_silent")
    inject(lab, "tracker_repeats")
    inject(lab, "tracker_malformed 0.5")
    assert lab.rtde.stream == Stream.SILENT
    assert lab.natnet.freeze == Freeze.REPEAT
    assert lab.natnet.malformed_share == 0.5
    for text in ("occlude target", "reveal target", "swap target obstacle_1"):
        inject(lab, text)
    inject(lab, "clear")
    assert lab.rtde.stream == Stream.LIVE
    assert lab.natnet.freeze == Freeze.NONE
    assert lab.natnet.malformed_share == 0.0
    inject(lab, "swap target obstacle_1")


def test_all_faults_can_be_called_for_and_undone(lab):
    examples = {"object": iter(["target", "obstacle_1"] * 9), "number": iter([0.0] * 9)}
    for word, fault in FAULTS.items():
        arguments = [str(next(examples[kind])) for kind in fault.arguments]
        inject(lab, " ".join([word, *arguments]))
        lab.step()
    assert lab.controller.robot_mode != RobotMode.RUNNING  # The last was a reboot.
    for text in ("restart", "clear", "swap target obstacle_1"):
        inject(lab, text)
    lab.step()
    assert lab.controller.robot_mode == RobotMode.RUNNING
    assert lab.controller.safety_mode == SafetyMode.NORMAL
    assert lab.rtde.stream == Stream.LIVE


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("explode", "'explode' is none of protective_stop, "),
        ("", "'' is none of"),
        ("occlude", "'occlude': expected 'occlude object'"),
        ("occlude hand", "'hand' is none of target, obstacle_1, obstacle_2"),
        ("robot_delay soon", "'soon' is no number"),
        ("robot_delay -1", "-1 is not from 0 to 60"),
        ("robot_delay nan", "nan is not from 0 to 60"),
        ("clear all", "'clear all': expected 'clear'"),
    ],
)
def test_words_that_mean_nothing(text, message, lab):
    with pytest.raises(InputError, match=message):
        inject(lab, text)


def test_a_lab_is_on_loopback_alone():
    with pytest.raises(InputError, match="listens at 127"):
        VirtualLab(
            StationConfig(),
            INSTANCE,
            nominal_physics(3),
            "0.0.0.0",
            0,
            stream(0, "faults"),
        )


@pytest.mark.parametrize("name", ["virtual_lab", "hardware"])
def test_bundled_files_are_read(name):
    config = load_hardware(scenarios_path() / f"{name}.yaml")
    assert config.natnet.bodies == StationConfig().objects


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lab: {ur: {hots: 1}}", "hots"),
        ("lab: {ur: {host: ''}}", "lab: ur.host: the robot's address is missing"),
        ("lab: {ur: {host: a, gain: high}}", "gain"),
        (
            "lab: {ur: {host: a, limits: {velocity_limit: 4}}}",
            "lab: ur.limits.velocity_limit: 4.0; it must be positive, and at most 3.14",
        ),
        ("lab: {ur: {host: a}}", "lab: natnet.bodies must name different rigid bodies"),
        (
            "lab: {lcm: {}, ur: {host: a, gain: 1}}",
            "lab: ur.gain is 1.0; it must be from 100 to 2000",
        ),
        ("a: {}\nb: {}", "has several labs where one has to be chosen: a, b"),
        (
            "lab: {ur: {host: a}, kinematics: {delta_d: [0.1, 0.2]}}",
            r"lab: kinematics.delta_d is \[0.1, 0.2\]; it must be six finite numbers",
        ),
        ("lab: {kinematics: {delta_a: [0, x, 0, 0, 0, 0]}}", "kinematics.delta_a"),
        ("ur: 3", "expected a lab with its name before it"),
    ],
)
def test_bad_files(text, message, tmp_path):
    path = tmp_path / "lab.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_hardware(path)


def test_run_needs_as_many_bodies_as_objects(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(
        "sys.argv",
        ["rhp", "run", "five_boxes", "--hardware", "virtual_lab", "--no-meshcat"],
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert info.value.code == 2
    assert "natnet.bodies names 3 rigid bodies; the scenario has 5" in (
        capsys.readouterr().err
    )


def test_the_arm_is_stopped_first_and_each_even_if_the_other_fails(monkeypatch):
    calls = []

    def fake(name):
        class Driver:
            def __init__(self, *arguments):
                pass

            def start(self):
                calls.append(f"{name} starts")

            def stop(self):
                calls.append(f"{name} stops")
                raise RuntimeError(name)

        return Driver

    monkeypatch.setattr(hardware, "UrDriver", fake("arm"))
    monkeypatch.setattr(hardware, "NatNetDriver", fake("tracker"))
    config = load_hardware(scenarios_path() / "virtual_lab.yaml")
    with pytest.raises(RuntimeError), hardware.running_hardware(config, 3):
        calls.append("run")
    assert calls == [
        "tracker starts",
        "arm starts",
        "run",
        "arm stops",
        "tracker stops",
    ]


def test_the_default_is_to_hold_still(tmp_path):
    path = tmp_path / "lab.yaml"
    path.write_text("lab: {ur: {host: robot}, natnet: {bodies: [a]}}")
    assert load_hardware(path).ur.dry_run


def test_the_documentation_says_the_defaults():
    text = (Path(__file__).parents[1] / "docs" / "hardware.md").read_text()
    ur, guard = UrDriverConfig(), CommandGuardConfig()
    for words in (
        f"no command for {1000 * ur.command_timeout:.0f} ms",
        f"or {ur.patience:g} s (`ur.patience`)",
        f"nothing new from the robot for {1000 * ur.measurement_timeout:.0f} ms",
        f"not seen for {1000 * guard.object_age_limit:.0f} ms",
        f"not heard of for {1000 * guard.arm_age_limit:.0f} ms",
        f"watchdog ({ur_stream._WATCHDOG_FREQUENCY:.0f} Hz)",
    ):
        assert words in text


@pytest.mark.slow
def test_a_run_over_loopback_decides_as_one_in_process(tmp_path):
    """The real clients, the real protocols, in real time."""
    text = (scenarios_path() / "virtual_lab.yaml").read_text()
    lab_file = tmp_path / "lab.yaml"
    lab_file.write_text(text.replace("127.0.0.2", RUN_HOST))
    rhp = [sys.executable, "-m", "rhp_drake.cli"]
    lab = subprocess.Popen(
        [*rhp, "lab", "three_boxes", "--host", RUN_HOST],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        while "At " not in lab.stdout.readline():
            assert lab.poll() is None
        time.sleep(1.0)
        run = [*rhp, "run", "three_boxes", "--no-meshcat"]
        over_loopback, in_process = tmp_path / "loopback", tmp_path / "in_process"
        subprocess.run(
            [*run, "--hardware", lab_file, "--out", over_loopback], check=True
        )
        subprocess.run([*run, "--no-realtime", "--out", in_process], check=True)
    finally:
        lab.kill()
        lab.wait()
    ours, theirs = (
        [decision["action"] for decision in record["decisions"]]
        for record in (
            json.loads((folder / "run.json").read_text())
            for folder in (over_loopback, in_process)
        )
    )
    assert ours == theirs
