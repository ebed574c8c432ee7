"""What can go wrong between us and a robot, and what is to be said of it."""

from collections.abc import Callable
from dataclasses import dataclass
import signal
import time
from typing import Final, TypeAlias

import numpy as np

from rhp_drake.benchmarks.lab_process import LabProcess
from rhp_drake.benchmarks.run_process import BadCommand, RunProcess
from rhp_drake.safety import Fault

# Does it; returns when, s of time.monotonic.
_Inject: TypeAlias = Callable[[LabProcess, RunProcess, np.random.Generator], float]

# s: four times as long as the driver waits for a command to an arm that moves.
_STALL: Final = 0.3
_OBJECTS: Final = ("target", "obstacle_1", "obstacle_2")


@dataclass(frozen=True)
class FaultKind:
    """Something that goes wrong.

    Attributes:
        causes: What may be named as its cause; empty if nobody is left to say.
        tolerable: Whether the run may go on.
        inject: Makes it go wrong.
    """

    causes: frozenset[Fault]
    tolerable: bool
    inject: _Inject


def _said(text: str) -> _Inject:
    """By the lab's words, see `lab.faults`; OBJECT and OTHER are drawn."""

    def inject(
        lab: LabProcess, run: RunProcess, generator: np.random.Generator
    ) -> float:
        first, other = generator.choice(_OBJECTS, size=2, replace=False)
        return lab.inject(text.replace("OBJECT", first).replace("OTHER", other))

    return inject


def _drawn(word: str, low: float, high: float) -> _Inject:
    """By a word of the lab's and a number from `low` to `high`."""

    def inject(
        lab: LabProcess, run: RunProcess, generator: np.random.Generator
    ) -> float:
        return lab.inject(f"{word} {generator.uniform(low, high):.4f}")

    return inject


def _signalled(number: int, driver: str | None) -> _Inject:
    """By a signal to a process of ours."""

    def inject(
        lab: LabProcess, run: RunProcess, generator: np.random.Generator
    ) -> float:
        run.send_signal(number, driver)
        return time.monotonic()

    return inject


def _stall(lab: LabProcess, run: RunProcess, generator: np.random.Generator) -> float:
    """The loop is not run for a while; what it says then is waited for."""
    run.send_signal(signal.SIGSTOP)
    begin = time.monotonic()
    time.sleep(_STALL)
    run.send_signal(signal.SIGCONT)
    return begin


def _spoiled(how: BadCommand) -> _Inject:
    """By commands that are wrong behind the guard's back."""

    def inject(
        lab: LabProcess, run: RunProcess, generator: np.random.Generator
    ) -> float:
        run.spoil_commands(how)
        return time.monotonic()

    return inject


def _stops(inject: _Inject, *causes: Fault) -> FaultKind:
    return FaultKind(frozenset(causes), tolerable=False, inject=inject)


def _may_go_on(inject: _Inject, *causes: Fault) -> FaultKind:
    return FaultKind(frozenset(causes), tolerable=True, inject=inject)


FAULT_KINDS: Final = {
    "robot: protective stop": _stops(_said("protective_stop"), Fault.PROTECTIVE_STOP),
    "robot: safeguard stop": _stops(_said("safeguard_stop"), Fault.EMERGENCY_STOP),
    "robot: emergency stop": _stops(_said("emergency_stop"), Fault.EMERGENCY_STOP),
    "robot: reboot": _stops(_said("reboot"), Fault.NOT_RUNNING, Fault.CONNECTION_LOST),
    "robot: connection lost": _stops(_said("drop_connection"), Fault.CONNECTION_LOST),
    "robot: silent": _stops(_said("robot_silent"), Fault.STALE_MEASUREMENT),
    "robot: stream frozen": _stops(_said("robot_repeats"), Fault.STALE_MEASUREMENT),
    "robot: stream of noise": _stops(
        _said("robot_corrupt"), Fault.IMPLAUSIBLE_MEASUREMENT
    ),
    "robot: 0.1 to 1 s late": _stops(
        _drawn("robot_delay", 0.1, 1.0), Fault.STALE_MEASUREMENT
    ),
    "robot: 5 to 30 ms late": _may_go_on(
        _drawn("robot_delay", 0.005, 0.03), Fault.STALE_MEASUREMENT
    ),
    "robot: jitter of 5 to 30 ms": _may_go_on(
        _drawn("robot_jitter", 0.005, 0.03), Fault.STALE_MEASUREMENT
    ),
    "tracker: silent": _stops(_said("tracker_silent"), Fault.STALE_POSE),
    "tracker: stream frozen": _stops(_said("tracker_repeats"), Fault.STALE_POSE),
    "tracker: object occluded": _stops(_said("occlude OBJECT"), Fault.STALE_POSE),
    "tracker: pose of nan": _stops(_said("not_finite OBJECT"), Fault.STALE_POSE),
    "tracker: objects swapped": _stops(_said("swap OBJECT OTHER"), Fault.OBJECT_JUMPED),
    "tracker: 0.1 to 1 s late": _stops(
        _drawn("tracker_delay", 0.1, 1.0), Fault.STALE_POSE
    ),
    "tracker: all malformed": _stops(
        _drawn("tracker_malformed", 1.0, 1.0), Fault.STALE_POSE
    ),
    "tracker: 10 to 30 % malformed": _may_go_on(
        _drawn("tracker_malformed", 0.1, 0.3), Fault.STALE_POSE
    ),
    "tracker: 10 to 30 % lost": _may_go_on(
        _drawn("tracker_drops", 0.1, 0.3), Fault.STALE_POSE
    ),
    "tracker: jitter of 5 to 30 ms": _may_go_on(
        _drawn("tracker_jitter", 0.005, 0.03), Fault.STALE_POSE
    ),
    "ours: commands of nan": _stops(_spoiled(BadCommand.NOT_FINITE), Fault.NOT_FINITE),
    "ours: commands that jump": _stops(_spoiled(BadCommand.JUMP), Fault.VELOCITY_LIMIT),
    "ours: commands out of range": _stops(
        _spoiled(BadCommand.BEYOND_RANGE), Fault.POSITION_LIMIT
    ),
    # At rest it may be late, as a policy that thinks is.
    "ours: loop stalled for 0.3 s": _may_go_on(_stall, Fault.STALE_COMMAND),
    "ours: kill -9, robot's driver": _stops(
        _signalled(signal.SIGKILL, "ur"), Fault.CONNECTION_LOST
    ),
    "ours: kill -9, tracker's driver": _stops(
        _signalled(signal.SIGKILL, "NatNet"), Fault.STALE_POSE
    ),
    "ours: robot's driver stalled": _stops(
        _signalled(signal.SIGSTOP, "ur"), Fault.STALE_MEASUREMENT
    ),
    "ours: tracker's driver stalled": _stops(
        _signalled(signal.SIGSTOP, "NatNet"), Fault.STALE_POSE
    ),
    "ours: kill -9, the loop": _stops(_signalled(signal.SIGKILL, None)),
}
