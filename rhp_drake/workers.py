"""Runs a function over many items, in this process or in several."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
import multiprocessing
import os
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def _use_one_thread() -> None:
    """Makes this process compute in one thread.

    As many workers as cores then share nothing, and sums come out the same whatever
    the number of workers.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["DRAKE_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)


def run_over(
    function: Callable[[Item], Result], items: Sequence[Item], num_workers: int
) -> Iterator[tuple[Item, Result]]:
    """Yields (item, function(item)), in whatever order they finish.

    Args:
        function: A picklable function; what it draws must depend on its item alone.
        items: Picklable.
        num_workers: Processes, of one thread each; 1 runs in this one.
    """
    if num_workers <= 1:
        _use_one_thread()
        for item in items:
            yield item, function(item)
        return
    # Drake and torch start threads, which a forked child would inherit broken.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        num_workers, mp_context=context, initializer=_use_one_thread
    ) as pool:
        futures = {pool.submit(function, item): item for item in items}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
