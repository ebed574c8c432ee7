"""`rhp bench dqn`: what a library's DQN learns on the Gymnasium environment."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import Seed

# torch and Drake are imported in the function, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rhp_drake.benchmarks.dqn import Evaluation


def dqn(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder of the learning curve and the weights.")
    ],
    steps: Annotated[
        int, typer.Option(min=1, help="Actions in the environment.")
    ] = 100_000,
    seed: Seed = 0,
) -> None:
    """Trains Stable-Baselines3's DQN from scratch, on the Gymnasium environment.

    Every 10 000 steps the greedy policy tries the first 100 validation tasks, and the
    curve so far is written to seed_N.json.  The weights, seed_N.safetensors, are for
    `rhp evaluate --weights`, too.

    Stable-Baselines3 comes with the extra "bench" of this project.
    """
    from dataclasses import asdict
    from importlib.metadata import version
    import json
    import sys

    from rich.console import Console

    from rhp_drake.benchmarks.dqn import SETTINGS, check_available, train_dqn
    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.files import check_writable, write_atomically
    from rhp_drake.run_record import source_commit
    from rhp_drake.value.weights import save_q_network

    check_available()
    curve_path = out / f"seed_{seed}.json"
    check_writable(curve_path)
    console = Console()
    libraries = ("stable_baselines3", "gymnasium")
    versions = ", ".join(f"{name} {version(name)}" for name in libraries)
    machine = f"{describe_machine()}, {versions}"
    record = {
        "command": " ".join(["rhp", *sys.argv[1:]]),
        "commit": source_commit(),
        "machine": machine,
        "seed": seed,
        **SETTINGS,
    }
    curve: list[Evaluation] = []

    def note(evaluation: "Evaluation") -> None:
        curve.append(evaluation)
        rows = [asdict(entry) for entry in curve]
        write_atomically(curve_path, json.dumps(record | {"curve": rows}, indent=1))

    with make_progress(console) as progress:
        bar = progress.add_task("Steps", total=steps)
        network = train_dqn(
            steps, seed, lambda step: progress.update(bar, completed=step), note
        )
    network.provenance = record
    save_q_network(network, out / f"seed_{seed}.safetensors")
    console.print(_make_table(curve, f"DQN from scratch, seed {seed}"))
    console.print(machine)


def _make_table(curve: "Sequence[Evaluation]", title: str) -> "Table":
    """A row an evaluation."""
    from rich.table import Table

    from rhp_drake.evaluation.statistics import format_rate

    table = Table(title=title)
    success = f"% of {curve[0].trials} tasks (95 % Wilson)"
    for heading in ("steps", "CPU s", success, "object fell %"):
        table.add_column(heading, justify="right")
    for entry in curve:
        table.add_row(
            str(entry.steps),
            f"{entry.seconds:.0f}",
            format_rate(entry.successes, entry.trials),
            f"{100 * entry.fallen / entry.trials:.0f}",
        )
    return table
