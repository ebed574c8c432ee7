"""Pictures of how often policies succeed."""

from collections.abc import Iterable, Sequence
import math
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rhp_drake.evaluation.cells import Cell, Cells
from rhp_drake.evaluation.experiment import Column
from rhp_drake.evaluation.paper_results import IMITATION, REINFORCEMENT, TABLE1
from rhp_drake.evaluation.plots import PAPER_COLOR, STYLE
from rhp_drake.physics import UNCERTAINTY_LEVELS

_COLORS: Final = matplotlib.colormaps["tab10"].colors  # type: ignore[attr-defined]
_PAPER_LINES: Final = {
    "": ("-.", "the paper"),
    IMITATION: (":", "the paper, imitation"),
    REINFORCEMENT: ("--", "the paper, reinforcement"),
}
# Columns of a panel stand so far apart, in levels: else their bars hide one another.
_DODGE: Final = 0.08
# A marker at 100 % is whole.
_TOP_PERCENT: Final = 103
# ms; the axis is logarithmic.
_SHORTEST_TIME: Final = 1e-2
# Of an entry of a legend, inches.
_ENTRY_WIDTH: Final = 2.0


def draw_success(cells: Cells, with_paper: bool) -> Figure:
    """Success by level of uncertainty, a panel a policy that has a Q-network.

    Those that have none share a panel.

    Args:
        cells: What to draw.
        with_paper: Whether to draw the paper's success of the same policies, too.
    """
    panels: dict[str, list[Column]] = {}
    for column in cells:
        name = column.policy if column.weights else "no network"
        panels.setdefault(name, []).append(column)
    # The same weights have the same color in each panel.
    labels = list(dict.fromkeys(map(_label, cells)))
    levels = _levels(cells)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.6 * len(panels) + 1.6, 4.2), layout="constrained")
        # One row, so that heights can be compared.
        of_panels = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, columns) in zip(of_panels, panels.items(), strict=True):
            axes.set_title(name)
            axes.set_xticks(range(len(levels)), levels)
            axes.set_xlim(-0.4, len(levels) - 0.6)
            for number, column in enumerate(columns):
                by_level = cells[column]
                there = [level for level in levels if level in by_level]
                shift = _DODGE * (number - (len(columns) - 1) / 2)
                _draw_bars(
                    axes,
                    [levels.index(level) + shift for level in there],
                    [by_level[level] for level in there],
                    color=_COLORS[labels.index(_label(column)) % len(_COLORS)],
                    marker="o",
                    markersize=4,
                    linewidth=1.6,
                    label=_label(column),
                )
            if with_paper:
                _draw_paper(axes, columns, levels)
        of_panels[0].set_ylabel("success (%)")
        of_panels[0].set_ylim(0, _TOP_PERCENT)
        figure.supxlabel("uncertainty of the physics", fontsize=11)
        _draw_legend(figure, of_panels, labels)
    return figure


def _draw_paper(axes: Axes, columns: Iterable[Column], levels: Sequence[str]) -> None:
    """Draws the paper's columns of the same policies, each once."""
    for policy in dict.fromkeys(column.policy for column in columns):
        for learned, (line, label) in _PAPER_LINES.items():
            if paper := TABLE1.get((policy, learned)):
                axes.plot(
                    range(len(levels)),
                    [paper[level].percent for level in levels],
                    line,
                    color=PAPER_COLOR,
                    linewidth=1.2,
                    # A single level makes no line.
                    marker="_" if len(levels) == 1 else None,
                    markersize=20,
                    label=label,
                )


def draw_success_by_time(cells: Cells) -> Figure:
    """Success against mean computation of a decision, a panel a level."""
    levels = _levels(cells)
    labels = list(map(str, cells))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.6 * len(levels) + 1.6, 4.2), layout="constrained")
        of_levels = figure.subplots(
            1, len(levels), sharex=True, sharey=True, squeeze=False
        )[0]
        for axes, level in zip(of_levels, levels, strict=True):
            axes.set_title(level)
            axes.set_xscale("log")
            for number, (column, by_level) in enumerate(cells.items()):
                if level not in by_level:
                    continue
                cell = by_level[level]
                if math.isnan(cell.mean_decision_milliseconds):
                    continue  # It failed before it had decided anything.
                _draw_bars(
                    axes,
                    [max(_SHORTEST_TIME, cell.mean_decision_milliseconds)],
                    [cell],
                    color=_COLORS[number % len(_COLORS)],
                    marker="osD^v"[number // len(_COLORS) % 5],
                    markersize=6,
                    linestyle="none",
                    label=str(column),
                )
        of_levels[0].set_ylabel("success (%)")
        of_levels[0].set_ylim(0, _TOP_PERCENT)
        figure.supxlabel("computation of a decision, mean (ms)", fontsize=11)
        _draw_legend(figure, of_levels, labels)
    return figure


def _levels(cells: Cells) -> list[str]:
    """Those that any column has, the least uncertain first."""
    there = {level for by_level in cells.values() for level in by_level}
    return [level for level in UNCERTAINTY_LEVELS if level in there]


def _label(column: Column) -> str:
    """What a column is called in the panel of its policy."""
    return column.weights or column.policy


def _draw_bars(
    axes: Axes, places: Sequence[float], cells: Sequence[Cell], **style: Any
) -> None:
    """Draws successes with Wilson's intervals."""
    percents = [cell.percent for cell in cells]
    below = [cell.percent - cell.wilson[0] for cell in cells]
    above = [cell.wilson[1] - cell.percent for cell in cells]
    axes.errorbar(places, percents, yerr=[below, above], capsize=2, **style)


def _draw_legend(
    figure: Figure, of_panels: Iterable[Axes], labels: Sequence[str]
) -> None:
    """Draws a legend of what any panel has, above: these labels first, each once."""
    handles: dict[str, Any] = {}
    for axes in of_panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    order = dict.fromkeys([*(label for label in labels if label in handles), *handles])
    figure.legend(
        [handles[label] for label in order],
        list(order),
        loc="outside upper center",
        ncols=int(figure.get_figwidth() // _ENTRY_WIDTH),
        fontsize=9,
    )
