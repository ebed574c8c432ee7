"""Table I of the paper: what it reports of its own tasks, in its own simulator."""

from dataclasses import dataclass
from typing import Final

from rhp_drake.physics import UNCERTAINTY_LEVELS

# How the Q-network of a column came about; KDP has none.
IMITATION: Final = "imitation"
REINFORCEMENT: Final = "reinforcement"
# And those that come with this package.
SHIPPED_WEIGHTS: Final = {
    "imitation": IMITATION,
    "imitation_set": IMITATION,
    "paper": REINFORCEMENT,
    "best": REINFORCEMENT,
}


@dataclass(frozen=True)
class PaperCell:
    """A cell of the table.

    Attributes:
        percent: Success, %.
        plus_minus: The number behind the paper's +-, which it does not explain.
        seconds: Mean computation of a successful run, physics included, on an Intel
            Xeon E5-2665.
    """

    percent: float
    plus_minus: float
    seconds: float


def _column(*cells: tuple[float, float, float]) -> dict[str, PaperCell]:
    """Cells by level of uncertainty, in the table's order."""
    return {
        level: PaperCell(*cell)
        for level, cell in zip(UNCERTAINTY_LEVELS, cells, strict=True)
    }


# By policy, and by how its Q-network learned.
TABLE1: Final[dict[tuple[str, str], dict[str, PaperCell]]] = {
    ("kdp", ""): _column(
        (98.0, 2.0, 49.4), (24.5, 17.3, 41.1), (28.5, 25.3, 42.5), (15.7, 15.1, 37.6)
    ),
    ("gp", IMITATION): _column(
        (48.0, 0.0, 0.7), (48.2, 7.7, 0.7), (42.2, 12.4, 0.6), (44.7, 29.9, 0.7)
    ),
    ("rhp33", IMITATION): _column(
        (78.0, 1.9, 5.8), (77.2, 4.4, 6.4), (73.4, 4.9, 7.3), (71.5, 7.2, 7.1)
    ),
    ("rhp66", IMITATION): _column(
        (88.0, 1.9, 17.7), (86.2, 3.5, 18.6), (85.8, 8.7, 19.7), (82.8, 8.1, 14.5)
    ),
    ("gp", REINFORCEMENT): _column(
        (51.5, 5.6, 0.6), (48.6, 6.7, 0.6), (47.3, 9.1, 0.6), (45.6, 10.4, 0.7)
    ),
    ("rhp33", REINFORCEMENT): _column(
        (88.8, 1.3, 7.9), (88.2, 2.8, 8.0), (88.0, 2.4, 8.1), (87.3, 5.1, 8.5)
    ),
    ("rhp66", REINFORCEMENT): _column(
        (94.4, 1.6, 21.2), (94.0, 2.5, 22.7), (91.2, 4.6, 18.4), (90.1, 2.8, 17.3)
    ),
}
