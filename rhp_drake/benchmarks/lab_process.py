"""A virtual lab in a process of its own, and what its arm did."""

from contextlib import suppress
from dataclasses import dataclass
import math
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import time
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from rhp_drake.errors import WorkError
from rhp_drake.lab.faults import inject
from rhp_drake.lab.virtual_lab import VirtualLab
from rhp_drake.physics import ObjectPhysics
from rhp_drake.random_streams import stream
from rhp_drake.scenario import load_scenario
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS
from rhp_drake.task import TaskInstance
from rhp_drake.workers import follow_parent

# rad/s: a joint that is slower does not move.
_REST_SPEED: Final = 0.02
# rad from where it stays in the end: a joint that is nearer holds.  That is half a
# millimetre at the hand, where a joint's servo takes its time to settle.
_HOLDING: Final = 0.001
# Where the tracker serves: Motive's default.
_NATNET_PORT: Final = 1510
# s: the longest that any request takes, on a machine with other things to do.
_PATIENCE: Final = 60.0


@dataclass(frozen=True)
class LabLog:
    """What the arm of a lab did, and what it was told.

    Attributes:
        times: Of each period of the controller, s of time.monotonic, shape (N,).
        positions: Of the joints then, as measured, rad, shape (N, 6).
        speeds: The fastest joint's, rad/s, shape (N,).
        command_times: When a position of servoJ was taken, s of time.monotonic,
            shape (K,).
        commands: These positions, rad, shape (K, 6).
        stop_reason: Why the robot says that it stopped.
    """

    times: np.ndarray
    positions: np.ndarray
    speeds: np.ndarray
    command_times: np.ndarray
    commands: np.ndarray
    stop_reason: str

    def holds_from(self) -> float:
        """Since when the arm has held its place, s of time.monotonic."""
        away = np.abs(self.positions - self.positions[-1]).max(axis=1) > _HOLDING
        moving = np.flatnonzero(away)
        return float(self.times[moving[-1]]) if len(moving) else -math.inf

    def longest_gap(self, since: float = -math.inf) -> float:
        """For how long the lab itself stood still at most, s, which no robot does.

        Args:
            since: From when on to look, s of time.monotonic.
        """
        gaps = np.diff(self.times)[self.times[1:] >= since]
        return float(gaps.max(initial=0.0))

    def moves_at(self, time_: float) -> bool:
        """Whether the arm moved at a time, s of time.monotonic."""
        index = min(int(np.searchsorted(self.times, time_)), len(self.times) - 1)
        return bool(self.speeds[index] > _REST_SPEED)


class LabProcess:
    """Runs labs, one after the other, in real time.

    Args:
        scenario: A scenario's file, whose station the labs are.
        host: Their loopback address.
    """

    def __init__(self, scenario: Path, host: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, self._other = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(scenario, host, self._other), name="lab", daemon=True
        )

    def __enter__(self) -> Self:
        """Starts the process."""
        self._process.start()
        self._other.close()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Ends it."""
        self._process.kill()
        self._process.join()

    def begin(self, instance: TaskInstance, physics: ObjectPhysics, seed: int) -> None:
        """Begins a new lab, whose faults draw from `seed`."""
        self._ask("begin", instance, physics, seed)

    def inject(self, text: str) -> float:
        """Does what `lab.faults.inject` says; when, s of time.monotonic."""
        return float(self._ask("inject", text))

    @property
    def moves(self) -> bool:
        """Whether the arm has moved since the lab began."""
        return bool(self._ask("moves"))

    def end(self) -> LabLog:
        """Ends the lab."""
        log = self._ask("end")
        assert isinstance(log, LabLog)
        return log

    def _ask(self, name: str, *arguments: Any) -> Any:
        try:
            self._connection.send((name, arguments))
            if not self._connection.poll(_PATIENCE):
                raise WorkError(f"the lab does not answer: {name}.")
            return self._connection.recv()
        except (EOFError, OSError):
            raise WorkError(f"the lab died: {name}.") from None


class _Session:
    """One lab, from its beginning to its end."""

    def __init__(self, lab: VirtualLab) -> None:
        self.lab = lab
        self.moves = False
        self._times: list[float] = []
        self._positions: list[Any] = []
        self._speeds: list[float] = []

    def step(self) -> None:
        """One period, no faster than real time."""
        begin = time.monotonic()
        self.lab.step()
        outputs = self.lab.controller.outputs()
        speeds = outputs["actual_qd"]
        assert isinstance(speeds, tuple)
        self._times.append(begin)
        self._positions.append(outputs["actual_q"])
        self._speeds.append(max(map(abs, speeds)))
        self.moves = self.moves or self._speeds[-1] > _REST_SPEED
        time.sleep(max(0.0, begin + COMMAND_PERIOD - time.monotonic()))

    def end(self) -> LabLog:
        self.lab.close()
        taken = [c for c in self.lab.controller.commands if c.name == "servoJ"]
        times = np.array(self._times)
        # The lab's own clock stands still while the lab is not run.
        ticks = np.rint([c.time / COMMAND_PERIOD for c in taken]).astype(int)
        return LabLog(
            times,
            np.reshape(self._positions, (-1, NUM_JOINTS)),
            np.array(self._speeds),
            times[ticks],
            np.reshape([c.arguments[:NUM_JOINTS] for c in taken], (-1, NUM_JOINTS)),
            self.lab.controller.stop_reason,
        )


def _serve(scenario: Path, host: str, connection: Connection) -> None:
    """What the process does, until it is killed."""
    follow_parent()
    # A real robot has a computer of its own.
    with suppress(OSError):
        os.nice(-10)
    config = load_scenario(scenario)[1].station
    session: _Session | None = None
    while True:
        while session is None or connection.poll():
            name, arguments = connection.recv()
            answer: Any = None
            if name == "begin":
                instance, physics, seed = arguments
                if session is not None:
                    session.end()
                session = _Session(
                    VirtualLab(
                        config,
                        instance,
                        physics,
                        host,
                        _NATNET_PORT,
                        stream(seed, "lab_faults"),
                    )
                )
            else:
                assert session is not None
                if name == "inject":
                    inject(session.lab, *arguments)
                    answer = time.monotonic()
                elif name == "moves":
                    answer = session.moves
                else:
                    answer, session = session.end(), None
            connection.send(answer)
        session.step()
