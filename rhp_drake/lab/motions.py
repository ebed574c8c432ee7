"""The motions a robot controller makes of URScript's commands, one period at a time.

All are motions of the six joints: positions and velocities have shape (6,), rad and
rad/s, and are those that the controller commands, not those that it measures.
"""

import math
from typing import Final, Protocol

import numpy as np

from rhp_drake.station.ur5_kinematics import forward_kinematics

# Position and velocity of the joints, shape (6,) each.
State = tuple[np.ndarray, np.ndarray]

# URScript manual: servoj takes lookahead times from 0.03 s on.
_SHORTEST_LOOKAHEAD: Final = 0.03
# m/s, rad/s: a hand this slow is at rest.
_SLOW: Final = 1e-9


class Motion(Protocol):
    """Where the joints are to go."""

    @property
    def done(self) -> bool:
        """Whether the motion has come to its end; some never do."""

    def step(self, position: np.ndarray, velocity: np.ndarray, period: float) -> State:
        """The state `period` seconds on."""


class Servo:
    """`servoj`: follows a target that may be replaced at any time.

    What a real controller does here is not published.  This is a critically damped
    second-order filter, which lags a moving target by the lookahead time; like the
    real one it goes on to its last target if no new one comes.

    Args:
        target: Position to reach.
        lookahead_time: s.
    """

    done = False

    def __init__(self, target: np.ndarray, lookahead_time: float) -> None:
        self.target = target
        # The lag behind a ramp is 2 / frequency.
        self._frequency = 2 / max(lookahead_time, _SHORTEST_LOOKAHEAD)

    def step(self, position: np.ndarray, velocity: np.ndarray, period: float) -> State:
        """The filter's exact solution."""
        w = self._frequency
        error = position - self.target
        slope = velocity + w * error
        decay = math.exp(-w * period)
        return (
            self.target + (error + slope * period) * decay,
            (velocity - w * slope * period) * decay,
        )


class Speed:
    """`speedj`: reaches a velocity and keeps it.

    Args:
        target: Velocity to reach.
        acceleration: Of the joint that changes most, rad/s^2.
    """

    done = False

    def __init__(self, target: np.ndarray, acceleration: float) -> None:
        self._target = target
        self._acceleration = acceleration

    def step(self, position: np.ndarray, velocity: np.ndarray, period: float) -> State:
        """As far as the acceleration goes."""
        change = self._target - velocity
        largest = np.abs(change).max()
        allowed = self._acceleration * period
        if largest > allowed:
            change = change * (allowed / largest)
        velocity = velocity + change
        return position + velocity * period, velocity


class Stop:
    """`stopj`: all joints slow down in proportion, and come to rest together.

    Args:
        deceleration: Of the fastest joint, rad/s^2.
    """

    def __init__(self, deceleration: float) -> None:
        self._deceleration = deceleration
        self._rests = False

    @property
    def done(self) -> bool:
        """Whether all joints are at rest."""
        return self._rests

    def step(self, position: np.ndarray, velocity: np.ndarray, period: float) -> State:
        """Slower by what the deceleration allows."""
        fastest = np.abs(velocity).max()
        left = fastest - self._deceleration * period
        # Less than a rounding error is no speed.
        self._rests = left <= 1e-9
        velocity = np.zeros(6) if self._rests else velocity * (left / fastest)
        return position + velocity * period, velocity


class ToolStop:
    """`stopl`: all joints slow down in proportion, in the time that the tool takes.

    Args:
        deceleration: Of the hand, m/s^2, and as much in rad/s^2: URScript's manual has
            the one for the other if that is not given.
    """

    def __init__(self, deceleration: float) -> None:
        self._deceleration = deceleration
        self._stop: Stop | None = None

    @property
    def done(self) -> bool:
        """Whether all joints are at rest."""
        return self._stop is not None and self._stop.done

    def step(self, position: np.ndarray, velocity: np.ndarray, period: float) -> State:
        """Slower by what the tool's deceleration allows."""
        if self._stop is None:
            fastest = np.abs(velocity).max()
            speed = max(_hand_speeds(position, velocity))
            self._stop = Stop(self._deceleration * fastest / max(speed, _SLOW))
        return self._stop.step(position, velocity, period)


def _hand_speeds(position: np.ndarray, velocity: np.ndarray) -> tuple[float, float]:
    """How fast the hand moves, m/s, and turns, rad/s."""
    step = 1e-6  # s
    X_WH = forward_kinematics(position)
    change = forward_kinematics(position + step * velocity) - X_WH
    # Of a small turn's matrix the elements are the angle times sqrt(2), together.
    turn = float(np.linalg.norm(change[:3, :3])) / math.sqrt(2)
    return float(np.linalg.norm(change[:3, 3])) / step, turn / step


class Move:
    """`movej`: a straight line in joint space, its speed a trapezoid over time.

    It starts from rest: joints that still move are stopped first.  The same if
    something else moved them in the meantime, as a pause of the program does.

    Args:
        target: Position to reach.
        speed: Of the joint that has furthest to go, rad/s.
        acceleration: Likewise, rad/s^2.
    """

    def __init__(self, target: np.ndarray, speed: float, acceleration: float) -> None:
        self.target = target
        self._speed = speed
        self._acceleration = acceleration
        self._stop = Stop(acceleration)
        self._start = self._last = np.full(6, np.nan)
        self._time = 0.0
        self._arrived = False

    @property
    def done(self) -> bool:
        """Whether the target is reached."""
        return self._arrived

    def step(self, position: np.ndarray, velocity: np.ndarray, period: float) -> State:
        """Along the line, or to rest."""
        if not np.array_equal(position, self._last):
            if velocity.any():
                return self._stop.step(position, velocity, period)
            self._start, self._time = position, 0.0
        self._time += period
        way = self.target - self._start
        distance = np.abs(way).max()
        travelled = self._travelled(distance)
        self._arrived = bool(travelled >= distance)
        if self._arrived:
            return self.target, np.zeros(6)
        self._last = self._start + way * (travelled / distance)
        return self._last, (self._last - position) / period

    def _travelled(self, distance: float) -> float:
        """How far the leading joint has come, rad."""
        acceleration = self._acceleration
        ramp = min(self._speed / acceleration, math.sqrt(distance / acceleration))
        if ramp == 0:
            return distance
        speed = acceleration * ramp
        end = distance / speed + ramp
        if self._time >= end:
            return distance
        if self._time < ramp:
            return acceleration * self._time**2 / 2
        left = end - self._time
        if left < ramp:
            return distance - acceleration * left**2 / 2
        return speed * (self._time - ramp / 2)
