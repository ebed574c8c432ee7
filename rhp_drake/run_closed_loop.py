"""How a task runs in the closed loop, simulated or on hardware."""

from collections.abc import Callable
from dataclasses import dataclass
import time
from typing import Any, Final

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake import task
from rhp_drake.errors import InputError
from rhp_drake.physics import ObjectPhysics
from rhp_drake.safety import Fault, describe
from rhp_drake.station.hardware_station import MeasureStation
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.simulated_station import SetStationState
from rhp_drake.systems.receding_horizon_planner import (
    PLANNER_PERIOD,
    DecisionRecord,
    Status,
)

SUCCEEDED: Final = Status.SUCCEEDED.name.lower()
GUARD_FAULT: Final = "guard_fault"
TIME_LIMIT: Final = "time_limit"


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        status: The planner's `Status`, in lower case, or `GUARD_FAULT`, `TIME_LIMIT`.
        message: Why it ended, one sentence.
        num_actions: How many actions were executed.
        time: Simulated time, s.
        target_distance: From the target to the centre of its goal region, m.
        fault: Why the arm was stopped, if it was.
    """

    status: str
    message: str
    num_actions: int
    time: float
    target_distance: float
    fault: Fault = Fault.NONE

    @property
    def succeeded(self) -> bool:
        """Whether all objects ended at their goals."""
        return self.status == SUCCEEDED


def output_of(simulator: Simulator, system: str, port: str) -> Any:
    """What is at an output port of one of the loop's systems now."""
    dut = simulator.get_system().GetSubsystemByName(system)
    context = dut.GetMyContextFromRoot(simulator.get_context())
    return dut.GetOutputPort(port).Eval(context)


def goals_of(simulator: Simulator) -> np.ndarray:
    """Centres of the goal regions, shape (m, 2), m in W; nan without a task."""
    return output_of(simulator, "goals", "y0").reshape(-1, 2)


def _fault_of(simulator: Simulator) -> Fault:
    """Why the guard has stopped the arm, if it has."""
    return Fault(int(output_of(simulator, "command_guard", "fault")[0]))


def run_closed_loop(
    simulator: Simulator,
    instance: task.TaskInstance,
    physics: ObjectPhysics,
    *,
    seed: int,
    time_limit: float = np.inf,
    on_decision: Callable[[DecisionRecord], None] = lambda record: None,
) -> Outcome:
    """Runs a task from its start to its end.

    The same arguments give the same run, whatever ran in the simulator before.

    Args:
        simulator: Of a diagram with what `AddClosedLoop` added.
        instance: The task.
        physics: Of the objects in the world.
        seed: Of the policy's random draws.
        time_limit: When to give up, in simulated seconds.
        on_decision: Called soon after each decision.
    """
    _reset(simulator, seed)
    _put_task(simulator, instance, physics)
    simulator.Initialize()

    def advance(time: float) -> None:
        # Between two calls Python handles Ctrl-C, so Drake need not look for it.
        simulator.AdvanceTo(time, interruptible=False)

    return _run(simulator, advance, time_limit, on_decision)


def run_on_hardware(
    simulator: Simulator,
    goal: np.ndarray,
    *,
    seed: int,
    time_limit: float = np.inf,
    on_decision: Callable[[DecisionRecord], None] = lambda record: None,
) -> Outcome:
    """Runs a task that begins where robot and objects are, in real time.

    Each obstacle has to stay where it is measured at first.  While the policy thinks
    time stands still in the diagram, and goes on from there: what is late is never
    caught up with.

    Args:
        simulator: Of a diagram with what `AddClosedLoop` added for `hardware`.
        goal: Centre of the target's goal region, shape (2,), m in W.
        seed: Of the policy's random draws.
        time_limit: When to give up, s, thinking aside.
        on_decision: Called soon after each decision.

    Raises:
        InputError: If not all objects are seen, or the hand is not where it can begin.
    """
    diagram, context = simulator.get_system(), simulator.get_mutable_context()
    _reset(simulator, seed)
    station = diagram.GetSubsystemByName("station")
    station_context = station.GetMyMutableContextFromRoot(context)
    MeasureStation(station, station_context)
    ages = station.GetOutputPort("object_ages").Eval(station_context)
    if unseen := np.flatnonzero(~np.isfinite(ages)).tolist():
        raise InputError(f"the tracker does not see the objects {unseen}.")
    measured = station.GetOutputPort("ur5.position_measured").Eval(station_context)
    # Where they are not finite, initialization says so.
    if np.isfinite(measured).all():
        diagram.GetSubsystemByName("hand_servo").check_start(measured)
    state = output_of(simulator, "state_estimator", "state")
    goals = task.object_positions(state).copy()
    goals[0] = goal
    _set_goals(simulator, goals)
    # What begins at the task's beginning, such as the overlay's discs, needs the goals.
    simulator.Initialize()

    ticks = 0

    def advance(until: float) -> None:
        nonlocal ticks
        # After a fault at once: who called ends the drivers, which brake.
        while context.get_time() < until and _fault_of(simulator) == Fault.NONE:
            begin = time.monotonic()
            # Half-way between two commands, so that each stretch has exactly one: the
            # planner's period is no multiple of theirs.
            ticks += 1
            next_time = (ticks - 0.5) * COMMAND_PERIOD
            simulator.AdvanceTo(next_time, interruptible=False)
            time.sleep(max(0.0, begin + COMMAND_PERIOD - time.monotonic()))

    return _run(simulator, advance, time_limit, on_decision)


def _run(
    simulator: Simulator,
    advance: Callable[[float], None],
    time_limit: float,
    on_decision: Callable[[DecisionRecord], None],
) -> Outcome:
    """Runs an initialized simulator until the task ends.

    Args:
        simulator: Of the closed loop.
        advance: Advances it to a time, or a little further.
        time_limit: See `run_closed_loop`.
        on_decision: Likewise.
    """
    context = simulator.get_context()
    num_actions = 0
    ticks = 0
    end, message = "", ""
    while not end:
        ticks += 1
        advance(ticks * PLANNER_PERIOD)
        record = output_of(simulator, "planner", "decision")
        if record.index == num_actions:
            num_actions += 1
            on_decision(record)
        planner_status = Status(int(output_of(simulator, "planner", "status")[0]))
        guard_fault = _fault_of(simulator)
        if guard_fault != Fault.NONE:
            end = GUARD_FAULT
            message = f"the arm was stopped: {describe(guard_fault)}"
        elif planner_status != Status.RUNNING:
            end = planner_status.name.lower()
            message = output_of(simulator, "planner", "message")
        elif context.get_time() >= time_limit:
            end = TIME_LIMIT
            message = f"not done after {time_limit:g} s in the world."

    state = output_of(simulator, "state_estimator", "state")
    offset = task.object_positions(state)[0] - goals_of(simulator)[0]
    return Outcome(
        status=end,
        message=message,
        num_actions=num_actions,
        time=context.get_time(),
        target_distance=float(np.linalg.norm(offset)),
        fault=guard_fault,
    )


def _reset(simulator: Simulator, seed: int) -> None:
    """Puts the simulator's context back to its beginning, at time 0."""
    diagram, context = simulator.get_system(), simulator.get_mutable_context()
    context.SetTime(0.0)
    diagram.SetDefaultContext(context)
    planner = diagram.GetSubsystemByName("planner")
    planner.set_seed(planner.GetMyMutableContextFromRoot(context), seed)


def _put_task(
    simulator: Simulator, instance: task.TaskInstance, physics: ObjectPhysics
) -> None:
    """Puts a task into the simulated station."""
    station = simulator.get_system().GetSubsystemByName("station")
    SetStationState(
        station,
        station.GetMyMutableContextFromRoot(simulator.get_mutable_context()),
        instance.initial_state,
        physics,
    )
    _set_goals(simulator, instance.goals)


def _set_goals(simulator: Simulator, goals: np.ndarray) -> None:
    """Sets the centres of the goal regions, shape (m, 2), m in W."""
    source = simulator.get_system().GetSubsystemByName("goals")
    context = source.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    source.get_mutable_source_value(context).set_value(goals.ravel())
