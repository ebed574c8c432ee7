"""The process in which a driver receives."""

from collections.abc import Callable
import multiprocessing
from multiprocessing.process import BaseProcess
from typing import Any
import weakref


class ReceiverProcess:
    """Runs a function in a process of its own, which has nothing to save.

    It ends with `stop`, with this object, or, if the function calls `follow_parent`,
    with the process that started it.

    Args:
        name: Of the process.
        target: What it does; picklable, and does not return.
    """

    def __init__(self, name: str, target: Callable[..., None]) -> None:
        self._name = name
        self._target = target
        self._end: weakref.finalize | None = None

    @property
    def is_running(self) -> bool:
        """Whether it was started, and not stopped since."""
        return self._end is not None

    def start(self, args: tuple[Any, ...], wait: Callable[[], None]) -> None:
        """Starts it, and waits until it is of use.

        Args:
            args: Of its function; picklable.
            wait: Returns once it is of use; at an error the process ends.

        Raises:
            RuntimeError: If it is running.
        """
        if self.is_running:
            raise RuntimeError(f"the {self._name} driver is running.")
        # Drake and torch start threads, which a forked child would inherit broken.
        process = multiprocessing.get_context("spawn").Process(
            target=self._target, args=args, name=self._name, daemon=True
        )
        process.start()
        # It must not outlive the shared memory that is among its arguments.
        self._end = weakref.finalize(self, _kill, process, args)
        try:
            wait()
        except BaseException:  # Ctrl-C, too.
            self.stop()
            raise

    def stop(self) -> None:
        """Ends it, if it runs."""
        if self._end is not None:
            self._end()
            self._end = None


def _kill(process: BaseProcess, args: tuple[Any, ...]) -> None:
    """Ends a process, and waits until it has ended; keeps its arguments until then."""
    process.kill()
    process.join()
