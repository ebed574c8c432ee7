"""How good a Q-network is while it learns: the greedy policy on validation tasks."""

from typing import Final

from rhp_drake.evaluation.episode import greedy_episodes
from rhp_drake.frozen_instances import load_instances
from rhp_drake.random_streams import VALIDATION
from rhp_drake.value.q_network import QNetwork

_NUM_TASKS: Final = 200


def greedy_successes(network: QNetwork) -> tuple[int, int]:
    """How many of some validation tasks the greedy policy solves, and of how many.

    There are frozen tasks for three objects only: of none otherwise.
    """
    instances = load_instances(VALIDATION)[:_NUM_TASKS]
    if network.num_objects != instances[0].num_objects:
        return 0, 0
    episodes = greedy_episodes(network, instances)
    return sum(episode.succeeded for episode in episodes), len(instances)
