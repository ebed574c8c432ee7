"""`rhp figure4`: the greedy policy's success, by how many plans it imitated."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import NumWorkers
from rhp_drake.errors import InputError

# Drake, torch and matplotlib are imported in the functions, so that `rhp --help` is
# quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rhp_drake.evaluation.figure4_data import CurvePoint, PointResult


def figure4(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder of numbers, pictures and trained weights.")
    ],
    plans: Annotated[
        str, typer.Option(help="How many plans to imitate; the first ones are taken.")
    ] = "100,300,1000,2000,4000,6000,8895",
    demonstrations: Annotated[
        list[Path] | None,
        typer.Option(
            help="File or folder of demonstrations; may be repeated. Without it, the "
            "plans that come with the package."
        ),
    ] = None,
    instances: Annotated[
        str, typer.Option(help="The set: evaluation (never tune on it) or validation.")
    ] = "evaluation",
    seeds: Annotated[
        int, typer.Option(min=1, help="Trainings on each number of plans.")
    ] = 1,
    steps: Annotated[
        int, typer.Option(min=1, help="Gradient steps of a training.")
    ] = 40_000,
    workers: NumWorkers = 2,
) -> None:
    """Makes the paper's Figure 4: what the greedy policy learns from how many plans.

    Trains a Q-network for each number of plans, runs its greedy policy on frozen
    tasks, and writes figure4.csv, figure4.svg and figure4.png.

    You may stop this at any moment: the same command goes on where it was.
    """
    from rich.console import Console

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.figure4 import Figure4
    from rhp_drake.evaluation.figure4_data import Point, curve, write_results
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.evaluation.plots import draw_figure4, save_picture
    from rhp_drake.learning.imitation import ImitationConfig
    from rhp_drake.run_record import source_commit

    points = [Point(size, seed) for seed in range(seeds) for size in _sizes(plans)]
    work = Figure4(
        folder=out,
        demonstrations=tuple(demonstrations or ()),
        config=ImitationConfig(num_steps=steps),
        instances=instances,
        commit=source_commit(),
    )
    making = work.make_points(points, workers)
    console = Console(highlight=False, soft_wrap=True)
    console.print(
        f"{len(points)} trainings of {steps} steps; of each a line when it is done."
    )
    results: list[PointResult] = []
    try:
        with make_progress(console) as progress:
            bar = progress.add_task("Trainings", total=len(points))
            for result in making:
                results.append(result)
                console.print(_line(result))
                progress.advance(bar)
    except KeyboardInterrupt:
        console.print("Stopped; the same command goes on from here.")
        raise typer.Exit(130) from None
    write_results(out / "figure4.csv", results)
    points_of_curve = curve(results)
    save_picture(draw_figure4(points_of_curve), out / "figure4")
    console.print(_table(points_of_curve, f"500 tasks of the {instances} set"))
    console.print(f"{out}: figure4.csv, figure4.svg, figure4.png")
    console.print(describe_machine(workers))


def _sizes(plans: str) -> list[int]:
    """The numbers of plans, each once."""
    try:
        sizes = [int(text) for text in plans.split(",")]
    except ValueError:
        sizes = [0]
    if min(sizes) < 1:
        raise InputError(
            f"--plans: {plans!r} is no list of numbers above 0, such as 100,1000."
        )
    return sorted(set(sizes))


def _line(result: "PointResult") -> str:
    point = result.point
    return (
        f"{point.num_plans} plans, seed {point.seed}: "
        f"{100 * result.rates.mean():.1f} % solved"
    )


def _table(points: "Sequence[CurvePoint]", title: str) -> "Table":
    """The curve in numbers; with several seeds, also how far apart they are."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left")
    for heading in ("plans", "success %", "95 %, t over 25 batches"):
        table.add_column(heading, justify="right")
    several = any(len(point.seed_rates) > 1 for point in points)
    if several:
        table.add_column("by seed", justify="right")
    for point in points:
        cells = [
            str(point.num_plans),
            f"{100 * point.success:.1f}",
            f"{100 * point.low:.1f}-{100 * point.high:.1f}",
        ]
        if several:
            cells.append(", ".join(f"{100 * rate:.1f}" for rate in point.seed_rates))
        table.add_row(*cells)
    return table
