"""`rhp run`: one task in closed loop, in the full diagram of the robot."""

from contextlib import ExitStack
from dataclasses import asdict
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands import task_run
from rhp_drake.errors import InputError
from rhp_drake.planning.policy_config import POLICIES, PolicyConfig, named_policy

# Drake and torch are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rhp_drake.run_closed_loop import Outcome
    from rhp_drake.scenario import Scenario


def run(
    scenario: task_run.ScenarioFile,
    *,
    name: task_run.ScenarioName = None,
    seed: task_run.Seed = None,
    policy: Annotated[
        str | None,
        typer.Option(
            help=f"Instead of the scenario's: {', '.join(POLICIES)}; or with n "
            "roll-outs of h actions, such as rhp16x8."
        ),
    ] = None,
    hardware: Annotated[
        Path | None,
        typer.Option(
            help="Run on the robot and the tracker of this file, or bundled name, e.g. "
            "virtual_lab."
        ),
    ] = None,
    scenario_text: task_run.ScenarioText = None,
    realtime: task_run.Realtime = True,
    meshcat: Annotated[
        bool, typer.Option(help="Show the run in a browser, and record it.")
    ] = True,
    graphviz: Annotated[
        Path | None,
        typer.Option(
            help="Write the diagram, simulated, to this file, and do not run."
        ),
    ] = None,
    out: task_run.Out = None,
) -> None:
    """Runs one task in closed loop.

    Writes run.json and, with Meshcat, recording.html.  The exit status is 0 if the
    task succeeded, 1 if it failed, 2 for bad input, 130 after Ctrl-C.
    """
    from rhp_drake.run_record import check_simulated
    from rhp_drake.scenario import load_scenario

    if graphviz is not None and hardware is not None:
        raise InputError("--graphviz: draws the simulated loop, without --hardware.")
    if hardware is None:
        check_simulated(scenario)
    overrides = []
    if policy is not None:
        _, present = load_scenario(scenario, name)
        overrides.append(_policy_text(policy, present.policy))
    if seed is not None:
        overrides.append(f"seed: {seed}")
    if scenario_text:
        overrides.append(scenario_text)
    title, config = load_scenario(scenario, name, overrides)
    if graphviz is not None:
        _write_graphviz(config, graphviz)
        return
    outcome = _run(title, config, realtime, meshcat, out, hardware)
    raise typer.Exit(task_run.exit_status(outcome))


def _policy_text(name: str, present: PolicyConfig) -> str:
    """A policy as scenario text, which leaves the weights as they are at present."""
    config = named_policy(name)
    values = asdict(config)
    if "q_network" in values:
        values["q_network"] = getattr(present, "q_network", values["q_network"])
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
    task_run.make_console().print(f"Diagram: {path}")


def _run(
    title: str,
    scenario: "Scenario",
    realtime: bool,
    use_meshcat: bool,
    out: Path | None,
    hardware_file: Path | None,
) -> "Outcome":
    """Runs the scenario, says what happens, and writes the results to `out`."""
    import torch

    from rhp_drake.hardware import load_hardware, running_hardware
    from rhp_drake.planning.policy_config import MakePolicy

    # As everywhere else: the same bits on machines of more cores.
    torch.set_num_threads(1)
    policy = MakePolicy(
        scenario.policy,
        len(scenario.station.objects),
        num_threads=os.cpu_count() or 1,
    )
    config = load_hardware(hardware_file) if hardware_file is not None else None
    meshcat = task_run.start_meshcat(scenario) if use_meshcat else None
    console = task_run.make_console()
    task_run.start_recording(meshcat)
    with ExitStack() as stack:
        running = None
        if config is not None:
            console.print(f"Connecting to {config.description or hardware_file}")
            m = len(scenario.station.objects)
            running = stack.enter_context(running_hardware(config, m))
            if config.lcm is None:
                task_run.say_motion(console, dry_run=config.ur.dry_run)
            else:
                console.print("The driver says whether the arm moves.")
        simulator = task_run.make_simulator(
            scenario, policy, meshcat, realtime, running
        )
        folder = task_run.start_folder(out)
        task_run.say_title(console, title, scenario, meshcat)
        run = task_run.run_task(
            simulator, scenario, console, on_hardware=running is not None
        )
    # To draw what comes last takes its time: by now the arm has been stopped.
    simulator.get_system().ForcedPublish(simulator.get_context())
    task_run.write_recording(meshcat, folder)
    task_run.write_run(run, scenario, folder, config)
    task_run.say_outcome(console, run, folder)
    return run.outcome
