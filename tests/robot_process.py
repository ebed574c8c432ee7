"""A virtual robot with an ideal arm, in a process of its own."""

from contextlib import contextmanager
import itertools
import multiprocessing
import time

import numpy as np

from rhp_drake.lab.controller import Controller
from rhp_drake.lab.dashboard_server import DashboardServer
from rhp_drake.lab.rtde_server import RtdeServer, Stream
from rhp_drake.random_streams import stream
from rhp_drake.station.ports import COMMAND_PERIOD

START = np.array([0.1, -1.2, 1.5, -1.9, -1.57, 0.3])
PATIENCE = 30.0  # s.  The machine may have other things to do.


def wait_until(condition, what):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for: {what}"
        time.sleep(0.01)


def run_lab(host, pipe):
    """A robot with an ideal arm, in a process of its own; takes orders by the pipe.

    ur_rtde's constructors hold the interpreter's lock until the robot has answered.
    """
    controller = Controller(START)
    rtde = RtdeServer(controller, host, stream(0, "robot_process"))
    dashboard = DashboardServer(controller, host)
    machines = {"controller": controller, "rtde": rtde, "dashboard": dashboard}
    pipe.send(None)
    # A robot that a busy machine leaves no time does not think that others are late.
    ticks = itertools.count()
    q, qd = START, np.zeros(6)
    try:
        while True:
            while pipe.poll():
                machine, name, arguments = pipe.recv()
                if name == "set":
                    pipe.send(setattr(machines[machine], *arguments))
                else:
                    value = getattr(machines[machine], name)
                    pipe.send(value(*arguments) if callable(value) else value)
            position = controller.tick(next(ticks) * COMMAND_PERIOD, q, qd)
            q, qd = position, (position - q) / COMMAND_PERIOD
            rtde.publish()
            time.sleep(COMMAND_PERIOD)
    except EOFError:  # The test is gone.
        rtde.close()
        dashboard.close()


class Lab:
    """The other end of `run_lab`'s pipe."""

    def __init__(self, pipe):
        self.pipe = pipe

    def __call__(self, machine, name, *arguments):
        self.pipe.send((machine, name, arguments))
        assert self.pipe.poll(PATIENCE), "the lab does not answer"
        return self.pipe.recv()

    @property
    def stop_reason(self):
        return self("controller", "stop_reason")


@contextmanager
def running_robot(host):
    """Runs it at a loopback address, and yields its `Lab`."""
    pipe, other = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=run_lab, args=(host, other), daemon=True
    )
    process.start()
    other.close()
    assert pipe.poll(PATIENCE), "the lab does not start"
    pipe.recv()
    yield Lab(pipe)
    pipe.close()
    process.join(PATIENCE)
    assert process.exitcode == 0


def make_ready(lab):
    """The robot powered and near `START`, its stream in order, nothing running."""
    lab("rtde", "set", "stream", Stream.LIVE)
    lab("controller", "reboot")
    lab("controller", "release_brakes")
    lab.since = lab("controller", "outputs")["timestamp"]
    return lab
