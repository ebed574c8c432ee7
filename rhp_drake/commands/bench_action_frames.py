"""`rhp bench action-frames`: translations along the hand's axes or the world's."""

from typing import Annotated

import typer

from rhp_drake.commands.options import NumWorkers, Seed


def action_frames(
    *,
    instances: Annotated[int, typer.Option(min=1, max=500, help="Tasks.")] = 200,
    seed: Seed = 0,
    workers: NumWorkers = 2,
) -> None:
    """Compares how well the kinodynamic RRT plans with either set of actions."""
    import numpy as np
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    from rhp_drake.benchmarks.action_frames import ACTION_SETS, compare_action_frames
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.evaluation.statistics import format_rate

    console = Console()
    results = list(
        track(
            compare_action_frames(instances, seed, workers),
            description="Plans",
            total=instances * len(ACTION_SETS),
            console=console,
        )
    )
    table = Table(title=f"First {instances} validation tasks, planned")
    table.add_column("translations along")
    for heading in ("solved % (95 % Wilson)", "simulated: mean", "median", "actions"):
        table.add_column(heading, justify="right")
    for frame in ACTION_SETS:
        of_frame = [result for trial, result in results if trial.frame == frame]
        simulated = [result.num_transitions for result in of_frame]
        lengths: list[float] = [
            result.num_actions for result in of_frame if result.solved
        ]
        table.add_row(
            f"the {frame}'s axes",
            format_rate(len(lengths), len(of_frame)),
            f"{np.mean(simulated):.0f}",
            f"{np.median(simulated):.0f}",
            f"{np.mean(lengths or [np.nan]):.1f}",
        )
    console.print(table)
    console.print(describe_machine(workers))
