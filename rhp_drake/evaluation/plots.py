"""Pictures of results."""

from collections.abc import Mapping, Sequence
import io
from pathlib import Path
from typing import Any, Final

import matplotlib
from matplotlib.figure import Figure

from rhp_drake.evaluation.figure4_data import NUM_BATCHES, CurvePoint
from rhp_drake.evaluation.paper_results import IMITATION, TABLE1
from rhp_drake.files import write_atomically
from rhp_drake.frozen_instances import SET_SIZE

STYLE: Final[dict[Any, Any]] = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "0.4",
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "0.9",
    "xtick.color": "0.25",
    "ytick.color": "0.25",
    "legend.frameon": False,
    # The same numbers make the same file.
    "svg.hashsalt": "rhp_drake",
}
_OURS: Final = "#0a6e8a"
PAPER_COLOR: Final = "#b5540f"
# The end of the paper's curve: plans, and success in %.
_PAPER_PLANS: Final = 9000
_PAPER_PERCENT: Final = TABLE1["gp", IMITATION]["none"].percent


def draw_figure4(points: Sequence[CurvePoint]) -> Figure:
    """Success by number of plans, and where the paper's curve ends."""
    plans = [point.num_plans for point in points]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.8, 4.2), layout="constrained")
        axes = figure.add_subplot()
        axes.set_xlabel("number of plans imitated")
        axes.set_ylabel("tasks solved by the greedy policy (%)")
        axes.set_xlim(0, 1.04 * max(_PAPER_PLANS, *plans))
        axes.set_ylim(0, 100)
        axes.axhline(
            _PAPER_PERCENT, color=PAPER_COLOR, linestyle=(0, (4, 4)), linewidth=1
        )
        # The last point may lie on the axes' edge: none is clipped.
        axes.plot(_PAPER_PLANS, _PAPER_PERCENT, "D", color=PAPER_COLOR, clip_on=False)
        axes.annotate(
            f"the paper, on its own tasks: {_PAPER_PERCENT:.0f} % "
            f"with {_PAPER_PLANS} plans",
            (_PAPER_PLANS, _PAPER_PERCENT),
            xytext=(0, -9),
            textcoords="offset points",
            color=PAPER_COLOR,
            horizontalalignment="right",
            verticalalignment="top",
        )
        axes.fill_between(
            plans,
            [100 * point.low for point in points],
            [100 * point.high for point in points],
            color=_OURS,
            alpha=0.18,
            linewidth=0,
            label=f"95 % confidence interval (t, {NUM_BATCHES} batches of "
            f"{SET_SIZE // NUM_BATCHES} tasks)",
        )
        several = any(len(point.seed_rates) > 1 for point in points)
        if several:
            axes.plot(
                [point.num_plans for point in points for _ in point.seed_rates],
                [100 * rate for point in points for rate in point.seed_rates],
                "_",
                color=_OURS,
                clip_on=False,
                label="one training",
            )
        axes.plot(
            plans,
            [100 * point.success for point in points],
            "-o",
            color=_OURS,
            linewidth=1.8,
            markersize=5,
            clip_on=False,
            label="mean over trainings" if several else "this repository",
        )
        axes.legend(loc="lower right", reverse=True)
    return figure


def draw_learning_curves(
    curves: Mapping[str, Sequence[tuple[Sequence[int], Sequence[float]]]],
) -> Figure:
    """Success of the greedy policy while it learns.

    Args:
        curves: For each method, by its name, a pair a seed: gradient steps, and the
            share of tasks that is solved after them.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.8, 4.2), layout="constrained")
        axes = figure.add_subplot()
        axes.set_xlabel("gradient steps")
        axes.set_ylabel("validation tasks solved by the greedy policy (%)")
        axes.set_ylim(0, 100)
        for number, (name, of_seeds) in enumerate(curves.items()):
            color = matplotlib.colormaps["tab20"](number % 20)
            for k, (steps, rates) in enumerate(of_seeds):
                axes.plot(
                    steps,
                    [100 * rate for rate in rates],
                    color=color,
                    linewidth=1.4,
                    label=name.replace("_", " ") if k == 0 else None,
                )
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def save_picture(figure: Figure, path: Path) -> None:
    """Writes a picture as `path` with the suffixes .svg and .png."""
    write_atomically(path.with_suffix(".svg"), to_svg(figure))
    write_atomically(path.with_suffix(".png"), _save(figure, "png", {}))


def to_svg(figure: Figure) -> str:
    """A picture as text, the same for the same numbers."""
    return _save(figure, "svg", {"Date": None}).decode()


def _save(figure: Figure, name: str, metadata: dict[str, Any]) -> bytes:
    picture = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(picture, format=name, dpi=160, metadata=metadata)
    return picture.getvalue()
