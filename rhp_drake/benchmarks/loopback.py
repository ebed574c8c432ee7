"""The loop over real protocols, on loopback, beside the loop in one process.

Each task runs twice from the same seed: in the simulated station, and on the virtual
lab through ur_rtde and natnet, in real time.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Final

import numpy as np
from pydrake.systems.analysis import Simulator
import torch

from rhp_drake.benchmarks.lab_process import LabProcess
from rhp_drake.benchmarks.run_process import RunProcess, RunReport
from rhp_drake.closed_loop import MakeClosedLoop
from rhp_drake.drivers.command_periods import CommandPeriods
from rhp_drake.frozen_instances import load_instances
from rhp_drake.hardware import load_hardware
from rhp_drake.physics import nominal_physics
from rhp_drake.planning.policy import Policy
from rhp_drake.planning.policy_config import MakePolicy
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.run_closed_loop import run_closed_loop
from rhp_drake.scenario import load_scenario
from rhp_drake.systems.receding_horizon_planner import DecisionRecord

# RHP-66, and the default weights.
_SCENARIO: Final = Path("three_boxes")
_POLICY: Final = "policy: !RecedingHorizonConfig {}"
_NUM_OBJECTS: Final = 3
# Loopback address of the lab; others' is another.
_HOST: Final = "127.0.0.5"
_PATIENCE: Final = 300.0  # s, the longest run.


@dataclass(frozen=True)
class LoopbackRun:
    """One task, run twice.

    Attributes:
        index: Its number in the validation set.
        in_process: How it ended in one process: status and number of actions.
        over_loopback: How over loopback; the status is "crash" if it did not.
        common: How many decisions were the same before one differed.
        recomputed: Of the decisions over loopback, how many a policy of another process
            makes again from the same poses.
        num_decisions: Over loopback.
        periods: Of the stream of commands.
        arm_ages: Of the arm's measurements at each tick, s, shape (N,).
        object_ages: Of the oldest pose at each tick, s, shape (N,).
        seconds: How long it took over loopback, the drivers' start included, s.
    """

    index: int
    in_process: tuple[str, int]
    over_loopback: tuple[str, int]
    common: int
    recomputed: int
    num_decisions: int
    periods: CommandPeriods
    arm_ages: np.ndarray
    object_ages: np.ndarray
    seconds: float


def run_both_ways(count: int) -> Iterator[LoopbackRun]:
    """Runs the first `count` validation tasks both ways.

    Raises:
        WorkError: If the lab or the closed loop cannot be started.
    """
    # As in the other process: sums of as many threads have the same bits.
    torch.set_num_threads(1)
    _, scenario = load_scenario(_SCENARIO, overrides=[_POLICY])
    policy = MakePolicy(scenario.policy, _NUM_OBJECTS)
    simulator = Simulator(MakeClosedLoop(scenario, policy))
    hardware = load_hardware(Path("virtual_lab"))
    hardware.ur.host = hardware.natnet.server_address = _HOST
    physics = nominal_physics(_NUM_OBJECTS)
    instances = load_instances(VALIDATION)[:count]
    with (
        LabProcess(_SCENARIO, _HOST) as lab,
        RunProcess(_SCENARIO, [_POLICY], hardware) as run,
    ):
        for index, instance in enumerate(instances):
            decisions: list[DecisionRecord] = []
            outcome = run_closed_loop(
                simulator,
                instance,
                physics,
                seed=index,
                on_decision=decisions.append,
            )
            begin = time.monotonic()
            lab.begin(instance, physics, index)
            run.begin(instance.goals[0], index)
            report = run.report(_PATIENCE)
            seconds = time.monotonic() - begin
            lab.end()
            if report is None:
                run.restart()
                report = RunReport(crash="it hangs")
            ended = report.outcome
            yield LoopbackRun(
                index=index,
                in_process=(outcome.status, outcome.num_actions),
                over_loopback=(ended.status, ended.num_actions)
                if ended is not None
                else ("crash", len(report.decisions)),
                common=_common(decisions, report.decisions),
                recomputed=_recomputed(policy, report, index),
                num_decisions=len(report.decisions),
                periods=CommandPeriods(report.periods),
                arm_ages=report.arm_ages,
                object_ages=report.object_ages,
                seconds=seconds,
            )


def _common(ours: list[DecisionRecord], theirs: list[DecisionRecord]) -> int:
    """How many decisions are the same before one differs."""
    same = 0
    for our, their in zip(ours, theirs, strict=False):
        if our.decision.action != their.decision.action:
            break
        same += 1
    return same


def _recomputed(policy: Policy, report: RunReport, seed: int) -> int:
    """How many of a run's decisions `policy` makes, too, from the same poses."""
    same, memory = 0, None
    for record in report.decisions:
        decision = policy.decide(
            record.state, report.goals, stream(seed, "decision", record.index), memory
        )
        theirs = record.decision
        memory = theirs.memory
        same += (decision.action, decision.value) == (theirs.action, theirs.value)
    return same
