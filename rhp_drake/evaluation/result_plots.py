"""Pictures of how often policies succeed."""

from collections.abc import Mapping
from typing import Final

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
    "": ("--", "the paper"),
    IMITATION: (":", "the paper, imitation"),
    REINFORCEMENT: ("--", "the paper, reinforcement"),
}


def draw_success(cells: Cells) -> Figure:
    """Success by level of uncertainty, a panel a policy that has a Q-network.

    Those that have none share a panel.
    """
    panels: dict[str, list[Column]] = {}
    for column in cells:
        name = column.policy if column.weights else "no network"
        panels.setdefault(name, []).append(column)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(3.1 * len(panels) + 1, 3.6), layout="constrained")
        # One row, so that heights can be compared.
        of_panels = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, columns) in zip(of_panels, panels.items(), strict=True):
            axes.set_title(name)
            _draw_panel(axes, {column: cells[column] for column in columns})
        of_panels[0].set_ylabel("success (%)")
        of_panels[0].set_ylim(0, 102)
        figure.supxlabel("uncertainty of the physics", fontsize=11)
    return figure


def _draw_panel(axes: Axes, cells: Mapping[Column, Mapping[str, Cell]]) -> None:
    levels = [
        level
        for level in UNCERTAINTY_LEVELS
        if any(level in by_level for by_level in cells.values())
    ]
    axes.set_xticks(range(len(levels)), levels)
    axes.set_xlim(-0.3, len(levels) - 0.7)
    for number, (column, by_level) in enumerate(cells.items()):
        there = [level for level in levels if level in by_level]
        of_levels = [by_level[level] for level in there]
        percents = [cell.percent for cell in of_levels]
        axes.errorbar(
            [levels.index(level) for level in there],
            percents,
            yerr=_bars(of_levels),
            color=_COLORS[number % len(_COLORS)],
            marker="o",
            markersize=4,
            linewidth=1.6,
            capsize=2,
            label=column.weights or column.policy,
        )
    # The paper's columns of the same policies, each once.
    for policy in dict.fromkeys(column.policy for column in cells):
        for learned, (line, label) in _PAPER_LINES.items():
            if paper := TABLE1.get((policy, learned)):
                axes.plot(
                    range(len(levels)),
                    [paper[level].percent for level in levels],
                    line,
                    color=PAPER_COLOR,
                    linewidth=1.2,
                    label=label,
                )
    axes.legend(loc="lower left", fontsize=8)


def draw_success_by_time(cells: Cells) -> Figure:
    """Success against mean computation of a decision, a panel a level."""
    levels = [
        level
        for level in UNCERTAINTY_LEVELS
        if any(level in by_level for by_level in cells.values())
    ]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.2 * len(levels) + 1.2, 4.4), layout="constrained")
        of_levels = figure.subplots(1, len(levels), sharey=True, squeeze=False)[0]
        for axes, level in zip(of_levels, levels, strict=True):
            axes.set_title(f"uncertainty: {level}")
            axes.set_xscale("log")
            for number, (column, by_level) in enumerate(cells.items()):
                if level not in by_level:
                    continue
                cell = by_level[level]
                axes.errorbar(
                    [max(cell.mean_decision_milliseconds, 1e-2)],
                    [cell.percent],
                    yerr=_bars([cell]),
                    color=_COLORS[number % len(_COLORS)],
                    marker="osD^v"[number // len(_COLORS) % 5],
                    markersize=6,
                    linestyle="none",
                    capsize=2,
                    label=str(column),
                )
        of_levels[0].set_ylabel("success (%)")
        of_levels[0].set_ylim(0, 102)
        figure.supxlabel("computation of a decision, mean (ms)", fontsize=11)
        handles, labels = of_levels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center", fontsize=9)
    return figure


def _bars(cells: list[Cell]) -> list[list[float]]:
    """How far Wilson's intervals go down and up from the success."""
    return [
        [cell.percent - cell.wilson[0] for cell in cells],
        [cell.wilson[1] - cell.percent for cell in cells],
    ]
