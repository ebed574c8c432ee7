"""The virtual robot's RTDE server, package by package."""

from contextlib import closing
import socket
import struct
import time

import numpy as np
import pytest
from robot_process import PATIENCE, START, wait_until
from rtde_client import RawClient

from rhp_drake.errors import InputError
from rhp_drake.lab.controller import Controller
from rhp_drake.lab.modes import RobotMode, RuntimeState
from rhp_drake.lab.rtde_packets import INPUT_TYPES, OUTPUT_TYPES, Recipe
from rhp_drake.lab.rtde_server import SCRIPT_PORT, RtdeServer, Stream
from rhp_drake.random_streams import stream

HOST = "127.0.0.22"  # Of this module alone: the robot's ports are fixed.


@pytest.fixture
def controller():
    return Controller(START)


@pytest.fixture
def server(controller):
    with closing(RtdeServer(controller, HOST, stream(0, "rtde"))) as server:
        yield server


@pytest.fixture
def client(server):
    with closing(RawClient(HOST)) as client:
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
    with closing(RawClient(HOST)) as other:
        assert other.ask("I", names) == b"\x00IN_USE,IN_USE"
        client.close()
        wait_until(lambda: other.ask("I", names)[0] == 1, "the inputs to be free")


def test_program_in_pieces(server, controller):
    with socket.create_connection((HOST, SCRIPT_PORT), PATIENCE) as client:
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
    with closing(RawClient(HOST)) as other:
        other.start(["timestamp"])
        # More than any buffer of the system takes.
        for i in range(2000):
            controller.tick(float(i), START, np.zeros(6))
            server.publish()
            assert struct.unpack(">Bd", other.receive()[1])[1] == i


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.2", "localhost", ""])
def test_listens_on_loopback_only(controller, host):
    with pytest.raises(InputError, match="127"):
        RtdeServer(controller, host, stream(0, "rtde"))


def test_taken_ports(server, controller):
    with pytest.raises(InputError, match="cannot listen"):
        RtdeServer(controller, HOST, stream(0, "rtde"))


def test_ports_are_free_after_closing(controller):
    for _ in range(2):
        server = RtdeServer(controller, HOST, stream(0, "rtde"))
        with closing(RawClient(HOST)) as client:
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
