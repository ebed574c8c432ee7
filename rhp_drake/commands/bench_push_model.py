"""`rhp bench push-model`: accuracy and speed of the push model, beside others'."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import Seed
from rhp_drake.planning.policy_config import DEFAULT_Q_NETWORK

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console
    from rich.table import Table

    from rhp_drake.benchmarks.decision import DecisionTimes
    from rhp_drake.benchmarks.other_worlds import World, WorldTrial
    from rhp_drake.benchmarks.push_model import Accuracy, Errors, Speed, Spread
    from rhp_drake.benchmarks.push_profile import Profile
    from rhp_drake.evaluation.episode import Episode


def push_model(
    *,
    pairs: Annotated[int, typer.Option(min=10, help="(State, action) pairs.")] = 1000,
    decisions: Annotated[int, typer.Option(min=0, help="Of RHP-66; 0: none.")] = 200,
    instances: Annotated[
        int, typer.Option(min=0, help="Validation instances a world; 0: none.")
    ] = 100,
    weights: Annotated[
        str, typer.Option(help="File of the Q-network's weights.")
    ] = DEFAULT_Q_NETWORK,
    seed: Seed = 0,
    workers: Annotated[
        int, typer.Option(min=1, help="Processes of the closed loop.")
    ] = 2,
    out: Annotated[
        Path | None, typer.Option(help="Write all numbers to this JSON file.")
    ] = None,
) -> None:
    """Measures accuracy and speed of the push model, and how much they matter.

    Box2D and MuJoCo, which come with the extra "bench" of this project, are
    compared if they are installed.
    """
    from rich.console import Console

    from rhp_drake.benchmarks.engines import describe_engines
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.files import check_writable
    from rhp_drake.frozen_instances import NUM_OBJECTS
    from rhp_drake.resources import resolve
    from rhp_drake.value.weights import load_q_network

    # Before the minutes of work.
    weights_path = resolve(weights)
    if decisions or instances:
        load_q_network(weights_path, NUM_OBJECTS)
    if out is not None:
        check_writable(out)
    console = Console()
    results = _measure_transitions(console, pairs, seed)
    if decisions:
        results["decisions"] = _measure_decisions(console, decisions, weights_path)
    if instances:
        results["closed_loop"] = _measure_closed_loop(
            console, instances, weights_path, workers
        )
    results["machine"] = f"{describe_machine(workers)}, {describe_engines()}"
    console.print(results["machine"])
    if out is not None:
        import json

        from rhp_drake.files import write_atomically

        write_atomically(out, json.dumps(results, indent=1) + "\n")


def _measure_transitions(console: "Console", count: int, seed: int) -> dict:
    """Accuracy and speed; prints tables and returns what goes to the JSON file."""
    from dataclasses import asdict
    import os

    from rhp_drake.benchmarks.engines import available_engines
    from rhp_drake.benchmarks.pairs import sample_contact_pairs, sample_mixed_pairs
    from rhp_drake.benchmarks.push_model import (
        measure_accuracy,
        measure_batches,
        measure_objects,
        measure_threads,
    )
    from rhp_drake.benchmarks.push_profile import measure_profile
    from rhp_drake.frozen_instances import NUM_OBJECTS as M

    with console.status("Drawing pairs"):
        contact = sample_contact_pairs(count, M, seed)
        mixed = sample_mixed_pairs(count, M, seed)
    with console.status("Accuracy"):
        accuracies = measure_accuracy(available_engines(), contact, M)
    console.print(_accuracy_table(accuracies, f"{count} pairs, seed {seed}"))
    with console.status("Profile"):
        profile = measure_profile(contact, M)
    console.print(_profile_table(profile, f"{count} pairs, one thread"))
    with console.status("Speed"):
        kinds = {"contact": contact, "mixed": mixed}
        speeds = [
            *measure_threads(kinds, M, sorted({1, os.cpu_count() or 1})),
            *measure_objects(seed),
            *measure_batches(contact, M),
        ]
    console.print(_speed_table(speeds))
    return {
        "accuracy": [asdict(a) for a in accuracies],
        "profile": asdict(profile),
        "speed": [asdict(s) for s in speeds],
    }


def _measure_decisions(console: "Console", count: int, weights: Path) -> list[dict]:
    from dataclasses import asdict
    import os

    import torch

    from rhp_drake.benchmarks.decision import measure_decisions
    from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
    from rhp_drake.random_streams import VALIDATION
    from rhp_drake.value.weights import load_q_network

    # As in episodes: such small batches gain nothing from more.
    torch.set_num_threads(1)
    with console.status("Decisions"):
        times = measure_decisions(
            load_q_network(weights, NUM_OBJECTS),
            load_instances(VALIDATION),
            count,
            sorted({1, os.cpu_count() or 1}),
        )
    console.print(_decision_table(times))
    return [asdict(t) for t in times]


def _measure_closed_loop(
    console: "Console", count: int, weights: Path, workers: int
) -> list[dict]:
    from dataclasses import asdict

    from rich.progress import track

    from rhp_drake.benchmarks.engines import available_engines
    from rhp_drake.benchmarks.other_worlds import run_in_worlds, worlds_of

    worlds = worlds_of(available_engines())
    results = list(
        track(
            run_in_worlds(worlds, weights, count, workers),
            description="Episodes",
            total=count * len(worlds),
            console=console,
        )
    )
    console.print(_closed_loop_table(results, worlds, f"{count} validation instances"))
    return [asdict(trial) | asdict(episode) for trial, episode in results]


def _accuracy_table(accuracies: "Sequence[Accuracy]", title: str) -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from rhp_drake.benchmarks.push_model import FINE

    # Without frames, it fits into 80 columns.
    table = Table(
        title=f"Moved boxes after one contact-rich action: {title}; finest: {FINE} x",
        caption="mean (95 % interval), median, 95th percentile of the error, and mean "
        "of that to the push model's finest, mm; median (range) of interleaved runs, "
        "one thread",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("engine,\nsteps", no_wrap=True)
    for heading in (
        "error against\nits own finest",
        "to\nours",
        "ms a\npush",
        "time over the\npush model's",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for i, a in enumerate(accuracies):
        is_last = i + 1 == len(accuracies) or accuracies[i + 1].engine != a.engine
        table.add_row(
            f"{a.engine} {a.refinement:g} x",
            _format_errors(a.own),
            f"{1e3 * a.push_model.mean:.2f}",
            f"{1e3 * a.seconds.median:.3f}",
            _format_spread(a.slowness, 1.0, 2),
            end_section=is_last,
        )
    return table


def _profile_table(profile: "Profile", title: str) -> "Table":
    from rich.table import Table

    table = Table(
        title=f"Where a contact-rich push's time goes: {title}",
        caption=f"median (range) of repeated runs; {profile.steps:.1f} steps a push",
    )
    table.add_column("part", no_wrap=True)
    for heading in ("us a push", "%"):
        table.add_column(heading, justify="right", no_wrap=True)
    for i, part in enumerate(profile.parts):
        table.add_row(
            part.name,
            _format_spread(part.seconds, 1e6, 1),
            _format_spread(part.share, 100.0, 0),
            end_section=i + 2 == len(profile.parts),
        )
    return table


def _speed_table(speeds: "Sequence[Speed]") -> "Table":
    from rich.table import Table

    table = Table(title="Speed of the push model")
    table.add_column("pairs", no_wrap=True)
    for heading in ("objects", "batch", "threads", "actions/s", "ms an action"):
        table.add_column(heading, justify="right", no_wrap=True)
    for s in speeds:
        table.add_row(
            s.pairs,
            str(s.num_objects),
            str(s.batch),
            str(s.threads),
            _format_spread(s.actions_per_second, 1.0, 0),
            f"{1e3 / s.actions_per_second.median:.3f}",
        )
    return table


def _decision_table(times: "Sequence[DecisionTimes]") -> "Table":
    from rich.table import Table

    table = Table(title=f"One decision of RHP-66, ms: {times[0].decisions} decisions")
    for heading in (
        "threads",
        "p50",
        "p95",
        "network",
        "contact",
        "kinematics\nand checks",
        "planner",
        "transitions",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for t in times:
        seconds = (t.p50, t.p95, t.network, t.contact, t.kinematics, t.rest)
        table.add_row(
            str(t.threads), *(f"{1e3 * s:.2f}" for s in seconds), f"{t.transitions:.1f}"
        )
    return table


def _closed_loop_table(
    results: "Sequence[tuple[WorldTrial, Episode]]",
    worlds: "Sequence[World]",
    title: str,
) -> "Table":
    from rich.table import Table

    from rhp_drake.evaluation.statistics import format_rate

    table = Table(title=f"RHP-66, planning with the push model: {title}")
    table.add_column("world", no_wrap=True)
    table.add_column("steps", justify="right", no_wrap=True)
    table.add_column("success %\n(95 % Wilson)", justify="right", no_wrap=True)
    for world in worlds:
        outcomes = [e.succeeded for trial, e in results if trial.world == world]
        table.add_row(
            world.engine,
            f"{world.refinement} x",
            format_rate(sum(outcomes), len(outcomes)),
        )
    return table


def _format_errors(errors: "Errors") -> str:
    mean, low, high = 1e3 * errors.mean, 1e3 * errors.low, 1e3 * errors.high
    return (
        f"{mean:.2f} ({low:.2f}-{high:.2f}), {1e3 * errors.median:.2f}, "
        f"{1e3 * errors.p95:.2f}"
    )


def _format_spread(spread: "Spread", factor: float, digits: int) -> str:
    median, low, high = (factor * x for x in (spread.median, spread.low, spread.high))
    return f"{median:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"
