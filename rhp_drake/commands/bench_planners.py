"""`rhp bench planners`: our planners beside OMPL's."""

from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import NumWorkers, Seed

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rhp_drake.benchmarks.planners import PlannerResult

# s: success is looked at after these times, and at the limit.
_TIMES = (10.0, 30.0, 60.0)


def planners(
    *,
    planners: Annotated[
        str,
        typer.Option(
            help="Any of rrt, rrt_first (the same up to its first plan), best_first "
            "(guided by the Q-network), ompl_rrt, ompl_sst."
        ),
    ] = "rrt,rrt_first,best_first,ompl_rrt,ompl_sst",
    instances: Annotated[
        str, typer.Option(help="The set: evaluation (never tune on it) or validation.")
    ] = "validation",
    count: Annotated[
        int, typer.Option(min=1, max=500, help="The first so many of the set.")
    ] = 500,
    time_limit: Annotated[
        float, typer.Option(min=1, help="Of computation for each search, s.")
    ] = 60.0,
    seed: Seed = 0,
    workers: NumWorkers = 2,
) -> None:
    """Compares our planners with OMPL's RRT and SST on the same push model.

    Searches end at a limit of time, so that results depend on the machine, and
    on what else it does: leave a core to each worker.

    OMPL comes with the extra "bench" of this project.
    """
    from importlib.metadata import version
    from importlib.util import find_spec

    from rich.console import Console
    from rich.progress import track

    from rhp_drake.benchmarks.planners import check_planners, compare_planners
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.frozen_instances import load_instances

    # A planner named twice would count each of its searches twice.
    names = list(dict.fromkeys(planners.split(",")))
    check_planners(names)
    load_instances(instances)
    console = Console()
    results = list(
        track(
            compare_planners(names, instances, count, time_limit, seed, workers),
            description="Searches",
            total=len(names) * count,
            console=console,
        )
    )
    by_planner = {
        name: [result for trial, result in results if trial.planner == name]
        for name in names
    }
    title = f"First {count} instances of the {instances} set"
    console.print(_success_table(by_planner, time_limit, title))
    console.print(_effort_table(by_planner, f"{title}: searches that found a plan"))
    ompl = version("ompl") if find_spec("ompl") else "none"
    console.print(f"{describe_machine(workers)}, ompl {ompl}")


def _success_table(
    by_planner: "dict[str, list[PlannerResult]]", time_limit: float, title: str
) -> "Table":
    """Success by when the first plan was found."""
    from rich.table import Table

    from rhp_drake.evaluation.statistics import format_rate

    times = [*(t for t in _TIMES if t < time_limit), time_limit]
    table = Table(title=f"{title}: success, % (95 % Wilson)")
    table.add_column("planner")
    for seconds in times:
        table.add_column(f"within {seconds:g} s", justify="right")
    for name, results in by_planner.items():
        cells = [
            format_rate(
                sum(r.solved and r.first_seconds <= seconds for r in results),
                len(results),
            )
            for seconds in times
        ]
        table.add_row(name, *cells)
    return table


def _effort_table(by_planner: "dict[str, list[PlannerResult]]", title: str) -> "Table":
    """Time, simulated transitions and length of the plans found.

    Times are of whole searches, shortening the plan included; transitions a second are
    of all searches.
    """
    import numpy as np
    from rich.table import Table

    table = Table(title=title)
    table.add_column("planner")
    for heading in (
        "s: mean, median",
        "95th pct",
        "simulated: mean, median",
        "actions: mean, median",
        "sim. / s",
    ):
        table.add_column(heading, justify="right")
    for name, results in by_planner.items():
        solved = [r for r in results if r.solved]
        seconds = [r.seconds for r in solved] or [np.nan]
        total_seconds = sum(r.seconds for r in results)
        table.add_row(
            name,
            _mean_and_median(seconds, 2),
            f"{np.percentile(seconds, 95):.2f}",
            _mean_and_median([r.num_transitions for r in solved], 0),
            _mean_and_median([r.num_actions for r in solved], 1),
            f"{sum(r.num_transitions for r in results) / total_seconds:.0f}",
        )
    return table


def _mean_and_median(values: "Sequence[float]", digits: int) -> str:
    """The two in one cell."""
    import numpy as np

    values = values or [np.nan]
    return f"{np.mean(values):.{digits}f}, {np.median(values):.{digits}f}"
