"""The virtual robot's servers, with ur_rtde's own clients."""

from contextlib import closing, suppress
import math
import multiprocessing
import os
import random
import signal
import socket
import struct
import time

import numpy as np
import pytest
from robot_process import PATIENCE, START, make_ready, running_robot, wait_until
from rtde_client import package

from rhp_drake.lab.dashboard_server import DASHBOARD_PORT
from rhp_drake.lab.modes import RobotMode, RuntimeState, SafetyMode
from rhp_drake.lab.rtde_server import RTDE_PORT, SCRIPT_PORT, Stream
from rhp_drake.station.ports import COMMAND_PERIOD

# Of this module alone: the robot's ports are fixed.
HOST = "127.0.0.21"
VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "target_q",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "safety_status_bits",
]


@pytest.fixture(scope="module")
def lab_process():
    with running_robot(HOST) as lab:
        yield lab


@pytest.fixture
def lab(lab_process):
    return make_ready(lab_process)


@pytest.fixture(scope="module")
def receiver(lab_process):
    rtde_receive = pytest.importorskip("rtde_receive")
    receiver = rtde_receive.RTDEReceiveInterface(HOST, -1.0, VARIABLES)
    yield receiver
    receiver.disconnect()


@pytest.fixture
def receive(lab, receiver):
    """The other interface, of ur_rtde's, which sees the lab as it is now."""
    if not receiver.isConnected():
        receiver.reconnect()
    now = lab("controller", "outputs")["timestamp"]
    wait_until(lambda: receiver.getTimestamp() > now, "new values")
    return receiver


class Control:
    """ur_rtde's interface that moves the arm."""

    def __init__(self):
        rtde_control = pytest.importorskip("rtde_control")
        self.interface = rtde_control.RTDEControlInterface(HOST)

    def close(self):
        self.interface.disconnect()


@pytest.fixture
def control(lab, receive):
    with closing(Control()) as control:
        yield control.interface


@pytest.fixture
def dashboard(lab):
    dashboard_client = pytest.importorskip("dashboard_client")
    dashboard = dashboard_client.DashboardClient(HOST)
    dashboard.connect()
    yield dashboard
    dashboard.disconnect()


def servo(control, q):
    return control.servoJ(list(q), 0.5, 0.5, COMMAND_PERIOD, 0.1, 300)


def servo_to(control, receive, target, speed=0.5):
    """Streams positions to the target, and then on until the arm is there."""
    q = np.array(receive.getActualQ())
    deadline = time.monotonic() + PATIENCE
    while np.abs(receive.getActualQ() - target).max() > 1e-3:
        assert time.monotonic() < deadline
        assert servo(control, q)
        q += np.clip(target - q, -speed * COMMAND_PERIOD, speed * COMMAND_PERIOD)
        time.sleep(COMMAND_PERIOD)


def at_rest(receive):
    return not np.any(receive.getActualQd())


def test_receives_all_variables_of_ur_rtde(lab):
    rtde_receive = pytest.importorskip("rtde_receive")
    # Without a list it asks for everything that it knows for this version.
    receive = rtde_receive.RTDEReceiveInterface(HOST)
    assert receive.getRobotMode() == RobotMode.RUNNING
    assert receive.getSafetyMode() == SafetyMode.NORMAL
    assert receive.getRuntimeState() == RuntimeState.STOPPED
    assert receive.getJointMode() == [253] * 6
    assert receive.getSpeedScaling() == 1.0
    np.testing.assert_allclose(receive.getActualQ(), receive.getTargetQ())
    assert lab("controller", "outputs")["actual_q"] == tuple(receive.getActualQ())
    before = receive.getTimestamp()
    wait_until(lambda: receive.getTimestamp() > before + 0.1, "time to pass")
    receive.disconnect()


def test_servo(lab, control, receive):
    target = START + 0.2
    servo_to(control, receive, target)
    assert servo(control, target)
    assert control.servoStop(10.0)
    wait_until(lambda: at_rest(receive), "the arm to rest")
    np.testing.assert_allclose(receive.getActualQ(), target, atol=5e-3)
    # The next command is taken as well.
    servo_to(control, receive, START)
    control.stopScript()
    assert not servo(control, START)
    assert "client" in lab.stop_reason


def test_servo_stop_on_the_way(lab, control, receive):
    for i in range(50):
        assert servo(control, START + 0.004 * i)
        time.sleep(COMMAND_PERIOD)
    wait_until(lambda: not at_rest(receive), "the arm to move")
    assert control.servoStop(10.0)
    wait_until(lambda: at_rest(receive), "the arm to rest")
    assert receive.getRuntimeState() == RuntimeState.PLAYING
    last = [command.name for command in lab("controller", "commands")][-1]
    assert last == "servoStop"


def test_moves_and_speeds(lab, control, receive):
    assert control.moveJ(list(START + 0.3), 1.0, 4.0)
    np.testing.assert_allclose(receive.getActualQ(), START + 0.3, atol=1e-2)
    assert control.speedJ([0.2, 0, 0, 0, 0, 0], 1.0, 0.0)
    wait_until(lambda: receive.getActualQ()[0] > START[0] + 0.35, "the arm to move")
    assert control.speedStop(5.0)
    assert control.moveJ(list(START), 0.5, 4.0, True)
    assert control.getAsyncOperationProgress() >= 0
    control.stopJ(4.0)
    wait_until(lambda: control.getAsyncOperationProgress() < 0, "the move's end")
    wait_until(lambda: at_rest(receive), "the arm to rest")


def servo_for_ever(host, pipe):
    """A client that moves the arm with a watchdog, until it is killed."""
    from rtde_control import RTDEControlInterface

    control = RTDEControlInterface(host)
    control.setWatchdog(10.0)
    began = time.monotonic()
    q = START.copy()
    told = False
    while True:
        # Where no command is far from the last, even if this process has to wait.
        q[0] = START[0] + 0.2 * math.sin(4 * (time.monotonic() - began))
        if not servo(control, q):
            # It had to wait for long.
            control.reuploadScript()
            time.sleep(0.2)
            control.setWatchdog(10.0)
        elif not told:
            pipe.send(None)
            told = True
        time.sleep(COMMAND_PERIOD)


def test_watchdog_stops_the_arm_of_a_killed_client(lab, receive):
    pytest.importorskip("rtde_control")
    pipe, other = multiprocessing.Pipe()
    client = multiprocessing.get_context("spawn").Process(
        target=servo_for_ever, args=(HOST, other), daemon=True
    )
    client.start()
    try:
        assert pipe.poll(PATIENCE), "the client does not start"
        wait_until(lambda: not at_rest(receive), "the arm to move")
    finally:
        os.kill(client.pid, signal.SIGKILL)
        client.join()
    wait_until(
        lambda: receive.getRuntimeState() == RuntimeState.STOPPED, "the watchdog"
    )
    assert "watchdog" in lab.stop_reason
    wait_until(lambda: at_rest(receive), "the arm to rest")
    assert receive.getSafetyMode() == SafetyMode.NORMAL
    # Another client finds all in order.
    with closing(Control()) as control:
        servo_to(control.interface, receive, START)


def test_protective_stop_and_recovery(lab, control, receive, dashboard):
    servo_to(control, receive, START + 0.05)
    lab("controller", "protective_stop", "a test")
    wait_until(receive.isProtectiveStopped, "the stop to be seen")
    assert receive.getSafetyMode() == SafetyMode.PROTECTIVE_STOP
    wait_until(lambda: not servo(control, START), "commands to be refused")
    wait_until(lambda: at_rest(receive), "the arm to rest")
    assert dashboard.safetymode() == "Safetymode: PROTECTIVE_STOP"
    assert not dashboard.running()

    def unlocked():
        with suppress(RuntimeError):
            dashboard.unlockProtectiveStop()
            return True
        return False

    with pytest.raises(RuntimeError, match="5s after"):
        dashboard.unlockProtectiveStop()
    wait_until(unlocked, "the stop to be unlocked")
    wait_until(lambda: not receive.isProtectiveStopped(), "that to be seen")
    assert control.reuploadScript()
    wait_until(control.isProgramRunning, "the program")
    servo_to(control, receive, START)


def test_wild_command(lab, control, receive):
    q = START.copy()
    q[0] = math.nan
    assert servo(control, q)
    wait_until(receive.isProtectiveStopped, "a protective stop")
    assert "finite" in lab.stop_reason
    assert np.isfinite(receive.getActualQ()).all()


def test_emergency_stop(lab, control, receive, dashboard):
    servo_to(control, receive, START + 0.05)
    lab("controller", "emergency_stop")
    wait_until(receive.isEmergencyStopped, "the stop to be seen")
    assert receive.getRobotMode() == RobotMode.POWER_OFF
    assert dashboard.robotmode() == "Robotmode: POWER_OFF"
    lab("controller", "release_emergency_stop")
    dashboard.closeSafetyPopup()
    dashboard.powerOn()
    assert dashboard.robotmode() == "Robotmode: IDLE"
    dashboard.brakeRelease()
    assert dashboard.robotmode() == "Robotmode: RUNNING"
    assert dashboard.safetystatus() == "Safetystatus: NORMAL"


def test_reconnects(lab, receive):
    lab("rtde", "drop_connections")
    wait_until(lambda: not receive.isConnected(), "the loss to be noticed")
    assert receive.reconnect()
    before = receive.getTimestamp()
    wait_until(lambda: receive.getTimestamp() > before, "new values")


@pytest.mark.parametrize("fault", [Stream.SILENT, Stream.REPEATING])
def test_frozen_stream(lab, receive, fault):
    lab("rtde", "set", "stream", fault)
    # What is on the way arrives.
    time.sleep(0.2)
    before = receive.getTimestamp()
    time.sleep(0.2)
    assert receive.getTimestamp() == before
    lab("rtde", "set", "stream", Stream.LIVE)
    wait_until(lambda: receive.getTimestamp() > before, "new values")


def test_dashboard(lab, dashboard):
    assert dashboard.robotmode() == "Robotmode: RUNNING"
    assert dashboard.safetymode() == "Safetymode: NORMAL"
    assert dashboard.polyscopeVersion().startswith("3.15.")
    assert dashboard.getRobotModel() == "UR5"
    assert not dashboard.running()
    with pytest.raises(RuntimeError, match="Failed to execute"):
        dashboard.play()
    lab("controller", "start_program")
    assert dashboard.running()
    dashboard.pause()
    assert dashboard.programState().startswith("PAUSED")
    dashboard.play()
    dashboard.stop()
    assert not dashboard.running()
    assert "dashboard" in lab.stop_reason
    dashboard.powerOff()
    assert dashboard.robotmode() == "Robotmode: POWER_OFF"
    dashboard.restartSafety()
    dashboard.quit()


def send_nonsense(port, data):
    """Whatever becomes of it, then goes away without a word."""
    with socket.create_connection((HOST, port)) as client:
        client.sendall(data)
        client.settimeout(0.05)
        with suppress(OSError):
            client.recv(1000)
        # Closing resets the connection.
        option = struct.pack("ii", 1, 0)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option)


def test_nonsense_hurts_nobody_else(lab, control, receive, dashboard):
    generator = random.Random(1)
    for data in (
        b"",
        b"\x00",
        b"\x00\x00\x00",
        b"\x00\x02V",
        b"\xff\xffU" + bytes(100),
        generator.randbytes(20000),
        package("V") + package("v") + package("?", bytes(10)),
        package("O", b"abc"),
        package("O", struct.pack(">d", math.nan) + b"\xff,,timestamp"),
        package("S") + package("P") + package("M", b"\xff"),
        package("U") + package("U", b"\x07" + bytes(12)),
        package("I", b"input_double_register_30") + package("U", b"\x01" + bytes(3)),
        package("I", b"input_double_register_30") * 300,
        package("O", struct.pack(">d", 125.0) + b"timestamp") + package("S"),
    ):
        send_nonsense(RTDE_PORT, data)
    send_nonsense(SCRIPT_PORT, b"end\n" + generator.randbytes(20000))
    send_nonsense(SCRIPT_PORT, b"def program_without_end():\n" + b" sync()\n" * 300000)
    send_nonsense(DASHBOARD_PORT, generator.randbytes(200000))
    assert receive.isConnected()
    assert control.isConnected()
    before = receive.getTimestamp()
    wait_until(lambda: receive.getTimestamp() > before, "new values")
    servo_to(control, receive, START + 0.05)
    assert dashboard.running()
