"""Tests of rhp_drake.drivers.natnet_driver and rhp_drake.lab.natnet_server."""

import math
import multiprocessing
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw
import pytest

from rhp_drake.drivers.natnet_config import NatNetConfig, PoseConfig
from rhp_drake.drivers.natnet_driver import NatNetDriver
from rhp_drake.errors import InputError, WorkError
from rhp_drake.lab import natnet_server
from rhp_drake.lab.natnet_server import Freeze, NatNetServer
from rhp_drake.random_streams import stream

pytest.importorskip("natnet")

PATIENCE = 60  # s: a busy machine may take long, but not for ever.
TARGET, OBSTACLE = "target box", "obstacle"
X_TARGET = RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), [1.0, 2.0, 3.0])
X_OBSTACLE = RigidTransform([-0.5, 0.25, 0.125])
# In another order than the task's.
BODIES = [(OBSTACLE, X_OBSTACLE), (TARGET, X_TARGET)]


def make_server(port=0):
    return NatNetServer(stream(0, "natnet"), command_port=port)


@pytest.fixture
def server():
    server = make_server()
    server.set_bodies(BODIES)
    server.start()
    yield server
    server.stop()


def make_driver(server, **kwargs):
    config = NatNetConfig(command_port=server.command_port, bodies=[TARGET, OBSTACLE])
    for name, value in kwargs.items():
        setattr(config, name, value)
    return NatNetDriver(config)


@pytest.fixture(scope="module")
def lasting_pair():
    server = make_server()
    server.set_bodies(BODIES)
    server.start()
    driver = make_driver(server)
    driver.start()
    yield server, driver
    driver.stop()
    server.stop()


@pytest.fixture
def pair(lasting_pair):
    """A server and a driver that may have served another test, and are in order."""
    server, driver = lasting_pair
    server.set_bodies(BODIES)
    wait_for(lambda: is_at(driver.read()[0], X_TARGET))
    wait_for(lambda: is_tracked(driver))
    return server, driver


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def is_at(pose, X_WB):
    # The stream has float32.
    return pose.X_WB.IsNearlyEqualTo(X_WB, 1e-6)


def is_tracked(driver):
    """Whether the target was in the last frame that the obstacle was in."""
    target, obstacle = driver.read()
    return target.age == obstacle.age


def wait_for_frames(driver, count=5):
    """Waits until so many frames have come in which the obstacle was tracked."""
    for _ in range(count):
        start = time.monotonic()
        wait_for(lambda start=start: time.monotonic() - start > driver.read()[1].age)


def test_poses_come_in_the_tasks_order(pair):
    _, driver = pair
    target, obstacle = driver.read()
    assert is_at(target, X_TARGET)
    assert is_at(obstacle, X_OBSTACLE)
    assert 0 <= target.age < PATIENCE


def test_both_calibrations(server):
    # O is turned by a quarter about z; R stands on the box's face, 3 cm up, and is
    # rolled by half a turn.
    driver = make_driver(
        server,
        X_WO=PoseConfig(xyz=[0.5, -0.1, 0.2], rpy_deg=[0.0, 0.0, 90.0]),
        X_RB={TARGET: PoseConfig(xyz=[0.0, 0.0, 0.03], rpy_deg=[180.0, 0.0, 0.0])},
    )
    server.set_bodies(
        [
            (TARGET, RigidTransform(RollPitchYaw(math.pi, 0, 0), [0.3, 0.4, 0.06])),
            (OBSTACLE, RigidTransform(RollPitchYaw(0, 0, 0.5), [0.1, 0.0, 0.0])),
        ]
    )
    driver.start()
    try:
        wait_for(lambda: all(math.isfinite(pose.age) for pose in driver.read()))
        target, obstacle = driver.read()
    finally:
        driver.stop()
    # R's z points down, so the box's centre is at z = 0.06 - 0.03 in O.
    quarter = RollPitchYaw(0, 0, math.pi / 2)
    assert is_at(target, RigidTransform(quarter, [0.5 - 0.4, -0.1 + 0.3, 0.2 + 0.03]))
    turned = RollPitchYaw(0, 0, math.pi / 2 + 0.5)
    assert is_at(obstacle, RigidTransform(turned, [0.5, -0.1 + 0.1, 0.2]))


def test_follows_movement(pair):
    server, driver = pair
    for x in np.linspace(0.0, 0.1, 3):
        X = RigidTransform([x, 0.0, 0.0])
        server.set_bodies([(TARGET, X), (OBSTACLE, X_OBSTACLE)])
        wait_for(lambda X=X: is_at(driver.read()[0], X))


@pytest.mark.parametrize("freeze", [Freeze.REPEAT, Freeze.SILENT])
def test_age_grows_while_the_stream_is_frozen(pair, freeze):
    server, driver = pair
    server.freeze = freeze
    # Longer than it takes to connect anew.
    wait_for(lambda: driver.read()[0].age > 2.5)
    target, obstacle = driver.read()
    assert obstacle.age > 2.5
    assert is_at(target, X_TARGET)
    server.freeze = Freeze.NONE
    wait_for(lambda: driver.read()[0].age < 0.5)


@pytest.mark.parametrize("zero", [False, True])
def test_an_occluded_body_keeps_its_pose(pair, zero):
    server, driver = pair
    server.occlude(TARGET, zero=zero)
    wait_for(lambda: not is_tracked(driver))
    wait_for_frames(driver)
    target, obstacle = driver.read()
    assert target.age > obstacle.age
    assert is_at(target, X_TARGET)
    server.reveal(TARGET)
    wait_for(lambda: is_tracked(driver))


def test_a_body_that_is_not_in_the_frames(pair):
    server, driver = pair
    server.set_bodies([(OBSTACLE, X_OBSTACLE)])
    wait_for(lambda: not is_tracked(driver))
    # Also once the definitions lack it.
    time.sleep(1.5)
    wait_for_frames(driver)
    target, obstacle = driver.read()
    assert target.age > obstacle.age + 1.0


def test_swapped_bodies(pair):
    server, driver = pair
    server.swap(TARGET, OBSTACLE)
    wait_for(lambda: is_at(driver.read()[0], X_OBSTACLE))
    assert is_at(driver.read()[1], X_TARGET)
    server.swap(TARGET, OBSTACLE)
    wait_for(lambda: is_at(driver.read()[0], X_TARGET))


@pytest.mark.parametrize("number", [math.nan, math.inf, 0.0, 1.0])
def test_numbers_that_are_no_pose(pair, number):
    server, driver = pair
    server.overwritten[TARGET] = number
    wait_for(lambda: not is_tracked(driver))
    wait_for_frames(driver)
    assert is_at(driver.read()[0], X_TARGET)
    server.overwritten.clear()
    wait_for(lambda: is_tracked(driver))


def test_a_position_that_is_not_finite(pair):
    server, driver = pair
    server.set_bodies([(TARGET, RigidTransform([0.0, math.nan, 0.0])), BODIES[0]])
    wait_for(lambda: not is_tracked(driver))
    assert is_at(driver.read()[0], X_TARGET)


def test_malformed_datagrams(pair):
    server, driver = pair
    server.malformed_share = 0.5
    wait_for(lambda: driver.num_malformed > 20)
    wait_for_frames(driver)
    server.malformed_share = 1.0
    malformed = driver.num_malformed
    # They are no frames: the age grows.
    wait_for(lambda: driver.num_malformed > malformed + 20)
    wait_for(lambda: driver.read()[0].age > 0.5)
    server.malformed_share = 0.0
    wait_for_frames(driver)
    assert is_at(driver.read()[0], X_TARGET)
    assert is_at(driver.read()[1], X_OBSTACLE)


def test_the_first_malformed_datagram_is_told_of(server, capfd):
    driver = make_driver(server)
    driver.start()
    server.malformed_share = 0.5
    wait_for(lambda: driver.num_malformed > 5)
    driver.stop()
    assert capfd.readouterr().err.count("a datagram of Motive's is dropped: ") == 1


def test_lost_and_late_frames(pair):
    server, driver = pair
    server.drop_share, server.delay, server.jitter = 0.5, 0.05, 0.05
    sent, seen = [1.0], []

    def enough():
        sent.append(sent[-1] + 0.001)
        server.set_bodies([(TARGET, RigidTransform([sent[-1], 0, 0])), BODIES[0]])
        seen.append(driver.read()[0].X_WB.translation()[0])
        return len(set(seen)) > 20

    wait_for(enough)
    # One that was overtaken is not taken.
    assert seen == sorted(seen)
    server.drop_share = server.delay = server.jitter = 0.0


def test_lives_on_when_the_server_is_started_anew(server):
    driver = make_driver(server)
    driver.start()
    wait_for(lambda: math.isfinite(driver.read()[0].age))
    server.stop()
    wait_for(lambda: driver.read()[0].age > 1.5)
    # Its ids are others.
    other = make_server(server.command_port)
    X = RigidTransform([7.0, 8.0, 9.0])
    other.set_bodies([("new", X), (TARGET, X), (OBSTACLE, X_OBSTACLE)])
    other.start()
    try:
        wait_for(lambda: is_at(driver.read()[0], X))
        wait_for(lambda: is_at(driver.read()[1], X_OBSTACLE))
    finally:
        other.stop()
        driver.stop()


def test_starts_again(server):
    driver = make_driver(server)
    driver.start()
    wait_for(lambda: math.isfinite(driver.read()[0].age))
    with pytest.raises(RuntimeError, match="is running"):
        driver.start()
    driver.stop()
    driver.stop()
    assert is_at(driver.read()[0], X_TARGET)
    driver.start()
    wait_for_frames(driver)
    driver.stop()


def test_before_the_start(server):
    driver = make_driver(server)
    for pose in driver.read():
        assert pose.age == math.inf
        assert np.isnan(pose.X_WB.translation()).all()
    assert driver.num_malformed == 0
    driver.stop()


def test_unknown_body(server):
    driver = make_driver(server, bodies=[TARGET, "red box"])
    others = multiprocessing.active_children()
    with pytest.raises(InputError) as error:
        driver.start()
    assert str(error.value) == (
        "Motive has no rigid body 'red box'; it has 'obstacle', 'target box'."
    )
    assert multiprocessing.active_children() == others


def test_nobody_answers(server):
    server.stop()
    driver = make_driver(server)
    others = multiprocessing.active_children()
    with pytest.raises(WorkError, match=r"no NatNet server at .*: nobody answers\."):
        driver.start()
    assert multiprocessing.active_children() == others


def test_an_address_that_is_not_ours(server):
    # One of TEST-NET-1.
    driver = make_driver(server, local_address="192.0.2.1")
    with pytest.raises(WorkError, match=r"server at .*, from 192\.0\.2\.1: .*assign"):
        driver.start()


def test_names_that_cannot_be_read(server, monkeypatch):
    definitions = natnet_server._definitions
    monkeypatch.setattr(natnet_server, "_definitions", lambda ids: definitions(ids)[:9])
    driver = make_driver(server)
    others = multiprocessing.active_children()
    with pytest.raises(WorkError, match="it sends frames, but no names that can be re"):
        driver.start()
    assert multiprocessing.active_children() == others


def test_a_taken_port(server):
    with pytest.raises(InputError, match="no NatNet server can be at"):
        make_server(server.command_port)


def test_ends_with_the_object(server):
    driver = make_driver(server)
    others = multiprocessing.active_children()
    driver.start()
    assert len(multiprocessing.active_children()) == len(others) + 1
    del driver
    assert multiprocessing.active_children() == others


PARENT = """
import multiprocessing, os, signal, sys
from rhp_drake.drivers.natnet_config import NatNetConfig
from rhp_drake.drivers.natnet_driver import NatNetDriver

if __name__ == "__main__":
    port, body = int(sys.argv[1]), sys.argv[2]
    driver = NatNetDriver(NatNetConfig(command_port=port, bodies=[body]))
    driver.start()
    print(multiprocessing.active_children()[0].pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def is_running(pid):
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    # Nobody may have buried it.
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_dies_with_its_parent(server, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    command = [sys.executable, script, str(server.command_port), TARGET]
    parent = subprocess.run(
        command, stdout=subprocess.PIPE, text=True, timeout=PATIENCE, check=False
    )
    assert parent.returncode == -signal.SIGKILL
    wait_for(lambda: not is_running(int(parent.stdout)))


def test_config_loads_from_yaml():
    config = yaml_load_typed(
        schema=NatNetConfig,
        data="""
            server_address: 192.168.1.10
            bodies: [a, b]
            X_WO: {rpy_deg: [0, 0, 90]}
            X_RB: {b: {xyz: [0, 0, -0.03]}}
        """,
        defaults=NatNetConfig(),
    )
    assert config == NatNetConfig(
        server_address="192.168.1.10",
        bodies=["a", "b"],
        X_WO=PoseConfig(rpy_deg=[0.0, 0.0, 90.0]),
        X_RB={"b": PoseConfig(xyz=[0.0, 0.0, -0.03])},
    )


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (NatNetConfig(), "natnet.bodies must name different"),
        (NatNetConfig(bodies=["a", "a"]), "natnet.bodies must name different"),
        (NatNetConfig(bodies=["a"], X_RB={"b": PoseConfig()}), "natnet.X_RB has"),
        (
            NatNetConfig(bodies=["a"], X_WO=PoseConfig(xyz=[0.0])),
            "natnet.X_WO: a pose is three finite numbers",
        ),
        (
            NatNetConfig(bodies=["a"], X_RB={"a": PoseConfig(xyz=[0, 0, math.nan])}),
            "natnet.X_RB.a: a pose is three finite numbers",
        ),
    ],
)
def test_bad_config(config, message):
    with pytest.raises(InputError, match=message):
        NatNetDriver(config)
