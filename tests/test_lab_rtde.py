"""Tests of rhp_drake.lab's servers, with ur_rtde as the client and without."""

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
from robot_process import PATIENCE, START, running_robot, wait_until

from rhp_drake.errors import InputError
from rhp_drake.lab.controller import Controller
from rhp_drake.lab.dashboard_server import DASHBOARD_PORT
from rhp_drake.lab.modes import RobotMode, RuntimeState, SafetyMode
from rhp_drake.lab.rtde_packets import INPUT_TYPES, OUTPUT_TYPES, Recipe
from rhp_drake.lab.rtde_server import RTDE_PORT, SCRIPT_PORT, RtdeServer, Stream
from rhp_drake.station.ports import COMMAND_PERIOD

# Of this module alone: the robot's ports are fixed.
LAB_HOST = "127.0.0.21"
RAW_HOST = "127.0.0.22"
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
    with running_robot(LAB_HOST) as lab:
        yield lab


@pytest.fixture
def lab(lab_process):
    """The lab, its robot ready and at `START`, more or less, its stream in order."""
    lab_process("rtde", "set", "stream", Stream.LIVE)
    lab_process("controller", "reboot")
    lab_process("controller", "release_brakes")
    return lab_process


@pytest.fixture(scope="module")
def receiver(lab_process):
    rtde_receive = pytest.importorskip("rtde_receive")
    receiver = rtde_receive.RTDEReceiveInterface(LAB_HOST, -1.0, VARIABLES)
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
        self.interface = rtde_control.RTDEControlInterface(LAB_HOST)

    def close(self):
        self.interface.disconnect()


@pytest.fixture
def control(lab, receive):
    with closing(Control()) as control:
        yield control.interface


@pytest.fixture
def dashboard(lab):
    dashboard_client = pytest.importorskip("dashboard_client")
    dashboard = dashboard_client.DashboardClient(LAB_HOST)
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
    receive = rtde_receive.RTDEReceiveInterface(LAB_HOST)
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
        target=servo_for_ever, args=(LAB_HOST, other), daemon=True
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
    with socket.create_connection((LAB_HOST, port)) as client:
        client.sendall(data)
        client.settimeout(0.05)
        with suppress(OSError):
            client.recv(1000)
        # Closing resets the connection.
        option = struct.pack("ii", 1, 0)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option)


def package(kind, payload=b""):
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


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


# What follows needs no ur_rtde.


class RawClient:
    """Speaks RTDE, package by package."""

    def __init__(self):
        self.socket = socket.create_connection((RAW_HOST, RTDE_PORT), PATIENCE)
        self.file = self.socket.makefile("rb")

    def receive(self):
        size, kind = struct.unpack(">HB", self.file.read(3))
        return chr(kind), self.file.read(size - 3)

    def ask(self, kind, payload=b""):
        self.socket.sendall(package(kind, payload))
        answered, answer = self.receive()
        assert answered == kind
        return answer

    def start(self, names, frequency=125.0):
        """Asks for variables; their types."""
        answer = self.ask("O", struct.pack(">d", frequency) + ",".join(names).encode())
        assert answer[0] == 1
        assert self.ask("S") == b"\x01"
        return answer[1:].decode()

    def close(self):
        self.file.close()
        self.socket.close()


@pytest.fixture
def controller():
    return Controller(START)


@pytest.fixture
def server(controller):
    with closing(RtdeServer(controller, RAW_HOST)) as server:
        yield server


@pytest.fixture
def client(server):
    with closing(RawClient()) as client:
        yield client


def test_setup(client):
    assert client.ask("V", b"\x00\x02") == b"\x01"
    assert client.ask("V", b"\x00\x01") == b"\x00"
    assert struct.unpack(">4I", client.ask("v"))[:2] == (3, 15)
    # Nothing is asked for yet.
    assert client.ask("S") == b"\x00"
    answer = client.ask("O", struct.pack(">d", 125.0) + b"timestamp,nonsense")
    assert answer == b"\x00DOUBLE,NOT_FOUND"
    assert client.start(["actual_q", "runtime_state"]) == "VECTOR6D,UINT32"
    assert client.ask("P") == b"\x01"


def test_frames(server, controller, client):
    client.start(["timestamp", "actual_q", "robot_mode"])
    for i in range(3):
        controller.tick(float(i), START + 0.01 * i, np.zeros(6))
        server.publish()
        kind, payload = client.receive()
        assert kind == "U"
        recipe_id, stamp, *q, robot_mode = struct.unpack(">B7di", payload)
        assert (recipe_id, stamp, robot_mode) == (1, i, RobotMode.RUNNING)
        np.testing.assert_array_equal(q, START + 0.01 * i)


def test_frames_at_a_lower_rate(server, controller, client):
    client.start(["timestamp"], frequency=25.0)
    for i in range(1, 11):
        controller.tick(float(i), START, np.zeros(6))
        server.publish()
    stamps = [struct.unpack(">Bd", client.receive()[1])[1] for _ in range(2)]
    assert stamps == [5.0, 10.0]


def test_frames_late(server, controller, client):
    client.start(["timestamp"])
    server.delay, server.jitter = 0.1, 0.1
    began = time.monotonic()
    for i in range(20):
        controller.tick(float(i), START, np.zeros(6))
        server.publish()
    stamps = []
    for _ in range(20):
        stamps.append(struct.unpack(">Bd", client.receive()[1])[1])
        assert time.monotonic() - began >= 0.1
    assert stamps == sorted(stamps)


def test_corrupt_frames_are_well_formed(server, controller, client):
    client.start(["timestamp", "actual_q"])
    server.stream = Stream.CORRUPT
    controller.tick(1.0, START, np.zeros(6))
    server.publish()
    kind, payload = client.receive()
    assert (kind, payload[0], len(payload)) == ("U", 1, 57)
    assert struct.unpack(">B7d", payload)[1:] != (1.0, *START)


def test_inputs_belong_to_one_client(server, client):
    names = b"input_int_register_0,input_double_register_0"
    assert client.ask("I", names) == b"\x01INT32,DOUBLE"
    # More than one recipe of a client may have them.
    assert client.ask("I", b"input_int_register_0,") == b"\x02INT32"
    with closing(RawClient()) as other:
        assert other.ask("I", names) == b"\x00IN_USE,IN_USE"
        client.close()
        wait_until(lambda: other.ask("I", names)[0] == 1, "the inputs to be free")


def test_program_in_pieces(server, controller):
    with socket.create_connection((RAW_HOST, SCRIPT_PORT), PATIENCE) as client:
        for piece in (
            b"textmsg(1)\nde",
            b"f program():\n  if True:\n    ",
            b"sync()\n",
        ):
            client.sendall(piece)
            time.sleep(0.05)
        client.sendall(b"  end\ne")
        time.sleep(0.05)
        assert controller.runtime_state == RuntimeState.STOPPED
        client.sendall(b"nd\n")
        wait_until(
            lambda: controller.runtime_state == RuntimeState.PLAYING, "the program"
        )


def test_clients_that_do_not_read(server, controller, client):
    client.start(["actual_q"] * 200)
    with closing(RawClient()) as other:
        other.start(["timestamp"])
        # More than any buffer of the system takes.
        for i in range(2000):
            controller.tick(float(i), START, np.zeros(6))
            server.publish()
            assert struct.unpack(">Bd", other.receive()[1])[1] == i


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.2", "localhost", ""])
def test_listens_on_loopback_only(controller, host):
    with pytest.raises(InputError, match="127"):
        RtdeServer(controller, host)


def test_taken_ports(server, controller):
    with pytest.raises(InputError, match="cannot listen"):
        RtdeServer(controller, RAW_HOST)


def test_ports_are_free_after_closing(controller):
    for _ in range(2):
        server = RtdeServer(controller, RAW_HOST)
        with closing(RawClient()) as client:
            client.start(["timestamp"])
            server.close()
            assert client.file.read() == b""
        server.close()
        server.publish()


def test_recipes_keep_values():
    names = ("robot_mode", "actual_q", "payload_cog", "joint_mode")
    recipe = Recipe(names, OUTPUT_TYPES, 7)
    values = {
        "robot_mode": -1,
        "actual_q": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        "joint_mode": (1, 2, 3, 4, 5, 6),
    }
    unpacked = recipe.unpack(recipe.pack(values))
    assert unpacked == values | {"payload_cog": (0.0, 0.0, 0.0)}


def test_what_the_controller_tells_has_a_type(controller):
    assert controller.start_program()
    assert controller.outputs().keys() <= OUTPUT_TYPES.keys()
    assert {"input_int_register_0", "input_double_register_10"} <= INPUT_TYPES.keys()
