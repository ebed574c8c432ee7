"""`rhp bench`: measurements of the project's own parts."""

from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.bench_action_frames import action_frames
from rhp_drake.commands.bench_dqn import dqn
from rhp_drake.commands.bench_hardware import faults, loopback
from rhp_drake.commands.bench_planners import planners
from rhp_drake.commands.bench_push_model import push_model
from rhp_drake.commands.bench_reinforcement import reinforcement
from rhp_drake.commands.options import Seed

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rhp_drake.evaluation.model_gap import Push

bench = typer.Typer(no_args_is_help=True, help="Measures parts of the project.")


@bench.callback()
def _bench() -> None:
    """Makes `bench` a group, even of one command."""


bench.command()(push_model)
bench.command()(action_frames)
bench.command()(planners)
bench.command()(reinforcement)
bench.command()(dqn)
bench.command()(loopback)
bench.command()(faults)


@bench.command()
def model_gap(
    *,
    pushes: Annotated[int, typer.Option(min=1, help="How many.")] = 200,
    seed: Seed = 0,
) -> None:
    """Compares single pushes in the planar push model and in the robot's station.

    The error is the distance between where a box ends in the one and in the other,
    of all boxes that either sees move.
    """
    from rich.console import Console
    from rich.progress import track

    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.evaluation.model_gap import compare_pushes

    console = Console()
    results = list(
        track(
            compare_pushes(pushes, seed),
            description="Pushes",
            total=pushes,
            console=console,
        )
    )
    console.print(_make_table(results, f"{pushes} pushes, seed {seed}"))
    console.print(describe_machine())


def _make_table(pushes: "Sequence[Push]", title: str) -> "Table":
    """Errors over all pushes and action by action, and the baseline's."""
    from rich.table import Table

    from rhp_drake.task import Action

    table = Table(title=f"Displacement error of boxes, mm: {title}")
    table.add_column("predicted by")
    for heading in ("boxes", "mean (95 % interval)", "median", "95th pct"):
        table.add_column(heading, justify="right")
    table.add_row("push model", *_cells([p.displacement_errors() for p in pushes]))
    # What any model has to beat.
    table.add_row(
        "nothing moves",
        *_cells([p.displacements() for p in pushes]),
        end_section=True,
    )
    for action in Action:
        errors = [p.displacement_errors() for p in pushes if p.action == action]
        if errors:
            table.add_row(f"  {action.name.lower()}", *_cells(errors))
    return table


def _cells(errors: "Sequence") -> list[str]:
    """A row of the table from each push's errors, in m."""
    import numpy as np

    from rhp_drake.evaluation.statistics import bootstrap_interval
    from rhp_drake.random_streams import stream

    values = 1e3 * np.concatenate(errors)
    low, high = bootstrap_interval(
        [1e3 * of_push for of_push in errors], stream(0, "bootstrap")
    )
    return [
        str(len(values)),
        f"{values.mean():.2f} ({low:.2f}-{high:.2f})",
        f"{np.median(values):.2f}",
        f"{np.percentile(values, 95):.2f}",
    ]
