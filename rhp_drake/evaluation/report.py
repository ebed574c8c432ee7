"""What a folder of results comes to: tables, pictures, recordings, and a page of all.

`report.md` and `report.html` say the same.  The page holds its pictures, so that it can
be sent; recordings are files beside it.
"""

import base64
from collections.abc import Collection, Iterator
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from rhp_drake.evaluation.cells import (
    Cell,
    Cells,
    compare,
    failure_causes,
    group,
    paper_cell,
)
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.experiment import BATCH_SIZE, Column, Trial, drawn_physics
from rhp_drake.evaluation.figure4_data import curve
from rhp_drake.evaluation.figure4_data import read_results as read_figure4
from rhp_drake.evaluation.paper_results import PaperCell
from rhp_drake.evaluation.plots import draw_figure4, save_picture, to_svg
from rhp_drake.evaluation.result_plots import draw_success, draw_success_by_time
from rhp_drake.evaluation.results import Results, read_results
from rhp_drake.evaluation.statistics import bonferroni
from rhp_drake.evaluation.tables import format_milliseconds, format_number
from rhp_drake.files import make_folder, write_atomically
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances

_RECORDINGS: Final = "recordings"
# Where `rhp figure4 --out` may have put its results.
_FIGURE4: Final = Path("figure4/figure4.csv")


@dataclass(frozen=True)
class ShownCell:
    """A cell of Table I beside the paper's.

    Attributes:
        ours: Our episodes.
        paper: The paper's cell, None if it has no such policy.
    """

    ours: Cell
    paper: PaperCell | None

    @property
    def difference(self) -> float:
        """Our success less the paper's, percentage points; nan without the paper's."""
        return self.ours.percent - self.paper.percent if self.paper else math.nan


@dataclass(frozen=True)
class Picture:
    """A picture of the report.

    Attributes:
        name: Of its files, without suffix.
        caption: One sentence.
        data: As a data URI, so that a page can hold it.
    """

    name: str
    caption: str
    data: str


@dataclass(frozen=True)
class Recording:
    """A failure to look at.

    Attributes:
        trial: Which.
        episode: How it went.
        path: Of the recording, from the report's folder.
    """

    trial: Trial
    episode: Episode
    path: Path


@dataclass(frozen=True)
class Report:
    """What was written, and what is in it.

    Attributes:
        markdown: The file `report.md`.
        page: The file `report.html`.
    """

    markdown: Path
    page: Path


def write_report(folder: Path, num_recordings: int) -> Report:
    """Writes the report of a folder of results, into the folder.

    Args:
        folder: See `results`.  With `rhp figure4`'s results in `figure4` the report has
            them, too.
        num_recordings: So many failures of the most successful policies are recorded.

    Raises:
        InputError: If it is no folder of results, or holds none.
    """
    results = read_results(folder)
    make_folder(folder)
    cells = group(results.episodes)
    pictures = list(_pictures(folder, results, cells))
    recordings = list(_record_failures(folder, results, cells, num_recordings))
    context = _context(results, cells) | {
        "pictures": pictures,
        "recordings": recordings,
    }
    templates = Environment(
        loader=PackageLoader("rhp_drake.evaluation"),
        autoescape=lambda name: name is not None and name.startswith("report.html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {
        "number": format_number,
        "milliseconds": format_milliseconds,
        "p_value": _p_value,
    }
    written = []
    for name in ("report.md", "report.html"):
        text = templates.get_template(f"{name}.jinja").render(context)
        write_atomically(folder / name, text)
        written.append(folder / name)
    return Report(*written)


def _context(results: Results, cells: Cells) -> dict[str, Any]:
    """What both templates know."""
    # Work that is going on may have nothing yet of some.
    there = {level for of_column in cells.values() for level in of_column}
    levels = [level for level in results.settings["levels"] if level in there]
    rows = {
        level: {
            column: ShownCell(of_column[level], _paper(results, column, level))
            for column, of_column in cells.items()
            if level in of_column
        }
        for level in levels
    }
    trials = [trial for trial, _ in results.episodes]
    # What each cell would have had if all had been run alike.
    wanted = {(trial.index, trial.number) for trial in trials}
    comparisons = {level: _comparisons(cells, level) for level in levels}
    return {
        "settings": results.settings,
        "levels": levels,
        "columns": list(cells),
        "rows": rows,
        "causes": failure_causes(cells),
        "comparisons": comparisons,
        "paired": any(comparisons.values()),
        "num_episodes": len(trials),
        "num_instances": len({trial.index for trial in trials}),
        "num_trials": len({trial.number for trial in trials}),
        "complete": len(trials) == len(wanted) * len(cells) * len(levels),
        "batch_size": BATCH_SIZE,
        "hours": sum(episode.seconds for _, episode in results.episodes) / 3600,
        "commits": results.commits,
        "machines": results.machines,
        "isnan": math.isnan,
    }


def _paper(results: Results, column: Column, level: str) -> PaperCell | None:
    return paper_cell(column, level) if _as_the_paper(results) else None


def _as_the_paper(results: Results) -> bool:
    """Whether the tasks have as many objects as the paper's."""
    return bool(results.settings["num_objects"] == NUM_OBJECTS)


def _comparisons(
    cells: Cells, level: str
) -> dict[tuple[Column, Column], tuple[int, int, float]]:
    """McNemar's test of each pair of columns, the p-values times their number."""
    at_level = {
        c: of_column[level] for c, of_column in cells.items() if level in of_column
    }
    columns = list(at_level)
    pairs = [(a, b) for i, a in enumerate(columns) for b in columns[:i]]
    found = {pair: compare(at_level[pair[0]], at_level[pair[1]]) for pair in pairs}
    tested = {pair: result for pair, result in found.items() if result is not None}
    return {
        pair: (first, second, bonferroni(p, len(tested)))
        for pair, (first, second, p) in tested.items()
    }


def _p_value(p: float) -> str:
    """A p-value for people."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _pictures(folder: Path, results: Results, cells: Cells) -> Iterator[Picture]:
    """Draws the pictures, and writes them as files."""

    def make(name: str, caption: str, figure: Figure) -> Picture:
        save_picture(figure, folder / name)
        data = base64.b64encode(to_svg(figure).encode()).decode()
        return Picture(name, caption, f"data:image/svg+xml;base64,{data}")

    with_paper = _as_the_paper(results)
    of_paper = "; dashed and dotted: the paper, on its own tasks" if with_paper else ""
    yield make(
        "success",
        "Success by how much the world's physics differ from what the policy believes, "
        f"with Wilson's 95 % intervals{of_paper}.",
        draw_success(cells, with_paper),
    )
    yield make(
        "success_by_time",
        "Success against mean computation of a decision, with Wilson's 95 % intervals; "
        "a panel a level of uncertainty.",
        draw_success_by_time(cells),
    )
    if (folder / _FIGURE4).exists():
        points = curve(read_figure4(folder / _FIGURE4))
        yield make(
            "figure4_of_report",
            "The paper's Figure 4: the greedy policy, by how many plans it imitated.",
            draw_figure4(points),
        )


def _record_failures(
    folder: Path, results: Results, cells: Cells, count: int
) -> Iterator[Recording]:
    """Records failures, those of the most successful policy first, level by level."""
    best_first = sorted(
        cells.values(), key=lambda by_level: -_mean_percent(by_level.values())
    )
    failures = [
        (trial, episode)
        for by_level in best_first
        for cell in by_level.values()
        for trial, episode in cell.results
        if not episode.succeeded
    ][:count]
    if not failures:
        return
    from rhp_drake.evaluation.recording import record_episode
    from rhp_drake.visualization import MakeMeshcat, VisualizationConfig

    settings = results.settings
    instances = load_instances(settings["instances"], settings["num_objects"])
    meshcat = MakeMeshcat(VisualizationConfig())
    for trial, episode in failures:
        instance = instances[trial.index]
        physics = drawn_physics(trial, instance, settings["seed"])
        html = record_episode(meshcat, episode.states, instance.goals, physics)
        name = f"{trial.column} {trial.level} {trial.index} {trial.number}.html"
        path = Path(_RECORDINGS) / name.replace(" ", "_")
        write_atomically(folder / path, html)
        yield Recording(trial, episode, path)


def _mean_percent(cells: Collection[Cell]) -> float:
    return sum(cell.percent for cell in cells) / len(cells)
