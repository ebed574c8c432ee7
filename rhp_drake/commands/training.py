"""What the commands that train a Q-network share: the loop, and the weights' file."""

from dataclasses import asdict
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Any, Final

# torch and Drake are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rich.console import Console

    from rhp_drake.learning.learner import Learner
    from rhp_drake.learning.reinforcement import Reinforcement
    from rhp_drake.value.q_network import QNetwork

VALIDATION_TASKS: Final = 200
# Steps between checkpoints, and between validations.
_CHECKPOINT_PERIOD: Final = 1000
_VALIDATION_PERIOD: Final = 4000
_LOG_PERIOD: Final = 100


def prepare(out: Path, seed: int) -> None:
    """Makes sure that the weights can be written, and training repeated."""
    import torch

    from rhp_drake.files import check_writable

    check_writable(out)
    torch.manual_seed(seed)
    # As everywhere else: the same bits on machines of more cores.
    torch.set_num_threads(1)
    # Gradients of dead units get so small that arithmetic takes five times as long.
    torch.set_flush_denormal(True)


def train(
    learner: "Learner",
    out: Path,
    sources: list[Path],
    origin: dict[str, Any],
    console: "Console",
    reinforcement: "Reinforcement | None" = None,
) -> None:
    """Trains to the end, from a checkpoint if there is one, and writes the weights.

    Progress is shown, and logged for TensorBoard in a folder beside the weights.  So is
    the greedy policy's success on validation tasks, every now and then.

    Args:
        learner: Trains the network.
        out: File of the weights.
        sources: Where the data come from.
        origin: What else the result depends on, for checkpoint and provenance.
        console: Where to say things.
        reinforcement: Makes experience on the way.
    """
    from torch.utils.tensorboard import SummaryWriter

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.learning.demonstration_folder import describe
    from rhp_drake.run_record import source_commit

    commit = source_commit()
    origin |= {"demonstrations": [describe(path) for path in sources]}
    checkpoint = out.with_name(out.name + ".checkpoint")
    if checkpoint.exists():
        learner.resume(checkpoint, origin)
        console.print(f"Goes on from step {learner.num_steps} of {checkpoint}.")
    total = learner.config.num_steps
    logs = out.with_name(out.name + ".logs")
    with (
        SummaryWriter(str(logs), purge_step=learner.num_steps) as writer,
        make_progress(console) as progress,
    ):
        bar = progress.add_task("Steps", total=total, completed=learner.num_steps)
        acting = progress.add_task("Tasks", visible=False)
        while learner.num_steps < total:
            if reinforcement is not None:
                for done in reinforcement.act():
                    tasks = reinforcement.rounds.num_tasks
                    progress.update(acting, completed=done, total=tasks, visible=True)
            learner.step()
            step = learner.num_steps
            if step % _LOG_PERIOD == 0:
                loss = learner.mean_loss
                progress.update(bar, completed=step, description=f"loss {loss:.3f}")
                writer.add_scalar("loss", loss, step)
            if step % _VALIDATION_PERIOD == 0 or step == total:
                successes, trials = greedy_successes(learner.network)
                if trials:
                    writer.add_scalar("greedy success", successes / trials, step)
            if step % _CHECKPOINT_PERIOD == 0:
                learner.save(checkpoint, origin)
    network = learner.network
    successes, trials = greedy_successes(network)
    network.provenance = {
        "command": " ".join(["rhp", *sys.argv[1:]]),
        "commit": commit,
        **origin,
        "validation_successes_of_gp": f"{successes} of {trials}",
        **asdict(learner.config),  # type: ignore[call-overload]
        "loss": learner.mean_loss,
    }
    network.save(out)
    checkpoint.unlink(missing_ok=True)
    console.print(
        f"{out}: {out.stat().st_size / 1e3:.0f} kB, greedily solves {successes} of "
        f"{trials} validation tasks."
    )


def greedy_successes(network: "QNetwork") -> tuple[int, int]:
    """How many of some validation tasks the greedy policy solves, and of how many.

    There are frozen tasks for three objects only: of none otherwise.
    """
    from rhp_drake.evaluation.episode import run_episode
    from rhp_drake.frozen_instances import load_instances
    from rhp_drake.planning.receding_horizon import RecedingHorizon
    from rhp_drake.push_model.transition import PushModel
    from rhp_drake.random_streams import VALIDATION

    instances = load_instances(VALIDATION)[:VALIDATION_TASKS]
    if network.num_objects != instances[0].num_objects:
        return 0, 0
    world = PushModel(network.num_objects)
    policy = RecedingHorizon(world, network, 0, 0, 1.0)
    episodes = [
        run_episode(world, policy, instance, 0, index)
        for index, instance in enumerate(instances)
    ]
    return sum(episode.succeeded for episode in episodes), len(instances)
