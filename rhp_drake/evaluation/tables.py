"""Results of policies as tables for the terminal."""

from collections.abc import Callable, Sequence
import math

from rich.box import SIMPLE_HEAD
from rich.table import Table

from rhp_drake.evaluation.cells import Cell, Cells, failure_causes, paper_cell
from rhp_drake.evaluation.experiment import Column
from rhp_drake.frozen_instances import NUM_OBJECTS


def make_success_table(
    cells: Cells, title: str, num_objects: int = NUM_OBJECTS
) -> Table:
    """A table of success and cost, a row a policy and level.

    Beside the success stands the paper's, if there are as many objects.  Actions and
    computation are means over the runs that succeeded; the last number, where time
    flows, is simulated time over the world's own computation.
    """
    time_flows = any(
        cell.real_time_rate for by_level in cells.values() for cell in by_level.values()
    )
    headings = [
        "success %\n(95 % Wilson)",
        "paper\n%",
        "\nactions",
        "ms a decision\np50 / p95",
        "thinks\ns a run",
        *(["x real\ntime"] if time_flows else []),
    ]

    def texts(column: Column, level: str, cell: Cell) -> list[str]:
        paper = paper_cell(column, level) if num_objects == NUM_OBJECTS else None
        p50, p95 = map(cell.decision_milliseconds, (50, 95))
        row = [
            cell.rate,
            f"{paper.percent}" if paper else "",
            format_number(cell.num_actions),
            # A policy that fails at once decides nothing.
            " / ".join(filter(None, map(format_milliseconds, (p50, p95)))),
            format_number(cell.thinking_seconds, 2),
        ]
        if time_flows:
            row.append(f"{cell.real_time_rate or 0:.1f}")
        return row

    return _table_by_policy(cells, title, headings, texts)


def make_failure_table(cells: Cells) -> Table:
    """How often the runs failed by each cause, a row a policy and level."""
    causes = failure_causes(cells)

    def texts(column: Column, level: str, cell: Cell) -> list[str]:
        return [str(cell.causes[cause] or "") for cause in causes]

    # A line a word: the station has many causes.
    headings = [cause.replace(" ", "\n") for cause in causes]
    return _table_by_policy(cells, "Failures", headings, texts)


def make_ending_table(cells: Cells, count: int) -> Table:
    """The first so many failures one by one."""
    failures = [
        (trial, episode)
        for by_level in cells.values()
        for cell in by_level.values()
        for trial, episode in cell.results
        if not episode.succeeded
    ]
    title = "Failures one by one"
    if len(failures) > count:
        title = f"The first {count} failures of {len(failures)}"
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    for heading in ("policy", "level", "task", "trial", "cause", "ending"):
        table.add_column(heading)
    for trial, episode in failures[:count]:
        table.add_row(
            str(trial.column),
            trial.level,
            str(trial.index),
            str(trial.number),
            episode.outcome,
            episode.ending,
        )
    return table


def format_number(value: float, decimals: int = 1) -> str:
    """A number for people, nothing for nan."""
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def format_milliseconds(value: float) -> str:
    """With a decimal below 100, nothing for nan."""
    return format_number(value, 0 if value >= 100 else 1)


def _table_by_policy(
    cells: Cells,
    title: str,
    headings: Sequence[str],
    texts: Callable[[Column, str, Cell], list[str]],
) -> Table:
    """A table of what `texts` says of each cell.

    Weights and levels have a column each if there are several.
    """
    # Without frames, it fits into 80 columns.
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    levels = {level for by_level in cells.values() for level in by_level}
    weights = {column.weights for column in cells} - {""}
    labels = ["policy", *["weights"] * (len(weights) > 1)]
    labels += ["level"] * (len(levels) > 1)
    for heading in labels:
        table.add_column(heading, no_wrap=True, vertical="bottom")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for column, by_level in cells.items():
        names = [column.policy, column.weights][: 1 + (len(weights) > 1)]
        for level, cell in by_level.items():
            row = [*names, *[level] * (len(levels) > 1)]
            table.add_row(*row, *texts(column, level, cell))
            # Once is enough.
            names = [""] * len(names)
    return table
