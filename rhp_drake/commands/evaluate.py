"""`rhp evaluate`: policies side by side on a frozen set of instances."""

from contextlib import nullcontext
from pathlib import Path
import tempfile
import time
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rhp_drake.commands.options import NumWorkers, RayAddress, Seed
from rhp_drake.errors import InputError
from rhp_drake.physics import UNCERTAINTY_LEVELS
from rhp_drake.planning.policy_config import POLICIES

# torch and Drake are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rich.console import Console

    from rhp_drake.evaluation.experiment import Experiment
    from rhp_drake.workers import Workers

# The policies of the paper.
_POLICIES: Final = "kdp,gp,rhp33,rhp66"
# So many failures are shown one by one; a folder of results has all.
_NUM_ENDINGS: Final = 10


def evaluate(
    *,
    table1: Annotated[
        bool,
        typer.Option(
            "--table1",
            help="The paper's Table I: its policies, with the weights imitation, paper "
            "and best, all levels, 10 trials on each of the evaluation set's 500 "
            "instances. Other options make it smaller, or larger.",
        ),
    ] = False,
    policies: Annotated[
        str | None,
        typer.Option(
            help=f"Any of {', '.join(POLICIES)}; or with n roll-outs of h actions, "
            f"such as rhp16x8, ps64x8, mppi64x8.  By default {_POLICIES}."
        ),
    ] = None,
    weights: Annotated[
        str | None,
        typer.Option(
            help="Of the Q-networks: imitation, imitation_set, paper, best, or files.  "
            "By default best."
        ),
    ] = None,
    levels: Annotated[
        str | None,
        typer.Option(
            help="Of the uncertainty of the world's physics: any of none, low, medium, "
            "high.  By default none."
        ),
    ] = None,
    instances: Annotated[int, typer.Option(help="The first so many of the set.")] = 500,
    trials: Annotated[
        int | None,
        typer.Option(
            min=1, help="On each instance, in physics of its own.  By default 1."
        ),
    ] = None,
    instance_set: Annotated[
        str | None,
        typer.Option(
            "--set",
            help="The instances: evaluation (never tune on it) or validation, the "
            "default.",
        ),
    ] = None,
    objects: Annotated[
        int, typer.Option(min=1, max=8, help="Of each instance, the target included.")
    ] = 3,
    world: Annotated[
        str,
        typer.Option(
            help="planar, the push model; station, the whole robot; or "
            "package.module:factory, a world of yours (see rhp_drake.evaluation.world)."
        ),
    ] = "planar",
    temperature: Annotated[
        float | None, typer.Option(help="tau of RHP's soft-max, in actions.")
    ] = None,
    seed: Seed = 0,
    workers: NumWorkers = 2,
    ray: RayAddress = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of results, for `rhp report`: a row an episode, in Parquet."
        ),
    ] = None,
) -> None:
    """Compares policies: success with confidence intervals, actions, time.

    With --out you may stop this at any moment: the same command goes on where it was.
    """
    from rich.console import Console

    from rhp_drake.evaluation.experiment import Experiment, make_columns
    from rhp_drake.workers import RayCluster

    if table1 and out is None:
        raise InputError("--table1: takes hours; --out says where to keep the results.")
    weights = weights or ("imitation,paper,best" if table1 else "best")
    levels = levels or (",".join(UNCERTAINTY_LEVELS) if table1 else "none")
    experiment = Experiment(
        make_columns(
            _names(policies or _POLICIES), _names(weights), temperature=temperature
        ),
        # A level named twice would count each of its episodes twice.
        _names(levels),
        instance_set or ("evaluation" if table1 else "validation"),
        objects,
        instances,
        trials or (10 if table1 else 1),
        world,
        seed,
    )
    console = Console(highlight=False)
    who = workers if ray is None else RayCluster(ray)
    with tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder:
        try:
            _run(experiment, Path(folder), who, console)
        except KeyboardInterrupt:
            if out is not None:
                console.print("Stopped; the same command goes on from here.")
            raise typer.Exit(130) from None
        _print_results(experiment, Path(folder), console)
    if out is not None:
        console.print(f"Episodes: {out}; `rhp report {out}` makes a page of them.")


def _names(text: str) -> list[str]:
    """The names in a list, each once."""
    return list(dict.fromkeys(name.strip() for name in text.split(",")))


def _run(
    experiment: "Experiment", folder: Path, workers: "Workers", console: "Console"
) -> None:
    """Runs what the folder lacks, and says how fast."""
    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.evaluation.results import run_experiment
    from rhp_drake.run_record import source_commit

    total = sum(len(batch.indices) for batch in experiment.batches())
    machine = describe_machine(workers if isinstance(workers, int) else None)
    commit = source_commit()
    begin, first = time.perf_counter(), None
    done = 0
    with make_progress(console) as progress:
        bar = progress.add_task("Episodes", total=total)
        for done in run_experiment(folder, experiment, workers, commit, machine):
            first = done if first is None else first
            progress.update(bar, completed=done)
    seconds = time.perf_counter() - begin
    new = done - (first or 0)
    console.print(
        f"{new} episodes in {seconds:.0f} s, {new / seconds:.2f} a second.  {machine}"
    )


def _print_results(experiment: "Experiment", folder: Path, console: "Console") -> None:
    """The tables of all that the folder holds."""
    from rhp_drake.evaluation.cells import group
    from rhp_drake.evaluation.results import read_results
    from rhp_drake.evaluation.tables import (
        make_ending_table,
        make_failure_table,
        make_success_table,
    )
    from rhp_drake.frozen_instances import NUM_OBJECTS

    cells = group(read_results(folder).episodes)
    title = f"{experiment.world} world, {experiment.instances} set"
    if experiment.num_objects != NUM_OBJECTS:
        title += f", {experiment.num_objects} objects"
    levels = {level for by_level in cells.values() for level in by_level}
    if len(levels) == 1:
        title += f", uncertainty: {min(levels)}"
    tables = [make_success_table(cells, title, experiment.num_objects)]
    if any(cell.causes for by_level in cells.values() for cell in by_level.values()):
        tables.append(make_failure_table(cells))
        tables.append(make_ending_table(cells, _NUM_ENDINGS))
    for table in tables:
        console.print(table)
        console.print()
