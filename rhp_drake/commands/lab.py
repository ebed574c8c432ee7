"""`rhp lab`: a robot and a tracker to rehearse with."""

from contextlib import suppress
from queue import Empty, SimpleQueue
import sys
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rhp_drake.commands import task_run
from rhp_drake.errors import InputError

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rich.console import Console

    from rhp_drake.lab.virtual_lab import VirtualLab

_HELP: Final = "help"
# s between two looks at what the user has typed.
_PERIOD: Final = 0.2


def lab(
    scenario: task_run.ScenarioFile,
    *,
    name: task_run.ScenarioName = None,
    seed: task_run.Seed = None,
    scenario_text: task_run.ScenarioText = None,
    host: Annotated[
        str, typer.Option(help="Loopback address; the ports of the robot are fixed.")
    ] = "127.0.0.2",
    natnet_port: Annotated[int, typer.Option(help="UDP port of the tracker.")] = 1510,
    meshcat: Annotated[bool, typer.Option(help="Show the lab in a browser.")] = False,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="End after so long; else Ctrl-C ends.")
    ] = None,
) -> None:
    """Simulates the station behind the protocols of a UR5 and of OptiTrack.

    Connect to it with `rhp run SCENARIO --hardware scenarios/virtual_lab.yaml`, as to a
    real robot. Type a fault and Enter to make something go wrong; `help` lists them.
    """
    from rhp_drake.lab.virtual_lab import VirtualLab
    from rhp_drake.physics import draw_physics
    from rhp_drake.random_streams import stream
    from rhp_drake.scenario import load_scenario, make_task_instance

    texts = [f"seed: {seed}" if seed is not None else None, scenario_text]
    title, config = load_scenario(scenario, name, [text for text in texts if text])
    instance = make_task_instance(config)
    physics = draw_physics(
        config.world_physics,
        instance.initial_state,
        stream(config.seed, "world_physics"),
    )
    shown = task_run.start_meshcat(config) if meshcat else None
    virtual = VirtualLab(
        config.station,
        instance,
        physics,
        host,
        natnet_port,
        stream(config.seed, "lab_faults"),
        shown,
    )
    console = task_run.make_console()
    task_run.say_title(console, f"Lab of {title}", config, shown)
    console.print(
        f"At {host}: a robot (RTDE), and a tracker (NatNet, port {natnet_port}).  "
        "Ctrl-C ends, help helps."
    )
    try:
        _run(virtual, console, seconds)
    except KeyboardInterrupt:
        console.print("The lab is closed.")
    finally:
        virtual.close()


def _run(virtual: "VirtualLab", console: "Console", seconds: float | None) -> None:
    """Runs the lab, and does what the user types."""
    lines: SimpleQueue[str] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line.strip())

    Thread(target=read, daemon=True).start()
    left = float("inf") if seconds is None else seconds
    reason = ""
    while left > 0:
        virtual.run(min(_PERIOD, left))
        left -= _PERIOD
        if virtual.controller.stop_reason != reason:
            reason = virtual.controller.stop_reason
            console.print(f"The robot stops: {reason}." if reason else "It is well.")
        with suppress(Empty):
            _obey(lines.get_nowait(), virtual, console)


def _obey(line: str, virtual: "VirtualLab", console: "Console") -> None:
    """Does one line of what the user typed."""
    from rhp_drake.lab.faults import FAULTS, inject

    if line == _HELP:
        for word, fault in FAULTS.items():
            console.print(f"  {' '.join([word, *fault.arguments]):24} {fault.help}")
        return
    try:
        inject(virtual, line)
        console.print(f"{line}: done.")
    except InputError as error:
        console.print(str(error))
