"""Work on a Ray cluster of two nodes on this machine, one of which dies halfway."""

from functools import partial
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from rhp_drake.errors import InputError
from rhp_drake.learning.demonstration_folder import demonstrate_tasks
from rhp_drake.learning.demonstrators import PlanningDemonstrator
from rhp_drake.value.weights import load_q_network
from rhp_drake.workers import RayCluster, run_over

pytest.importorskip("ray")
pytestmark = pytest.mark.slow

NUM_TASKS = 16


@pytest.fixture
def cluster():
    from ray.cluster_utils import Cluster

    # The head works, too; the other node is the one to die.
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()


def test_no_plan_is_lost_or_doubled_when_a_node_dies(cluster, tmp_path):
    demonstrator = PlanningDemonstrator(seed=11, num_objects=3)
    (mortal,) = cluster.worker_nodes
    ray = RayCluster(cluster.address)
    steps = []
    tasks = range(NUM_TASKS)
    for done in demonstrate_tasks(tmp_path / "cluster", tasks, demonstrator, ray):
        steps.append(done)
        if done == NUM_TASKS // 2:
            # As if someone had pulled its plug.
            cluster.remove_node(mortal, allow_graceful=False)
    assert steps == [*range(NUM_TASKS + 1)]
    list(demonstrate_tasks(tmp_path / "alone", tasks, demonstrator, 1))
    ours, alone = (
        pq.read_table(tmp_path / name).drop_columns("seconds")
        for name in ("cluster", "alone")
    )
    assert ours["task"].to_pylist() == [*range(NUM_TASKS)]
    assert ours.equals(alone)


def test_errors_come_back(cluster, tmp_path):
    ray = RayCluster(cluster.address)
    with pytest.raises(InputError, match="nothing: there is no such file of weights"):
        list(run_over(partial(load_q_network, num_objects=3), [Path("nothing")], ray))
