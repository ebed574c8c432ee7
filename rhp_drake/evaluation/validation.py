"""How good a Q-network is while it learns: the greedy policy on validation tasks."""

from typing import Final

from rhp_drake.evaluation.episode import greedy_episodes
from rhp_drake.frozen_instances import load_instances
from rhp_drake.random_streams import VALIDATION
from rhp_drake.value.q_network import QNetwork

_NUM_TASKS: Final = 200


def greedy_successes(network: QNetwork) -> list[bool]:
    """Whether the greedy policy solves each of the first validation tasks."""
    instances = load_instances(VALIDATION, network.num_objects)[:_NUM_TASKS]
    return [episode.succeeded for episode in greedy_episodes(network, instances)]
