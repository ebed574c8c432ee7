"""Things go wrong at random moments of runs over loopback: whether the arm stops.

Each injection is a task of its own, in a lab of its own: greedy pushing, until
something goes wrong.  What decides is the lab's record: what its controller was told
and how its joints moved.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
import json
import math
from pathlib import Path
import time
from typing import Final

import numpy as np

from rhp_drake.benchmarks.fault_kinds import FAULT_KINDS, FaultKind
from rhp_drake.benchmarks.lab_process import LabLog, LabProcess
from rhp_drake.benchmarks.run_process import RunProcess, RunReport
from rhp_drake.errors import InputError, WorkError
from rhp_drake.files import exclusive, write_atomically
from rhp_drake.hardware import load_hardware
from rhp_drake.physics import nominal_physics
from rhp_drake.random_streams import stream
from rhp_drake.safety import Fault
from rhp_drake.station.hardware_station import HardwareConfig
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import forward_kinematics
from rhp_drake.systems.command_guard import CommandGuardConfig, hand_is_inside
from rhp_drake.task import sample_instance

# Within so long the arm has to hold.
HOLD_TIME: Final = 0.150  # s
# ms: twice a period and more is no robot's.
LAB_STALL: Final = 20.0
_SCENARIO: Final = Path("three_boxes")
_POLICY: Final = "policy: !GreedyConfig {}"
_NUM_OBJECTS: Final = 3
# Loopback address of the lab, beside that of `rhp lab`.
_HOST: Final = "127.0.0.3"
# s after the first motion: an action takes one to two.
_LATEST: Final = 1.6
# s for which the arm is watched after something went wrong.
_WATCHED: Final = 0.5
# s
_START_TIME: Final = 20.0
_END_TIME: Final = 20.0
_POLL_PERIOD: Final = 0.004
_ATTEMPTS: Final = 10
# Of a limit; and m.
_ROUNDING: Final = 1e-6


@dataclass(frozen=True)
class Injection:
    """Something that went wrong, and what came of it.

    Attributes:
        index: Of its random draws.
        kind: Its name in `FAULT_KINDS`.
        moving: Whether the arm moved at that moment.
        said: The fault that the run ended with; "" if it went on, or nobody was left.
        hold_ms: From that moment until the arm held its place for good, ms; nan if the
            run went on.
        num_commands: How many positions the controller was told.
        bad_command: What was wrong with one of them; "" if all were in order.
        problem: What else was not as it has to be; "" if all was.
        lab_gap_ms: How long the lab itself stood still from then on, at most, ms: its
            computer is to blame, for a robot has one of its own.
        false_alarms: The faults that ended runs before anything had gone wrong, and
            how long the lab had stood still in those runs, at most, ms.
    """

    index: int
    kind: str
    moving: bool
    said: str
    hold_ms: float
    num_commands: int
    bad_command: str
    problem: str
    lab_gap_ms: float
    false_alarms: list[tuple[str, float]]


def read_injections(path: Path) -> list[Injection]:
    """The injections in a file of `run_campaign`.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        injections = [Injection(**row) for row in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read: {error}.") from None
    return [
        replace(x, false_alarms=[(name, gap) for name, gap in x.false_alarms])
        for x in injections
    ]


def run_campaign(path: Path, count: int, seed: int) -> Iterator[Injection]:
    """Injects faults, as many of each kind, in an order drawn at random.

    Stopped at any moment and called again, it goes on where it was.

    Args:
        path: File of the results, JSON.
        count: How many.
        seed: Of all draws.

    Yields:
        Those that are in the file, then each as it is done.

    Raises:
        InputError: If the file cannot be read, or is of another seed.
        WorkError: If the lab or the closed loop cannot be started.
    """
    with exclusive(path.parent):
        done = read_injections(path) if path.exists() else []
        if any(x.kind != _kind(x.index, seed) for x in done):
            raise InputError(
                f"{path}: is of another seed or version; choose another folder."
            )
        yield from done[:count]
        if len(done) >= count:
            return
        hardware = load_hardware(Path("virtual_lab"))
        hardware.ur.host = hardware.natnet.server_address = _HOST
        with (
            LabProcess(_SCENARIO, _HOST) as lab,
            RunProcess(_SCENARIO, [_POLICY], hardware) as run,
        ):
            for index in range(len(done), count):
                kind = _kind(index, seed)
                done.append(_inject(lab, run, hardware, index, kind, seed))
                rows = [asdict(injection) for injection in done]
                write_atomically(path, json.dumps(rows, indent=0))
                yield done[-1]


def _kind(index: int, seed: int) -> str:
    """All kinds before any again, each time in another order."""
    names = list(FAULT_KINDS)
    turn, place = divmod(index, len(names))
    order = stream(seed, "fault_campaign", "order", turn).permutation(len(names))
    return names[order[place]]


def _inject(
    lab: LabProcess,
    run: RunProcess,
    hardware: HardwareConfig,
    index: int,
    name: str,
    seed: int,
) -> Injection:
    """Runs tasks until one gets as far as that something can go wrong."""
    false_alarms: list[tuple[str, float]] = []
    for attempt in range(_ATTEMPTS):
        generator = stream(seed, "fault_campaign", index, attempt)
        done = _attempt(lab, run, hardware, index, name, generator)
        if isinstance(done, Injection):
            return replace(done, false_alarms=false_alarms)
        false_alarms += done
    raise WorkError(f"no run gets far enough for an injection: {false_alarms}.")


def _attempt(
    lab: LabProcess,
    run: RunProcess,
    hardware: HardwareConfig,
    index: int,
    name: str,
    generator: np.random.Generator,
) -> Injection | list[tuple[str, float]]:
    """One task, and what goes wrong; or the false alarm that came before, if any."""
    kind = FAULT_KINDS[name]
    instance = sample_instance(generator, _NUM_OBJECTS)
    lab.begin(instance, nominal_physics(_NUM_OBJECTS), index)
    run.begin(instance.goals[0], index)
    deadline = time.monotonic() + _START_TIME
    while not lab.moves and not run.is_over and time.monotonic() < deadline:
        time.sleep(_POLL_PERIOD)
    time.sleep(generator.uniform(0.0, _LATEST))
    if run.is_over:
        gap_ms = 1000 * lab.end().longest_gap()
        report = _end_run(run, kind)
        ended = report.outcome if isinstance(report, RunReport) else None
        if ended is None or ended.fault == Fault.NONE:
            return []
        return [(ended.fault.name, gap_ms)]
    at = kind.inject(lab, run, generator)
    time.sleep(max(0.0, at + _WATCHED - time.monotonic()))
    log = lab.end()
    problem, report = "", _end_run(run, kind)
    if isinstance(report, str):
        problem, report = report, RunReport()
    said = Fault.NONE if report.outcome is None else report.outcome.fault
    went_on = kind.tolerable and said == Fault.NONE
    hold_ms = math.nan if went_on else 1000 * max(0.0, log.holds_from() - at)
    return Injection(
        index=index,
        kind=name,
        moving=log.moves_at(at),
        said="" if said == Fault.NONE else said.name,
        hold_ms=hold_ms,
        num_commands=len(log.commands),
        bad_command=_bad_command(log, hardware),
        problem=problem or report.crash or _verdict(kind, said, hold_ms),
        lab_gap_ms=1000 * log.longest_gap(at),
        false_alarms=[],
    )


def _end_run(run: RunProcess, kind: FaultKind) -> RunReport | str:
    """The run's report after a fault, or what is wrong with its end."""
    try:
        if kind.tolerable and not run.is_over:
            run.interrupt()
        report = run.report(_END_TIME)
    except WorkError as error:
        run.restart()
        # Of some kinds that is the point.
        return str(error) if kind.causes else RunReport()
    if report is None:
        run.restart()
        return "the run does not end"
    return report


def _verdict(kind: FaultKind, said: Fault, hold_ms: float) -> str:
    """What is wrong with how a run ended; "" if nothing is."""
    if said == Fault.NONE and kind.causes and not kind.tolerable:
        return "the run went on"
    if said != Fault.NONE and said not in kind.causes:
        return "another cause was named"
    # What is tolerable may become too much at any time.
    if hold_ms > 1000 * HOLD_TIME and not kind.tolerable:
        return "the arm held too late"
    return ""


def _bad_command(log: LabLog, hardware: HardwareConfig) -> str:
    """What is wrong with one of the positions that the controller took."""
    commands, limits = log.commands, hardware.ur.limits
    if not np.isfinite(commands).all():
        return "not finite"
    if (np.abs(commands) > limits.position_limits).any():
        return "beyond a position limit"
    # The driver's clock and the lab's may be a period apart, which counts less over
    # more of them.
    for stride in (1, 4, 16):
        elapsed = log.command_times[stride:] - log.command_times[:-stride]
        moved = np.abs(commands[stride:] - commands[:-stride]).max(axis=1, initial=0.0)
        allowed = limits.velocity_limit * (elapsed + COMMAND_PERIOD)
        if (moved > allowed * (1 + _ROUNDING)).any():
            return "too fast"
    guard = CommandGuardConfig()
    for X_WH in map(forward_kinematics, commands):
        if not hand_is_inside(guard, X_WH, _ROUNDING):
            return "the hand out of its workspace or height, or leaning"
    return ""


@dataclass(frozen=True)
class KindSummary:
    """All injections of a kind.

    Attributes:
        kind: Its name.
        count: How many.
        moving: In how many the arm moved.
        stopped: How many runs ended for it.
        named: How many of them named a cause of it.
        hold_ms: Of those that ended while the arm moved: median and longest, ms.
    """

    kind: str
    count: int
    moving: int
    stopped: int
    named: int
    hold_ms: tuple[float, float]


def summarize(injections: Sequence[Injection]) -> list[KindSummary]:
    """What came of each kind, in the order of `FAULT_KINDS`."""
    summaries = []
    for name, kind in FAULT_KINDS.items():
        of_kind = [x for x in injections if x.kind == name]
        if not of_kind:
            continue
        ended = [x for x in of_kind if not math.isnan(x.hold_ms)]
        held = [x.hold_ms for x in ended if x.moving] or [math.nan]
        causes = {cause.name for cause in kind.causes}
        summaries.append(
            KindSummary(
                kind=name,
                count=len(of_kind),
                moving=sum(x.moving for x in of_kind),
                stopped=len(ended),
                named=sum(x.said in causes for x in ended),
                hold_ms=(float(np.median(held)), max(held)),
            )
        )
    return summaries
