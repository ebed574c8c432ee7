"""`rhp demos`: makes demonstrations, and checks, compacts and rebuilds them."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import NumWorkers, RayAddress, Seed
from rhp_drake.errors import InputError

# Drake and torch are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rich.console import Console

    from rhp_drake.learning.demonstration import Demonstrator

demos = typer.Typer(invoke_without_command=True)

_Sources = Annotated[
    list[Path], typer.Argument(help="Files or folders of demonstrations.")
]


class Method(StrEnum):
    """Who makes the demonstrations."""

    RRT = "rrt"
    GUIDED = "guided"
    RHP = "rhp"


@demos.callback()
def make(
    context: typer.Context,
    *,
    plans: Annotated[
        int | None, typer.Option(min=1, help="How many training tasks to try.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the demonstrations.")
    ] = None,
    method: Annotated[
        Method,
        typer.Option(
            help="Plan by the kinodynamic RRT, plan guided by a Q-network, or act by "
            "epsilon-RHP."
        ),
    ] = Method.RRT,
    weights: Annotated[
        Path | None, typer.Option(help="The Q-network of guided and rhp, a file.")
    ] = None,
    first_task: Annotated[
        int, typer.Option(min=0, help="The number of the first task.")
    ] = 0,
    seed: Seed = 0,
    objects: Annotated[
        int, typer.Option(min=1, max=10, help="How many boxes the tasks have.")
    ] = 3,
    workers: NumWorkers = 2,
    ray: RayAddress = None,
) -> None:
    """Makes demonstrations: plans and all that was simulated to find them.

    You may stop this at any moment: the same command goes on where it was.
    """
    if context.invoked_subcommand is not None:
        return
    if plans is None or out is None:
        raise InputError("rhp demos: --plans and --out say what to make, and where.")
    from rich.console import Console

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.learning.demonstration_folder import (
        demonstrate_tasks,
        shard_paths,
    )
    from rhp_drake.run_record import source_commit
    from rhp_drake.workers import RayCluster

    demonstrator = _demonstrator(method, weights, seed, objects)
    tasks = range(first_task, first_task + plans)
    who = workers if ray is None else RayCluster(ray)
    console = Console(highlight=False, soft_wrap=True)
    try:
        with make_progress(console) as progress:
            bar = progress.add_task("Tasks", total=plans)
            for done in demonstrate_tasks(
                out, tasks, demonstrator, who, source_commit()
            ):
                progress.update(bar, completed=done)
    except KeyboardInterrupt:
        console.print("Stopped; the same command goes on from here.")
        raise typer.Exit(130) from None
    _print_summary(shard_paths([out]), console)


def _demonstrator(
    method: Method, weights: Path | None, seed: int, num_objects: int
) -> "Demonstrator":
    from rhp_drake.learning.demonstrators import (
        GuidedDemonstrator,
        PlanningDemonstrator,
        RecedingHorizonDemonstrator,
    )
    from rhp_drake.value.weights import load_q_network

    if method == Method.RRT:
        if weights is not None:
            raise InputError("--weights: the RRT needs none; use --method.")
        return PlanningDemonstrator(seed, num_objects)
    if weights is None:
        raise InputError(f"--method {method}: needs --weights.")
    q_network = load_q_network(weights, num_objects)
    if method == Method.GUIDED:
        return GuidedDemonstrator(seed, q_network)
    return RecedingHorizonDemonstrator(seed, q_network)


def _print_summary(paths: list[Path], console: "Console") -> None:
    """A table of what the files hold."""
    import numpy as np
    import pyarrow as pa
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from rhp_drake.evaluation.statistics import format_rate
    from rhp_drake.learning.demonstration_files import lengths, read_table

    names = ["solved", "actions", "num_transitions", "seconds"]
    data = pa.concat_tables([read_table(path, names) for path in paths])
    solved = data["solved"].to_numpy()
    quantities = {
        "actions a plan": lengths(data["actions"])[solved],
        "transitions a task": data["num_transitions"].to_numpy(),
        "seconds a task": data["seconds"].to_numpy(),
    }
    rows = (
        f"{len(solved)} tasks, {format_rate(int(solved.sum()), len(solved))} % solved"
    )
    table = Table(title=rows, box=SIMPLE_HEAD, title_justify="left")
    for name in ("", "mean", "median", "95th pct", "largest"):
        table.add_column(name, justify="right" if name else "left")
    for name, values in quantities.items():
        if len(values):
            numbers = [values.mean(), *np.percentile(values, [50, 95, 100])]
            table.add_row(name, *(f"{number:.2f}" for number in numbers))
    console.print(table)
    hours = data["seconds"].to_numpy().sum() / 3600
    size = sum(path.stat().st_size for path in paths)
    console.print(
        f"{int(solved.sum()) / max(hours, 1e-9):.0f} plans an hour and core; "
        f"{size / 1e6:.1f} MB in {len(paths)} files of {paths[0].parent}."
    )


@demos.command()
def verify(sources: _Sources, *, workers: NumWorkers = 2) -> None:
    """Executes stored plans again, and says how many still reach the goal.

    The exit status is 0 if all do, 1 if not: their states may differ a little, for
    instance on another processor.
    """
    from rich.console import Console

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.learning.demonstration_folder import shard_paths
    from rhp_drake.learning.replay import verify as verify_files

    console = Console(highlight=False, soft_wrap=True)
    paths = shard_paths(sources)
    replays = []
    with make_progress(console) as progress:
        bar = progress.add_task("Files", total=len(paths))
        for replay in verify_files(paths, workers):
            replays.append(replay)
            progress.advance(bar)
    plans = sum(replay.num_plans for replay in replays)
    reached = sum(replay.reached for replay in replays)
    console.print(f"{reached} of {plans} plans reach the goal again.")
    stored = [replay for replay in replays if replay.identical is not None]
    if stored:
        identical = sum(replay.identical or 0 for replay in stored)
        console.print(
            f"{identical} of {sum(replay.num_plans for replay in stored)} go through "
            "the stored states, bit for bit."
        )
    if reached < plans:
        raise typer.Exit(1)


@demos.command()
def compact(
    sources: _Sources, *, out: Annotated[Path, typer.Option(help="File to write.")]
) -> None:
    """Writes the plans as seeds and actions alone, some ten bytes each."""
    from rhp_drake.files import check_writable
    from rhp_drake.learning.demonstration_folder import shard_paths
    from rhp_drake.learning.replay import compact as compact_files

    check_writable(out)
    plans = compact_files(shard_paths(sources), out)
    print(f"{out}: {plans} plans in {out.stat().st_size / 1e3:.0f} kB.")


@demos.command()
def rebuild(
    source: Annotated[Path, typer.Argument(help="A file that `compact` wrote.")],
    *,
    out: Annotated[Path, typer.Option(help="File to write.")],
) -> None:
    """Executes compact plans again, and writes demonstrations to imitate."""
    from rhp_drake.files import check_writable
    from rhp_drake.learning.replay import rebuild as rebuild_file

    check_writable(out)
    plans = rebuild_file(source, out)
    print(f"{out}: {plans} plans in {out.stat().st_size / 1e6:.1f} MB.")
