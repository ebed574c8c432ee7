"""What `rhp run` and `rhp plan` share: one task in closed loop, told and recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
import logging
import math
from pathlib import Path
import time
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rhp_drake.errors import InputError

# Drake and torch are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    import numpy as np
    from pydrake.geometry import Meshcat
    from pydrake.systems.analysis import Simulator
    from rich.console import Console

    from rhp_drake.closed_loop import Hardware
    from rhp_drake.planning.policy import Policy
    from rhp_drake.run_closed_loop import Outcome
    from rhp_drake.scenario import Scenario
    from rhp_drake.station.hardware_station import HardwareConfig
    from rhp_drake.systems.receding_horizon_planner import DecisionRecord

INTERRUPTED: Final = "interrupted"
# What a run leaves in its folder.
RUN_FILE: Final = "run.json"
PLAN_FILE: Final = "plan.json"
_RECORDING_FILE: Final = "recording.html"

# Options of both commands.
ScenarioFile = Annotated[
    Path, typer.Argument(help="A scenario file, or the name of a bundled one.")
]
ScenarioName = Annotated[
    str | None, typer.Option(help="Which scenario, if the file has several.")
]
Seed = Annotated[int | None, typer.Option(help="Instead of the scenario's.")]
ScenarioText = Annotated[
    str | None,
    typer.Option(help="YAML to merge into it, e.g. '{world_physics: high}'."),
]
Realtime = Annotated[bool, typer.Option(help="Run no faster than reality.")]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the results, by default runs/TIME; replaces an earlier run's."
    ),
]


@dataclass(frozen=True)
class TaskRun:
    """What happened.

    Attributes:
        outcome: How it ended; its status is `INTERRUPTED` after Ctrl-C.
        decisions: All of them, in order.
        goals: Centres of the goal regions, shape (m, 2), m in W; None if Ctrl-C came
            before the first decision.
        times: What the clock on the wall said.
    """

    outcome: "Outcome"
    decisions: "list[DecisionRecord]"
    goals: "np.ndarray | None"
    times: dict[str, Any]


def start_folder(out: Path | None) -> Path:
    """Makes the folder of a run's results, without those of an earlier run.

    Args:
        out: The folder; None for a new one, whose name sorts by time.

    Raises:
        InputError: If it cannot be made, or an earlier result not be removed.
    """
    from rhp_drake.files import make_folder, make_new_folder

    if out is None:
        return make_new_folder(Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}")
    make_folder(out)
    for name in (RUN_FILE, PLAN_FILE, _RECORDING_FILE):
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as error:
            raise InputError(
                f"{out / name}: cannot be removed: {error.strerror}."
            ) from None
    return out


def make_console() -> "Console":
    """Where a run is told."""
    from rich.console import Console

    # No markup: a message may well have brackets of its own.
    return Console(highlight=False, markup=False, soft_wrap=True)


def start_meshcat(scenario: "Scenario") -> "Meshcat":
    """Meshcat as the scenario wants it; see `MakeMeshcat`."""
    from rhp_drake.visualization import MakeMeshcat

    # Drake announces Meshcat's address; so do we.
    logging.getLogger("drake").setLevel(logging.WARNING)
    return MakeMeshcat(scenario.visualization)


def make_simulator(
    scenario: "Scenario",
    policy: "Policy",
    meshcat: "Meshcat | None",
    realtime: bool,
    hardware: "Hardware | None" = None,
) -> "Simulator":
    """A simulator of the closed loop; see `MakeClosedLoop`."""
    from pydrake.systems.analysis import Simulator

    from rhp_drake.closed_loop import MakeClosedLoop

    simulator = Simulator(MakeClosedLoop(scenario, policy, meshcat, hardware))
    # On hardware time is that of the robot; see `run_on_hardware`.
    if realtime and hardware is None:
        simulator.set_target_realtime_rate(1.0)
    return simulator


def say_title(
    console: "Console", title: str, scenario: "Scenario", meshcat: "Meshcat | None"
) -> None:
    """Says what is about to run, and where to look."""
    console.print(f"{title}, seed {scenario.seed}", style="bold")
    if scenario.description:
        console.print(scenario.description)
    if meshcat is not None:
        console.print(f"Meshcat: {meshcat.web_url()}")


def say_motion(console: "Console", *, dry_run: bool) -> None:
    """Says whether a real arm is about to move."""
    moves = "does not move: dry_run" if dry_run else "moves"
    console.print(f"The arm {moves}.", style="bold")


def start_recording(meshcat: "Meshcat | None") -> None:
    """Records what is shown from now on."""
    from rhp_drake.visualization import FRAME_PERIOD

    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=1 / FRAME_PERIOD)


def write_recording(meshcat: "Meshcat | None", folder: Path) -> None:
    """Writes what has been recorded to recording.html in `folder`."""
    from rhp_drake.files import write_atomically

    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        write_atomically(folder / _RECORDING_FILE, meshcat.StaticHtml())


def run_task(
    simulator: "Simulator",
    scenario: "Scenario",
    console: "Console",
    on_decision: "Callable[[DecisionRecord], None]" = lambda record: None,
    on_hardware: bool = False,
) -> TaskRun:
    """Runs the scenario's task to its end, or to the user's, and says each decision.

    Args:
        simulator: From `make_simulator`, for the same scenario.
        scenario: Says which task and physics.
        console: Where to say it.
        on_decision: Called soon after each decision, before it is said.
        on_hardware: Whether the task begins where robot and objects are; of the
            scenario's task the target's goal alone counts.
    """
    from rhp_drake.run_closed_loop import Outcome, goals_of

    decisions: list[DecisionRecord] = []

    def note_decision(record: "DecisionRecord") -> None:
        decisions.append(record)
        on_decision(record)
        if record.index == 0:
            heading = "  #  action             value  thought     to goal"
            console.print(heading, style="dim")
        console.print(_decision_line(record))

    started, clock = datetime.now().astimezone(), time.perf_counter()
    try:
        outcome = _run(simulator, scenario, note_decision, on_hardware)
    except KeyboardInterrupt:
        # What has happened so far is worth keeping.
        outcome = Outcome(
            status=INTERRUPTED,
            message="stopped by the user.",
            num_actions=len(decisions),
            time=simulator.get_context().get_time(),
            target_distance=decisions[-1].target_distance if decisions else math.nan,
        )
    seconds = time.perf_counter() - clock
    times = {"started": started.isoformat(timespec="seconds"), "seconds": seconds}
    goals = None
    # Before, they may not have been set.
    if decisions or outcome.status != INTERRUPTED:
        goals = goals_of(simulator)
    return TaskRun(outcome, decisions, goals, times)


def _run(
    simulator: "Simulator",
    scenario: "Scenario",
    on_decision: "Callable[[DecisionRecord], None]",
    on_hardware: bool,
) -> "Outcome":
    from rhp_drake.physics import draw_physics
    from rhp_drake.random_streams import stream
    from rhp_drake.run_closed_loop import run_closed_loop, run_on_hardware
    from rhp_drake.scenario import make_task_instance

    instance = make_task_instance(scenario)
    if on_hardware:
        return run_on_hardware(
            simulator,
            instance.goals[0],
            seed=scenario.seed,
            time_limit=scenario.time_limit,
            on_decision=on_decision,
        )
    physics = draw_physics(
        scenario.world_physics,
        instance.initial_state,
        stream(scenario.seed, "world_physics"),
    )
    return run_closed_loop(
        simulator,
        instance,
        physics,
        seed=scenario.seed,
        time_limit=scenario.time_limit,
        on_decision=on_decision,
    )


def write_run(
    run: TaskRun,
    scenario: "Scenario",
    folder: Path,
    hardware: "HardwareConfig | None" = None,
) -> None:
    """Writes run.json to `folder`; see `make_run_record`."""
    from rhp_drake.run_record import make_run_record, write_record

    record = make_run_record(
        scenario,
        run.decisions,
        run.outcome,
        run.times,
        goals=run.goals,
        hardware=hardware,
    )
    write_record(folder / RUN_FILE, record)


def say_outcome(console: "Console", run: TaskRun, folder: Path) -> None:
    """Says how it ended, and where the results are."""
    outcome = run.outcome
    console.print(
        f"{outcome.status.replace('_', ' ').capitalize()}: {outcome.message}",
        style="bold green" if outcome.succeeded else "bold red",
    )
    text = (
        f"{outcome.num_actions} actions, {outcome.time:.1f} s in the world, "
        f"{run.times['seconds']:.1f} s by the clock"
    )
    # Ctrl-C may come before anything was measured.
    if math.isfinite(outcome.target_distance):
        text += f", target {100 * outcome.target_distance:.1f} cm from its goal"
    console.print(f"{text}.")
    console.print(f"Results: {folder}")


def exit_status(outcome: "Outcome") -> int:
    """0 for success, 1 for failure, and what a shell reports for Ctrl-C."""
    if outcome.status == INTERRUPTED:
        return 130
    return 0 if outcome.succeeded else 1


def _decision_line(record: "DecisionRecord") -> str:
    """A decision in one line."""
    from rhp_drake.task import Action

    action = Action(record.decision.action).name.lower()
    return (
        f"{record.index + 1:3}  {action:16} {record.decision.value:7.2f} "
        f"{record.milliseconds:5.0f} ms  {100 * record.target_distance:7.1f} cm"
    )
