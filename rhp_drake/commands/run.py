"""`rhp run`: one task in closed loop, in the full diagram of the robot."""

from dataclasses import asdict
from datetime import datetime
import json
import logging
import math
import os
from pathlib import Path
import time
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rhp_drake.errors import InputError
from rhp_drake.planning.policy_config import PAPER_POLICIES

# Drake and torch are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from pydrake.systems.analysis import Simulator
    from rich.console import Console

    from rhp_drake.closed_loop import Outcome
    from rhp_drake.scenario import Scenario
    from rhp_drake.systems.receding_horizon_planner import DecisionRecord
    from rhp_drake.task import TaskInstance

INTERRUPTED: Final = "interrupted"


def run(
    scenario: Annotated[
        Path, typer.Argument(help="A scenario file, or the name of a bundled one.")
    ],
    *,
    name: Annotated[
        str | None, typer.Option(help="Which scenario, if the file has several.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Instead of the scenario's.")] = None,
    policy: Annotated[
        str | None,
        typer.Option(help=f"Instead of the scenario's: {', '.join(PAPER_POLICIES)}."),
    ] = None,
    scenario_text: Annotated[
        str | None,
        typer.Option(help="YAML to merge into it, e.g. '{world_physics: high}'."),
    ] = None,
    realtime: Annotated[bool, typer.Option(help="Run no faster than reality.")] = True,
    meshcat: Annotated[
        bool, typer.Option(help="Show the run in a browser, and record it.")
    ] = True,
    graphviz: Annotated[
        Path | None,
        typer.Option(help="Write the diagram to this file, and do not run."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results, by default runs/TIME.")
    ] = None,
) -> None:
    """Runs one task in closed loop.

    Writes run.json and, with Meshcat, recording.html.  The exit status is 0 if the
    task succeeded, 1 if it failed, 2 for bad input, 130 after Ctrl-C.
    """
    if policy is not None and policy not in PAPER_POLICIES:
        raise InputError(
            f"--policy: {policy!r} is not one of {', '.join(PAPER_POLICIES)}."
        )
    overrides = [
        text
        for text in (
            _policy_text(policy) if policy is not None else None,
            f"seed: {seed}" if seed is not None else None,
            scenario_text,
        )
        if text
    ]

    from rhp_drake.scenario import load_scenario

    title, config = load_scenario(scenario, name, overrides)
    if graphviz is not None:
        _write_graphviz(config, graphviz)
        return
    outcome = _run(title, config, realtime, meshcat, out or _default_folder())
    if outcome.status == INTERRUPTED:
        raise typer.Exit(130)  # What a shell reports for Ctrl-C.
    if not outcome.succeeded:
        raise typer.Exit(1)


def _policy_text(name: str) -> str:
    """A policy of the paper as scenario text, which leaves the weights as they are."""
    config = PAPER_POLICIES[name]()
    values = {k: v for k, v in asdict(config).items() if k != "q_network"}
    return f"policy: !{type(config).__name__} {json.dumps(values)}"


def _write_graphviz(scenario: "Scenario", path: Path) -> None:
    """Writes the diagram of the closed loop as dot text."""
    from rhp_drake.closed_loop import MakeClosedLoop
    from rhp_drake.planning.policy_config import MakePolicy

    policy = MakePolicy(scenario.policy, len(scenario.station.objects))
    # Deeper, the station's parts would hide the loop.
    text = MakeClosedLoop(scenario, policy).GetGraphvizString(max_depth=1)
    try:
        path.write_text(text)
    except OSError as error:
        raise InputError(f"--graphviz: {path}: {error.strerror}.") from None


def _run(
    title: str,
    scenario: "Scenario",
    realtime: bool,
    use_meshcat: bool,
    folder: Path,
) -> "Outcome":
    """Runs the scenario, says what happens, and writes the results to `folder`."""
    from pydrake.systems.analysis import Simulator
    from rich.console import Console
    import torch

    from rhp_drake.closed_loop import MakeClosedLoop
    from rhp_drake.files import make_folder, write_atomically
    from rhp_drake.planning.policy_config import MakePolicy
    from rhp_drake.run_record import make_run_record, write_record
    from rhp_drake.scenario import make_task_instance
    from rhp_drake.visualization import FRAME_PERIOD, MakeMeshcat

    # As everywhere else: the same bits on machines of more cores.
    torch.set_num_threads(1)
    # Drake announces Meshcat's address; so do we.
    logging.getLogger("drake").setLevel(logging.WARNING)
    # No markup: a message may well have brackets of its own.
    console = Console(highlight=False, markup=False, soft_wrap=True)
    instance = make_task_instance(scenario)
    policy = MakePolicy(
        scenario.policy, instance.num_objects, num_threads=os.cpu_count() or 1
    )
    meshcat = MakeMeshcat(scenario.visualization) if use_meshcat else None
    simulator = Simulator(MakeClosedLoop(scenario, policy, meshcat))
    if realtime:
        simulator.set_target_realtime_rate(1.0)
    make_folder(folder)

    console.print(f"{title}, seed {scenario.seed}", style="bold")
    if scenario.description:
        console.print(scenario.description)
    if meshcat is not None:
        console.print(f"Meshcat: {meshcat.web_url()}")
        meshcat.StartRecording(frames_per_second=1 / FRAME_PERIOD)
    console.print("  #  action             value  thought     to goal", style="dim")

    started, clock = datetime.now().astimezone(), time.perf_counter()
    outcome, decisions = _simulate(simulator, scenario, instance, console)
    seconds = time.perf_counter() - clock

    times = {"started": started.isoformat(timespec="seconds"), "seconds": seconds}
    record = make_run_record(scenario, decisions, outcome, times)
    write_record(folder / "run.json", record)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        write_atomically(folder / "recording.html", meshcat.StaticHtml())

    console.print(
        f"{outcome.status.replace('_', ' ').capitalize()}: {outcome.message}",
        style="bold green" if outcome.succeeded else "bold red",
    )
    console.print(
        f"{outcome.num_actions} actions, {outcome.time:.1f} s simulated in "
        f"{seconds:.1f} s, target {100 * outcome.target_distance:.1f} cm from its goal."
    )
    console.print(f"Results: {folder}")
    return outcome


def _simulate(
    simulator: "Simulator",
    scenario: "Scenario",
    instance: "TaskInstance",
    console: "Console",
) -> "tuple[Outcome, list[DecisionRecord]]":
    """Runs the task to its end, or to the user's, and says each decision."""
    from rhp_drake.closed_loop import Outcome, run_closed_loop
    from rhp_drake.physics import draw_physics
    from rhp_drake.random_streams import stream

    physics = draw_physics(
        scenario.world_physics,
        instance.initial_state,
        stream(scenario.seed, "world_physics"),
    )
    decisions: list[DecisionRecord] = []

    def on_decision(record: "DecisionRecord") -> None:
        decisions.append(record)
        console.print(_decision_line(record))

    try:
        outcome = run_closed_loop(
            simulator,
            instance,
            physics,
            seed=scenario.seed,
            time_limit=scenario.time_limit,
            on_decision=on_decision,
        )
    except KeyboardInterrupt:
        # What has happened so far is worth keeping.
        outcome = Outcome(
            status=INTERRUPTED,
            message="stopped by the user.",
            num_actions=len(decisions),
            time=simulator.get_context().get_time(),
            target_distance=decisions[-1].target_distance if decisions else math.nan,
        )
    return outcome, decisions


def _decision_line(record: "DecisionRecord") -> str:
    """A decision in one line, under the heading that `_run` prints."""
    from rhp_drake.task import Action

    action = Action(record.decision.action).name.lower()
    return (
        f"{record.index + 1:3}  {action:16} {record.decision.value:7.2f} "
        f"{record.milliseconds:5.0f} ms  {100 * record.target_distance:7.1f} cm"
    )


def _default_folder() -> Path:
    """A new name for each run, which sorts by time."""
    return Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
