"""How long it is from one command to the next, as a histogram."""

from typing import Final

import numpy as np

# Longer periods than the last bin's fall into it.
BIN_WIDTH: Final = 2e-5  # s
_NUM_BINS: Final = 1000


class CommandPeriods:
    """A histogram of periods, with their sum and the longest.

    It lives in a plain vector, so that it can be shared between processes.

    Args:
        vector: Of a histogram, shape (`SIZE`,); an empty one if None.
    """

    SIZE: Final = _NUM_BINS + 2

    def __init__(self, vector: np.ndarray | None = None) -> None:
        self.vector = np.zeros(self.SIZE) if vector is None else vector
        # Views.
        self._counts, self._rest = np.split(self.vector, [_NUM_BINS])

    def add(self, period: float) -> None:
        """Counts one, s."""
        self._counts[min(int(period / BIN_WIDTH), _NUM_BINS - 1)] += 1
        self._rest[0] += period
        self._rest[1] = max(self._rest[1], period)

    def merge(self, other: "CommandPeriods") -> None:
        """Counts all of another histogram."""
        longest = max(self.longest, other.longest)
        self.vector += other.vector
        self._rest[1] = longest

    @property
    def count(self) -> int:
        """How many there were."""
        return int(self._counts.sum())

    @property
    def mean(self) -> float:
        """In s; nan if there were none."""
        return float(self._rest[0] / self.count) if self.count else float("nan")

    @property
    def longest(self) -> float:
        """In s; 0 if there were none."""
        return float(self._rest[1])

    def quantile(self, share: float) -> float:
        """The period, s, that this share of them does not exceed; nan if none were.

        No more than a bin's width too long; of periods in the last bin, the longest.
        """
        if not self.count:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self._counts), share * self.count))
        last = index >= _NUM_BINS - 1
        return self.longest if last else (index + 1) * BIN_WIDTH
