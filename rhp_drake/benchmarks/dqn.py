"""Stable-Baselines3's DQN from scratch, on the Gymnasium environment: a baseline.

It has the actions, and the observations and layers of the paper's Q-network, and none
of what we give ours: no demonstrations, no look-ahead, no goals in hindsight, no double
Q-learning, no symmetries, no set of obstacles.  What it learns becomes a `QNetwork`, so
that the same greedy policy, with the same mask, is measured.

Stable-Baselines3 draws from its own generators, and from those of Python, NumPy and
PyTorch; it sets their seeds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
import time
from typing import TYPE_CHECKING, Any, Final

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import Episode, greedy_episodes
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.learning.training import make_repeatable
from rhp_drake.random_streams import VALIDATION
from rhp_drake.task import FAILURE_VALUE, REWARD
from rhp_drake.value.q_network import HIDDEN_LAYERS, PaperQNetwork, QNetwork

if TYPE_CHECKING:
    from stable_baselines3 import DQN

ENVIRONMENT: Final = "rhp_drake.gymnasium_env:rhp_drake/PushInClutter-v0"
# Validation tasks, the first so many, and steps between two looks at them.
NUM_INSTANCES: Final = 100
EVALUATION_PERIOD: Final = 10_000

# Those of RL Baselines3 Zoo (hyperparams/dqn.yml) for Acrobot, which costs 1 an action
# until its goal, too, and is learnt in 100 000 steps.  But nothing is forgotten, and...
SETTINGS: Final[dict[str, Any]] = {
    "learning_rate": 6.3e-4,
    "batch_size": 128,
    "buffer_size": 1_000_000,
    "learning_starts": 0,
    "target_update_interval": 250,
    "train_freq": 4,
    "gradient_steps": -1,  # As many as actions.
    "exploration_fraction": 0.12,
    "exploration_final_eps": 0.1,
    # ...Stable-Baselines3 bootstraps at truncation.  With this discount, to go on for
    # ever is worth what failure is, so that to push a box off the table is no way out.
    "gamma": 1 - REWARD / FAILURE_VALUE,
}


@dataclass(frozen=True)
class Evaluation:
    """The greedy policy at some time of training.

    Attributes:
        steps: Of the environment until then, each an action simulated (or masked).
        seconds: Of processor time until then, without evaluations.
        successes: Tasks solved.
        fallen: Tasks that ended with an object off the table.
        trials: Tasks tried.
    """

    steps: int
    seconds: float
    successes: int
    fallen: int
    trials: int


def check_available() -> None:
    """Raises InputError unless Stable-Baselines3 is there."""
    if not find_spec("stable_baselines3"):
        raise InputError(
            "this needs Stable-Baselines3: "
            'pip install -c constraints.txt -e ".[bench]".'
        )


def make_dqn(seed: int) -> "DQN":
    """DQN that has not learnt yet, with its environment."""
    import gymnasium
    from stable_baselines3 import DQN
    from stable_baselines3.common.logger import Logger

    make_repeatable(seed)
    model = DQN(
        "MlpPolicy",
        gymnasium.make(ENVIRONMENT, num_objects=NUM_OBJECTS),
        policy_kwargs={"net_arch": list(HIDDEN_LAYERS)},
        seed=seed,
        device="cpu",
        **SETTINGS,
    )
    # Its own one leaves a folder behind among the temporary files.
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def train_dqn(
    num_steps: int,
    seed: int,
    on_step: Callable[[int], None],
    on_evaluation: Callable[[Evaluation], None],
) -> QNetwork:
    """Trains DQN, and looks at its greedy policy now and then, and at the end.

    Args:
        num_steps: Of the environment.
        seed: Of tasks, weights and exploration.
        on_step: Is told the number of steps taken.
        on_evaluation: Is told of each evaluation.

    Returns:
        What was learnt.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    begin = time.process_time()
    evaluating = 0.0

    def evaluate() -> None:
        nonlocal evaluating
        now = time.process_time()
        seconds = now - begin - evaluating
        instances = load_instances(VALIDATION)[:NUM_INSTANCES]
        episodes = greedy_episodes(to_q_network(model), instances)
        on_evaluation(_summary(model.num_timesteps, seconds, episodes))
        evaluating += time.process_time() - now

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            on_step(self.num_timesteps)
            step = self.num_timesteps
            if step % EVALUATION_PERIOD == 0 and step < num_steps:
                evaluate()
            return True

    model = make_dqn(seed)
    model.learn(num_steps, callback=Watch())
    evaluate()
    return to_q_network(model)


def to_q_network(model: "DQN") -> QNetwork:
    """The model's weights in the network of the same layers."""
    network = PaperQNetwork(NUM_OBJECTS)
    network.layers.load_state_dict(model.q_net.q_net.state_dict())
    return network.eval()


def _summary(steps: int, seconds: float, episodes: list[Episode]) -> Evaluation:
    outcomes = [episode.outcome for episode in episodes]
    return Evaluation(
        steps,
        seconds,
        outcomes.count("succeeded"),
        outcomes.count("object fell"),
        len(episodes),
    )
