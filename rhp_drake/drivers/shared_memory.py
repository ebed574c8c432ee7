"""A vector that one process writes and any other reads, without a lock."""

import ctypes
from multiprocessing.sharedctypes import RawArray
import time
from typing import Any, Final
import zlib

import numpy as np

# Before the values of a slot: their checksum and their time stamp.
_HEADER: Final = 2
# A copy fails only if a write ends meanwhile.  Several in a row mean a writer without
# a pause, for which nobody should wait.
_ATTEMPTS: Final = 8


class SharedVector:
    """A vector of float64 in shared memory, with the time of its last write.

    One process or thread writes, any number read, and none ever waits for another.  A
    write goes to the slot, of two, that is not the newest, and then counts: a process
    that is killed while it writes leaves the last whole vector in place, and another
    may write on.

    It is handed to a process as an argument, when that is spawned.  The memory has no
    name, so that nothing is left of it once all its processes are gone, however they
    end.  Whoever created it must keep it as long as another process writes: Python
    uses the memory anew.

    Args:
        size: Number of elements, at least 1.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"a shared vector has at least one element, not {size}.")
        self._Attach(RawArray(ctypes.c_double, 1 + 2 * (_HEADER + size)))

    def __getstate__(self) -> Any:
        return self._memory

    def __setstate__(self, memory: Any) -> None:
        self._Attach(memory)

    def _Attach(self, memory: Any) -> None:
        self._memory = memory
        elements = np.frombuffer(memory, dtype=np.float64)
        # The number of writes, also the sequence counter: its parity is the newest
        # slot's.  An aligned float64 is read and written in one piece.
        self._count = elements[:1]
        self._slots = elements[1:].reshape(2, -1)
        self._next = np.empty_like(self._slots[0])
        # The newest consistent copy that this reader has.
        self._last = np.full_like(self._next, np.nan)

    @property
    def size(self) -> int:
        """Number of elements."""
        return len(self._next) - _HEADER

    def write(self, values: np.ndarray) -> None:
        """Replaces all elements.

        Args:
            values: Shape (size,).

        Raises:
            ValueError: If the shape is another.
        """
        if np.shape(values) != (self.size,):
            raise ValueError(
                f"the shared vector has shape ({self.size},), not {np.shape(values)}."
            )
        self._next[_HEADER:] = values
        self._next[1] = time.monotonic()
        self._next[0] = zlib.crc32(self._next[1:])
        count = self._count[0] + 1
        self._slots[int(count) % 2] = self._next
        self._count[0] = count

    def read(self) -> tuple[np.ndarray, float]:
        """A copy of the newest vector, and when it was written.

        If the writer leaves no time for a copy, it is the newest that this reader
        could get before.

        Returns:
            The values, shape (size,), and the time stamp in s of `time.monotonic`,
            which all processes of a machine share.  Both are nan before the first
            write.
        """
        for _ in range(_ATTEMPTS):
            count = self._count[0]
            if count == 0:
                break
            copy = self._slots[int(count) % 2].copy()
            # An x86 keeps the order of writes, so that the counter tells a torn copy.
            # Other processors may not; there the checksum tells.
            if self._count[0] == count and copy[0] == zlib.crc32(copy[1:]):
                self._last = copy
                break
        last = self._last
        return last[_HEADER:].copy(), float(last[1])
