"""Our side of a robot in a process of its own: closed loop and drivers, run by run."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import enum
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import signal
import traceback
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.closed_loop import Hardware, MakeClosedLoop
from rhp_drake.drivers.command_periods import CommandPeriods
from rhp_drake.drivers.measurements import ArmMeasurement, ObjectPose
from rhp_drake.drivers.ur_driver import UrDriver
from rhp_drake.errors import InputError, WorkError
from rhp_drake.hardware import running_hardware
from rhp_drake.planning.policy_config import MakePolicy
from rhp_drake.run_closed_loop import Outcome, goals_of, run_on_hardware
from rhp_drake.scenario import load_scenario
from rhp_drake.station.hardware_station import Arm, HardwareConfig, Tracker
from rhp_drake.systems.receding_horizon_planner import DecisionRecord

# s: the longest that a process of ours takes to start.
_PATIENCE: Final = 120.0
# s: an arm that moves brakes first.
_END_TIME: Final = 5.0
# rad: far beyond what one command may add.
_JUMP: Final = 0.3


class BadCommand(enum.IntEnum):
    """What is wrong with the commands that the driver gets."""

    NONE = 0
    NOT_FINITE = 1
    JUMP = 2
    BEYOND_RANGE = 3


@dataclass(frozen=True)
class RunReport:
    """What became of a run.

    Attributes:
        outcome: How it ended; None after Ctrl-C or a crash.
        crash: The traceback of an error that nobody expects; empty if there was none.
        decisions: All of them.
        goals: What they were to reach, shape (m, 2), m in W.
        periods: Of the stream of commands, a `CommandPeriods`' vector.
        arm_ages: Of the arm's measurement at each tick of the loop, s, shape (N,).
        object_ages: Of the oldest object's pose, s, shape (N,).
    """

    outcome: Outcome | None = None
    crash: str = ""
    decisions: list[DecisionRecord] = field(default_factory=list)
    goals: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    periods: np.ndarray = field(default_factory=lambda: CommandPeriods().vector)
    arm_ages: np.ndarray = field(default_factory=lambda: np.empty(0))
    object_ages: np.ndarray = field(default_factory=lambda: np.empty(0))


class RunProcess:
    """Runs tasks on hardware, one after the other.

    Args:
        scenario: A scenario's file.
        overrides: What to merge into it, see `load_scenario`.
        hardware: What to connect to.
    """

    def __init__(
        self, scenario: Path, overrides: Sequence[str], hardware: HardwareConfig
    ) -> None:
        self._arguments = scenario, overrides, hardware
        self._driver_pids: dict[str, int] = {}
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._bad_command = context.Value("i", BadCommand.NONE)
        # Not a daemon: it has processes of its own.
        self._process = context.Process(
            target=_serve,
            args=(*self._arguments, other, self._bad_command),
            name="run",
        )
        self._process.start()
        other.close()

    def __enter__(self) -> Self:
        """Waits until the process is ready."""
        self._receive(_PATIENCE)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Ends it; its drivers follow."""
        self._end()

    def _end(self) -> None:
        # It ends when nobody is at the other end.
        self._connection.close()
        self._process.join(_END_TIME)
        self._process.kill()
        self._process.join()

    def restart(self) -> None:
        """A new process, after the old one was killed or hangs."""
        self._end()
        self._start()
        self._receive(_PATIENCE)

    def begin(self, goal: np.ndarray, seed: int) -> None:
        """Begins a run, and returns once its drivers run.

        Args:
            goal: Of the target, shape (2,), m in W.
            seed: Of the policy's draws.

        Raises:
            WorkError: If they do not start.
        """
        if not self._process.is_alive():
            self.restart()
        self._bad_command.value = BadCommand.NONE
        self._connection.send((goal, seed))
        answer = self._receive(_PATIENCE)
        if isinstance(answer, RunReport):
            raise WorkError(f"the drivers do not start: {answer.crash}")
        self._driver_pids = answer

    def report(self, timeout: float) -> RunReport | None:
        """What became of the run; None if nothing has within so many seconds."""
        return self._receive(timeout) if self._connection.poll(timeout) else None

    @property
    def is_over(self) -> bool:
        """Whether the run has ended, and its report can be had at once."""
        return self._connection.poll(0)

    def spoil_commands(self, how: BadCommand) -> None:
        """From now on the driver gets commands with something wrong."""
        self._bad_command.value = how

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.send_signal(signal.SIGINT)

    def send_signal(self, number: int, driver: str | None = None) -> None:
        """Sends a signal to the process, or to one of its drivers: "ur", "NatNet"."""
        pid = self._process.pid if driver is None else self._driver_pids[driver]
        assert pid is not None
        os.kill(pid, number)

    def _receive(self, timeout: float) -> Any:
        try:
            if not self._connection.poll(timeout):
                raise WorkError("the closed loop's process does not answer.")
            return self._connection.recv()
        except (EOFError, OSError):
            raise WorkError("the closed loop's process died.") from None


class _WatchedArm:
    """A driver whose ages are noted, and whose commands can be spoiled."""

    def __init__(self, arm: Arm, bad_command: Any, ages: list[float]) -> None:
        self._arm = arm
        self._bad_command = bad_command
        self._ages = ages

    def command(self, position: np.ndarray, engaged: bool) -> None:
        """See `Arm`."""
        match BadCommand(self._bad_command.value):
            case BadCommand.NOT_FINITE:
                position = np.full_like(position, np.nan)
            case BadCommand.JUMP:
                position = position + _JUMP
            case BadCommand.BEYOND_RANGE:
                position = np.full_like(position, 10.0)
        self._arm.command(position, engaged)

    def read(self) -> ArmMeasurement:
        """See `Arm`."""
        measured = self._arm.read()
        self._ages.append(measured.age)
        return measured


class _WatchedTracker:
    """A driver whose ages are noted."""

    def __init__(self, tracker: Tracker, ages: list[float]) -> None:
        self._tracker = tracker
        self._ages = ages

    def read(self) -> Sequence[ObjectPose]:
        """See `Tracker`."""
        poses = self._tracker.read()
        self._ages.append(max(pose.age for pose in poses))
        return poses


def _serve(
    file: Path,
    overrides: Sequence[str],
    hardware: HardwareConfig,
    connection: Connection,
    bad_command: Any,
) -> None:
    """What the process does, until it is killed or nobody listens any more."""
    import torch

    torch.set_num_threads(1)
    # Ctrl-C ends a run, and nothing else.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _, scenario = load_scenario(file, overrides=overrides)
    policy = MakePolicy(scenario.policy, len(scenario.station.objects))
    connection.send(None)

    def run(goal: np.ndarray, seed: int) -> RunReport:
        outcome, crash = None, ""
        goals, periods = np.empty((0, 2)), CommandPeriods().vector
        decisions: list[DecisionRecord] = []
        arm_ages: list[float] = []
        object_ages: list[float] = []
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            m = len(scenario.station.objects)
            with running_hardware(hardware, m) as running:
                watched = Hardware(
                    _WatchedArm(running.arm, bad_command, arm_ages),
                    _WatchedTracker(running.tracker, object_ages),
                )
                simulator = Simulator(
                    MakeClosedLoop(scenario, policy, hardware=watched)
                )
                children = multiprocessing.active_children()
                connection.send({child.name: child.pid for child in children})
                outcome = run_on_hardware(
                    simulator, goal, seed=seed, on_decision=decisions.append
                )
                goals = goals_of(simulator)
                assert isinstance(running.arm, UrDriver)
                periods = running.arm.periods.vector
        except KeyboardInterrupt:
            pass
        except (InputError, WorkError) as error:
            crash = str(error)
        except Exception:
            crash = traceback.format_exc()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        ages = np.array(arm_ages), np.array(object_ages)
        return RunReport(outcome, crash, decisions, goals, periods, *ages)

    while True:
        try:
            goal, seed = connection.recv()
        except EOFError:
            return
        connection.send(run(goal, seed))
