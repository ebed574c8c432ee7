"""`rhp bench loopback` and `rhp bench faults`: the hardware side, without hardware."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import Seed

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rhp_drake.benchmarks.fault_campaign import Injection
    from rhp_drake.benchmarks.loopback import LoopbackRun


def loopback(
    *,
    instances: Annotated[
        int, typer.Option(min=1, max=500, help="The first so many validation tasks.")
    ] = 20,
) -> None:
    """Runs tasks through ur_rtde and natnet on the virtual lab, and in one process.

    Compares outcomes and decisions, and says how regular the stream of commands is and
    how old the measurements are that decisions are made from.
    """
    from rich.console import Console

    from rhp_drake.benchmarks.loopback import run_both_ways
    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.machine import describe_machine

    console = Console(highlight=False, soft_wrap=True)
    runs: list[LoopbackRun] = []
    with make_progress(console) as progress:
        bar = progress.add_task("Tasks", total=instances)
        for run in run_both_ways(instances):
            runs.append(run)
            progress.advance(bar)
    console.print(_outcome_table(runs))
    console.print(
        "With the number of actions; how many of them are alike until one differs; how "
        "many a policy of another process decides again from the same poses.\n"
    )
    console.print(_timing_table(runs))
    console.print(describe_machine())


def _outcome_table(runs: "Sequence[LoopbackRun]") -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    same = sum(run.in_process[0] == run.over_loopback[0] for run in runs)
    table = Table(
        title=f"Over loopback and in one process: {same} of {len(runs)} end alike",
        box=SIMPLE_HEAD,
        title_justify="left",
        show_edge=False,
    )
    table.add_column("task", justify="right")
    for heading in ("in one process", "over loopback"):
        table.add_column(heading, no_wrap=True)
    for heading in ("alike", "again", "s"):
        table.add_column(heading, justify="right")
    for run in runs:
        table.add_row(
            str(run.index),
            *(
                f"{status.replace('_', ' ')}, {actions}"
                for status, actions in (run.in_process, run.over_loopback)
            ),
            str(run.common),
            f"{run.recomputed}/{run.num_decisions}",
            f"{run.seconds:.1f}",
        )
    return table


def _timing_table(runs: "Sequence[LoopbackRun]") -> "Table":
    import numpy as np
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from rhp_drake.drivers.command_periods import CommandPeriods

    table = Table(
        title="Over loopback, while policies think and act",
        box=SIMPLE_HEAD,
        title_justify="left",
        show_edge=False,
    )
    table.add_column("ms")
    for heading in ("mean", "median", "p99", "p99.9", "longest", "number"):
        table.add_column(heading, justify="right")
    periods = CommandPeriods()
    for run in runs:
        periods.merge(run.periods)
    quantiles = [periods.quantile(share) for share in (0.5, 0.99, 0.999)]
    table.add_row(
        "period of commands",
        *(
            f"{1000 * value:.2f}"
            for value in (periods.mean, *quantiles, periods.longest)
        ),
        str(periods.count),
    )
    for name, values in (
        ("age of the arm's position", [run.arm_ages for run in runs]),
        ("age of the oldest pose", [run.object_ages for run in runs]),
    ):
        # The first is of before the run.
        ages = 1000 * np.concatenate([of_run[1:] for of_run in values])
        table.add_row(
            name,
            f"{ages.mean():.2f}",
            *(f"{x:.2f}" for x in np.percentile(ages, [50, 99, 99.9, 100])),
            str(len(ages)),
        )
    return table


def faults(
    *,
    out: Annotated[Path, typer.Option(help="Folder of the results.")],
    count: Annotated[int, typer.Option(min=1, help="Injections, of all kinds.")] = 1000,
    seed: Seed = 0,
) -> None:
    """Lets things go wrong at random moments, over loopback, in real time.

    You may stop this at any moment: the same command goes on where it was. The exit
    status is 1 if anything was not as it has to be.
    """
    from collections import Counter

    from rich.console import Console

    from rhp_drake.benchmarks.fault_campaign import LAB_STALL, run_campaign
    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.machine import describe_machine

    console = Console(highlight=False, soft_wrap=True)
    injections: list[Injection] = []
    try:
        with make_progress(console) as progress:
            bar = progress.add_task("Injections", total=count)
            for injection in run_campaign(out / "injections.json", count, seed):
                injections.append(injection)
                progress.advance(bar)
    except KeyboardInterrupt:
        console.print("Stopped; the same command goes on from here.")
        raise typer.Exit(130) from None
    console.print(_fault_table(injections))
    wrong = [x for x in injections if x.bad_command or x.problem]
    for x in wrong:
        console.print(
            f"{x.index}: {x.kind}: {x.bad_command} {x.problem} ({x.said}); "
            f"the lab itself stood still for {x.lab_gap_ms:.0f} ms."
        )
    commands = sum(x.num_commands for x in injections)
    console.print(
        f"{len(injections)} injections, {commands} positions sent, "
        f"{sum(bool(x.bad_command) for x in injections)} runs with one out of limits, "
        f"{len(wrong)} with something wrong."
    )
    alarms = [alarm for x in injections for alarm in x.false_alarms]
    console.print(
        "Runs that ended before for nothing: "
        f"{dict(Counter(name for name, _ in alarms)) or 'none'}; in "
        f"{sum(gap > LAB_STALL for _, gap in alarms)} of them the lab itself had stood "
        f"still for more than {LAB_STALL:.0f} ms."
    )
    console.print(describe_machine())
    raise typer.Exit(1 if wrong else 0)


def _fault_table(injections: "Sequence[Injection]") -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from rhp_drake.benchmarks.fault_campaign import HOLD_TIME, summarize

    table = Table(
        title="Faults by kind, and how soon a moving arm held its place: median and "
        f"longest (at most {1000 * HOLD_TIME:.0f} ms)",
        box=SIMPLE_HEAD,
        title_justify="left",
        show_edge=False,
    )
    table.add_column("what goes wrong", no_wrap=True)
    for heading in ("runs", "moving", "ended", "named", "ms", "max"):
        table.add_column(heading, justify="right")
    for row in summarize(injections):
        median, longest = row.hold_ms
        table.add_row(
            row.kind,
            *map(str, (row.count, row.moving, row.stopped, row.named)),
            *("" if math.isnan(ms) else f"{ms:.0f}" for ms in (median, longest)),
        )
    return table
