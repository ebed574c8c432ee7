"""The driver over LCM as a user has it: its file, and whole runs over loopback."""

from contextlib import ExitStack
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from rhp_drake.drivers.lcm_driver import LcmDriver
from rhp_drake.errors import InputError, WorkError
from rhp_drake.hardware import load_hardware, running_hardware
from rhp_drake.safety import Fault
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.station_models import StationConfig

# Of this module alone: the robot's ports are fixed, and LCM's group is everybody's.
HOST, URL = "127.0.0.27", "udpm://239.255.76.67:7672?ttl=0"


def test_the_bundled_file_knows_the_objects_of_the_bundled_scenarios():
    config = load_hardware(Path("lcm"))
    assert config.lcm.objects == StationConfig().objects
    with (
        pytest.raises(InputError, match="names 3 objects; the scenario has 5 objects"),
        running_hardware(config, 5),
    ):
        pass


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{url: here}", "lab: lcm.url is 'here'; it must be such as 'udpm://239.255"),
        ("{url: 'udpm://10.0.0.1:7667'}", "lcm.url is 'udpm://10.0.0.1:7667'"),
        ("{url: 'udpm://300.1.1.1:7667'}", "lcm.url is 'udpm://300.1.1.1:7667'"),
        ("{url: 'udpm://239.1.1.1:76670'}", "lcm.url is 'udpm://239.1.1.1:76670'"),
        ("{url: 'udpm://239.1.1.1:7667?ttl=256'}", "lcm.url is .*ttl=256"),
        ("{objects: [a, a]}", "lcm.objects must name different objects"),
        ("{object: [a]}", "object: there is no such key"),
    ],
)
def test_bad_files(text, message, tmp_path):
    path = tmp_path / "lab.yaml"
    path.write_text(f"lab: {{lcm: {text}}}")
    with pytest.raises(InputError, match=message):
        load_hardware(path)


# Patient where computers may be slow; not where a planner is dead.
LAB = f"""
lab:
  ur:
    host: {HOST}
    dry_run: false
    command_timeout: 1.0
    measurement_timeout: 1.0
    patience: 2.0
  natnet: {{server_address: {HOST}, bodies: [target, obstacle_1, obstacle_2]}}
  lcm: {{url: "{URL}", objects: [target, obstacle_1, obstacle_2]}}
"""
RHP = [sys.executable, "-m", "rhp_drake.cli"]
GUARD = "{guard: {arm_age_limit: 1.0, object_age_limit: 2.0}}"


def read_until(process, text):
    """Reads what a process prints until `text` is in a line."""
    while text not in process.stdout.readline():
        assert process.poll() is None


@pytest.fixture
def lab_file(tmp_path):
    path = tmp_path / "lab.yaml"
    path.write_text(LAB)
    return path


@pytest.fixture
def bridge_process(lab_file):
    """`rhp driver`, beside `rhp lab`."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with ExitStack() as stack:
        for arguments in (["lab", "three_boxes", "--host", HOST], ["driver", lab_file]):
            process = subprocess.Popen([*RHP, *arguments], **pipes)
            stack.callback(process.wait)
            stack.callback(process.kill)
            read_until(process, "At ")
        yield process


@pytest.mark.slow
def test_a_lab_a_driver_and_a_run(bridge_process, lab_file, tmp_path):
    """Three processes over loopback, in real time."""
    run = [*RHP, "run", "three_boxes", "--no-meshcat", "--out", tmp_path]
    options = ["--hardware", lab_file, "--scenario-text", GUARD]
    subprocess.run([*run, *options], check=True)
    bridge_process.send_signal(signal.SIGINT)
    read_until(bridge_process, "The arm is stopped.")
    assert bridge_process.wait() == 0


@pytest.mark.slow
def test_a_planner_that_falls_silent(bridge_process, lab_file):
    config = load_hardware(lab_file).lcm
    driver = LcmDriver(config, COMMAND_PERIOD)
    driver.start()
    try:
        position = driver.arm.read().position
        for _ in range(50):
            driver.arm.command(position, engaged=True)
            time.sleep(0.008)
        assert driver.arm.read().fault == Fault.NONE
        read_until(bridge_process, "no command came in time")
        with pytest.raises(WorkError, match="started anew: no command came in time"):
            LcmDriver(config, COMMAND_PERIOD).start()
    finally:
        driver.stop()
