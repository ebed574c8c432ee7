"""Episodes in the station: the robot, its servo and contact in three dimensions.

The station is no `World` for `run_episode`: there the policy sits in the diagram, as on
a robot, and it is the planner system that waits until the scene is at rest.
"""

import time

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.closed_loop import MakeClosedLoop
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.failure import describe_ending
from rhp_drake.physics import ObjectPhysics
from rhp_drake.planning.policy import Policy
from rhp_drake.run_closed_loop import SUCCEEDED, run_closed_loop
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
        self, instance: TaskInstance, physics: ObjectPhysics, seed: int
    ) -> Episode:
        """Runs the policy on an instance.

        Args:
            instance: What to do.
            physics: Of the objects in the world.
            seed: Of the policy's draws, see `RecedingHorizonPlanner.set_seed`.
        """
        records: list[DecisionRecord] = []
        begin = time.perf_counter()
        outcome = run_closed_loop(
            self._simulator,
            instance,
            physics,
            seed=seed,
            time_limit=self._time_limit,
            on_decision=records.append,
        )
        elapsed = time.perf_counter() - begin
        seconds = [record.milliseconds / 1e3 for record in records]
        state = self._simulator.get_system().GetOutputPort("state")
        states = [record.state for record in records]
        states.append(state.Eval(self._simulator.get_context()).copy())
        succeeded = outcome.status == SUCCEEDED
        return Episode(
            outcome.status.replace("_", " "),
            [record.decision.action for record in records],
            np.array(states),
            seconds,
            elapsed - sum(seconds),
            outcome.time,
            "" if succeeded else describe_ending(states, instance.goals),
        )
