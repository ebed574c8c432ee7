"""`rhp evaluate`: policies side by side on a frozen set of instances."""

from pathlib import Path
from typing import Annotated

import typer

from rhp_drake.errors import InputError
from rhp_drake.planning.policy_config import POLICIES, PolicyConfig

# So many failures are shown one by one; the file of --out has all.
_NUM_ENDINGS = 10


def evaluate(
    *,
    policies: Annotated[
        str, typer.Option(help=f"Any of {', '.join(POLICIES)}.")
    ] = "kdp,gp,rhp33,rhp66",  # Those of the paper.
    levels: Annotated[
        str,
        typer.Option(
            help="Of the uncertainty of the world's physics: any of none, low, medium, "
            "high."
        ),
    ] = "none",
    instances: Annotated[
        str, typer.Option(help="The set: evaluation (never tune on it) or validation.")
    ] = "validation",
    objects: Annotated[
        int, typer.Option(min=1, max=8, help="Of each instance, the target included.")
    ] = 3,
    count: Annotated[int, typer.Option(help="The first so many of the set.")] = 500,
    world: Annotated[
        str, typer.Option(help="planar, the push model, or station, the whole robot.")
    ] = "planar",
    weights: Annotated[
        str | None, typer.Option(help="File of the Q-network's weights.")
    ] = None,
    temperature: Annotated[
        float | None, typer.Option(help="tau of RHP's soft-max, in actions.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random draws.")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[
        Path | None, typer.Option(help="Write every episode to this JSON file.")
    ] = None,
) -> None:
    """Compares policies: success with confidence intervals, actions, time."""
    from rich.console import Console
    from rich.progress import track

    from rhp_drake.evaluation.comparison import (
        Comparison,
        make_ending_table,
        make_failure_table,
        make_table,
        run_comparison,
    )
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.files import check_writable
    from rhp_drake.frozen_instances import NUM_OBJECTS

    comparison = Comparison(
        {name: _config(name, weights, temperature) for name in policies.split(",")},
        # A level named twice would count each of its episodes twice.
        list(dict.fromkeys(levels.split(","))),
        instances,
        objects,
        count,
        world,
        seed,
    )
    if out is not None:
        check_writable(out)
    console = Console()
    trials = run_comparison(comparison, workers)
    total = len(comparison.trials())
    # Sorted: the order in which workers finish means nothing.
    results = sorted(
        track(trials, description="Episodes", total=total, console=console),
        key=lambda result: (
            list(comparison.policies).index(result[0].policy),
            comparison.levels.index(result[0].level),
            result[0].index,
        ),
    )
    title = f"{world} world, first {count} instances of the {instances} set"
    if objects != NUM_OBJECTS:
        title += f", {objects} objects"
    if len(comparison.levels) == 1:
        title += f", uncertainty: {comparison.levels[0]}"
    tables = [make_table(results, title, objects)]
    if not all(episode.succeeded for _, episode in results):
        tables.append(make_failure_table(results))
        tables.append(make_ending_table(results, _NUM_ENDINGS))
    for table in tables:
        console.print(table)
        console.print()
    console.print(describe_machine(workers))
    if out is not None:
        _write(out, results)


def _config(name: str, weights: str | None, temperature: float | None) -> PolicyConfig:
    """The named policy, with other weights or temperature."""
    if name not in POLICIES:
        raise InputError(f"--policies: {name!r} is not one of {', '.join(POLICIES)}.")
    config = POLICIES[name]()
    if weights is not None and hasattr(config, "q_network"):
        config.q_network = weights
    if temperature is not None and hasattr(config, "temperature"):
        config.temperature = temperature
    config.validate()
    return config


def _write(path: Path, results: list) -> None:
    import json

    from rhp_drake.files import write_atomically

    rows = [vars(trial) | vars(episode) for trial, episode in results]
    write_atomically(path, json.dumps(rows, indent=1) + "\n")
