"""Episodes in the station: the robot, its servo and contact in three dimensions."""

import time

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.closed_loop import MakeClosedLoop, run_closed_loop
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.failure import describe_ending
from rhp_drake.physics import ObjectPhysics
from rhp_drake.planning.policy import Policy
from rhp_drake.scenario import Scenario
from rhp_drake.systems.receding_horizon_planner import DecisionRecord
from rhp_drake.task import TaskInstance


class StationWorld:
    """One closed loop of the default station, which runs instance after instance.

    Args:
        policy: Who decides.
    """

    def __init__(self, policy: Policy) -> None:
        scenario = Scenario()
        self._time_limit = scenario.time_limit
        self._simulator = Simulator(MakeClosedLoop(scenario, policy))

    def run_episode(
        self, instance: TaskInstance, seed: int, index: int, physics: ObjectPhysics
    ) -> Episode:
        """Runs the policy on an instance; see `episode.run_episode`."""
        seconds: list[float] = []
        states: list[np.ndarray] = []

        def on_decision(record: DecisionRecord) -> None:
            seconds.append(record.milliseconds / 1e3)
            states.append(record.state)

        begin = time.perf_counter()
        outcome = run_closed_loop(
            self._simulator,
            instance,
            physics,
            # A task's own seed: the planner's streams know no index of an instance.
            seed=seed * 1_000_000 + index,
            time_limit=self._time_limit,
            on_decision=on_decision,
        )
        state = self._simulator.get_system().GetOutputPort("state")
        states.append(state.Eval(self._simulator.get_context()))
        succeeded = outcome.status == "succeeded"
        return Episode(
            outcome.status.replace("_", " "),
            outcome.num_actions,
            seconds,
            outcome.time,
            time.perf_counter() - begin - sum(seconds),
            "" if succeeded else describe_ending(states, instance.goals),
        )
