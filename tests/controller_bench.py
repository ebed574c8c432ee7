"""A virtual robot's controller with an ideal arm, one tick at a time."""

import numpy as np

from rhp_drake.lab.controller import (
    STOP_PERIODS,
    Controller,
)
from rhp_drake.station.ports import COMMAND_PERIOD

START = np.array([0.1, -1.2, 1.5, -1.9, -1.57, 0.3])
# Commands of ur_rtde's script.
MOVE_J, SPEED_J, SERVO_J, SPEED_STOP, SERVO_STOP = 1, 9, 11, 15, 16
MOVE_L, GET_STEP_TIME, PROTECTIVE_STOP, STOP_J, SET_WATCHDOG = 3, 26, 31, 34, 35
STOP_SCRIPT = 255
READY, DONE = 1, 2


class Bench:
    """A controller with an ideal arm, whose program runs, one tick at a time."""

    def __init__(self, start=START):
        self.controller = Controller(start)
        self.ticks = 0
        self.positions = [np.array(start)]
        assert self.controller.start_program()
        self.tick()

    def tick(self, number=1, kick=False):
        """The last position commanded; `kick` the watchdog at each tick."""
        for _ in range(number):
            if kick:
                self.send(0)
            self.ticks += 1
            q = self.positions[-1]
            qd = (q - self.positions[-2]) / COMMAND_PERIOD if self.ticks > 1 else 0 * q
            time = self.ticks * COMMAND_PERIOD
            self.positions.append(self.controller.tick(time, q, qd))
        return self.positions[-1]

    def send(self, number, *reals, alone=0):
        """Writes a command and its arguments."""
        values = {f"input_double_register_{i}": x for i, x in enumerate(reals)}
        self.controller.write_inputs(
            {"input_int_register_0": number, "input_int_register_1": alone, **values}
        )

    def servo(self, q, lookahead_time=0.1):
        self.send(SERVO_J, *q, 0, 0, COMMAND_PERIOD, lookahead_time, 300)
        return self.tick()

    def run(self, number, *reals, limit=1000):
        """A command that the client waits for; the number of ticks it took."""
        assert self.state == READY
        self.send(number, *reals)
        for i in range(limit):
            self.tick()
            if self.state == DONE:
                self.send(0)
                self.tick()
                return i + 1
        raise AssertionError("never done")

    @property
    def state(self):
        return self.controller.outputs()["output_int_register_0"]

    @property
    def speeds(self):
        """Of the joint that is fastest, by tick, rad/s."""
        return np.abs(np.diff(self.positions, axis=0)).max(axis=1) / COMMAND_PERIOD

    def move_along(self, speed=1.0, ticks=50):
        """Servos along a ramp of the first joint."""
        q = self.positions[-1].copy()
        for _ in range(ticks):
            q[0] += speed * COMMAND_PERIOD
            self.servo(q)
        return q


def assert_rests_soon(bench):
    """At rest within the time of a stop, and for good."""
    bench.tick(STOP_PERIODS)
    np.testing.assert_array_equal(bench.tick(50), bench.positions[-51])
    assert np.isfinite(bench.positions).all()
