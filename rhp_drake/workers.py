"""Runs a function over many items: in this process, in several, or on a Ray cluster."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
import logging
import multiprocessing
from multiprocessing.connection import wait
import os
import signal
import socket
from threading import Thread
from typing import Any, Final, TypeAlias, TypeVar

from rhp_drake.errors import InputError, WorkError

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class RayCluster:
    """A Ray cluster, on whose nodes rhp_drake is installed.

    Attributes:
        address: What `ray.init` takes: "auto" for the cluster this machine is part of,
            or HOST:PORT of its head.
    """

    address: str


# A number of processes, of one thread each (1: this process), or a cluster.
Workers: TypeAlias = int | RayCluster

# Tasks of a cluster in flight for each of its cores: enough to keep them busy.
_IN_FLIGHT: Final = 2
# How often a task is done again whose node dies.
_RETRIES: Final = 10


def _use_one_thread() -> None:
    """Makes this process compute in one thread.

    As many workers as cores then share nothing, and sums come out the same whatever
    the number of workers.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["DRAKE_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)


def follow_parent() -> None:
    """Makes this process end when its parent does, and not by Ctrl-C.

    Else a process whose parent was killed waits for work for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    Thread(target=follow, daemon=True).start()
    # Ctrl-C reaches the whole group: the parent decides what comes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _start_worker() -> None:
    """Makes a new process a worker, which does not outlive the one it works for."""
    _use_one_thread()
    follow_parent()


def run_over(
    function: Callable[[Item], Result], items: Sequence[Item], workers: Workers
) -> Iterator[tuple[Item, Result]]:
    """Yields (item, function(item)), in whatever order they finish.

    Args:
        function: A picklable function; what it draws must depend on its item alone.
        items: Picklable.
        workers: Who does it.

    Raises:
        InputError: If there is no such cluster, or a function says so.
        WorkError: If a process dies.
    """
    if isinstance(workers, RayCluster):
        yield from _run_on_cluster(function, items, workers)
    elif workers <= 1:
        _use_one_thread()
        for item in items:
            yield item, function(item)
    else:
        yield from _run_in_processes(function, items, workers)


def _run_in_processes(
    function: Callable[[Item], Result], items: Sequence[Item], num_workers: int
) -> Iterator[tuple[Item, Result]]:
    # Drake and torch start threads, which a forked child would inherit broken.
    context = multiprocessing.get_context("spawn")
    others = multiprocessing.active_children()
    with ProcessPoolExecutor(
        num_workers, mp_context=context, initializer=_start_worker
    ) as pool:
        futures = {pool.submit(function, item): item for item in items}
        try:
            for future in as_completed(futures):
                # Results may be large: none is kept.
                result = future.result()
                yield futures.pop(future), result
        except BrokenProcessPool:
            raise WorkError(
                "a worker process died; was it killed, or out of memory?"
            ) from None
        finally:
            if futures:  # An error, or Ctrl-C: nobody wants the rest.
                pool.shutdown(wait=False, cancel_futures=True)
                for process in multiprocessing.active_children():
                    if process not in others:
                        process.terminate()


def _run_on_cluster(
    function: Callable[[Item], Result], items: Sequence[Item], cluster: RayCluster
) -> Iterator[tuple[Item, Result]]:
    try:
        import ray
    except ImportError:
        raise InputError(
            'a cluster needs Ray: pip install -c constraints.txt -e ".[distributed]".'
        ) from None
    _check_reachable(cluster.address)
    try:
        ray.init(
            address=cluster.address, log_to_driver=False, logging_level=logging.ERROR
        )
    except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        message = str(error).partition("\n")[0]
        raise InputError(f"no Ray cluster at {cluster.address!r}: {message}") from None
    # Ray itself does a task again whose node dies.
    remote: Any = ray.remote(_run_remotely).options(max_retries=_RETRIES)
    shared = ray.put(function)
    left = iter(items)
    running: dict[Any, Item] = {}
    try:
        while True:
            cores = int(ray.cluster_resources().get("CPU", 1))
            room = max(_IN_FLIGHT * cores, len(running))
            for item in islice(left, room - len(running)):
                running[remote.remote(shared, item)] = item
            if not running:
                return
            (done, *_), _ = ray.wait(list(running))
            item = running.pop(done)
            yield item, ray.get(done)
    except ray.exceptions.RayTaskError as error:
        # As the other workers raise it; what is no fault of ours has its traceback.
        if isinstance(error.cause, InputError | WorkError):
            raise error.cause from None
        raise
    except ray.exceptions.RayError as error:
        message = str(error).partition("\n")[0]
        raise WorkError(f"the Ray cluster failed: {message}") from error
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises an InputError if nobody listens at HOST:PORT.

    Ray itself would wait for minutes and then end the process.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon:
        return
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"no Ray cluster at {address!r}: {error}.") from None


def _run_remotely(function: Callable[[Item], Result], item: Item) -> Result:
    _use_one_thread()
    return function(item)
