import os
import signal

import pytest
import torch

from rhp_drake.errors import InputError, WorkError
from rhp_drake.random_streams import stream
from rhp_drake.workers import RayCluster, run_over


def multiply(index: int) -> list[float]:
    """Long sums, whose last bits would tell how many threads made them."""
    a = torch.from_numpy(stream(0, "test", index).normal(size=(300, 300)))
    return (a @ a).sum(dim=0).tolist()


def refuse(index: int) -> int:
    if index == 1:
        raise InputError("one is refused.")
    return index


def test_results_do_not_depend_on_the_number_of_workers():
    alone = dict(run_over(multiply, range(4), workers=1))
    assert list(alone) == [0, 1, 2, 3]
    assert dict(run_over(multiply, range(4), workers=2)) == alone


@pytest.mark.parametrize("num_workers", [1, 2])
def test_errors_come_back(num_workers):
    with pytest.raises(InputError, match=r"one is refused\."):
        list(run_over(refuse, range(3), num_workers))


def test_nothing_to_do():
    assert list(run_over(refuse, [], workers=2)) == []


def die(index: int) -> int:
    if index == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return index


def test_a_killed_worker_is_one_sentence():
    with pytest.raises(WorkError, match="a worker process died"):
        list(run_over(die, range(3), workers=2))


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:1", "127.0.0.1:port"])
def test_a_cluster_that_is_not_there(address):
    pytest.importorskip("ray")
    with pytest.raises(InputError, match=f"no Ray cluster at '{address}'"):
        list(run_over(refuse, range(3), RayCluster(address)))
