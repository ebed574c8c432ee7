"""OMPL's control RRT and SST on the push model, set up as for rearrangement planning.

The distance follows Haustein et al. (ICRA 2015): a weighted sum over hand, target and
obstacles.  RRT extends its nearest state by the action that leads nearest to the
sample, out of those that its tree does not have yet.  SST (Li, Littlefield and Bekris,
IJRR 2016) draws actions at random, as it has to.  No action of a state is simulated
twice.

OMPL 1.7 is meant: in the Python bindings of 2.0, SST has no constructor, and there are
neither discrete controls nor directed samplers of one's own.
"""

from collections.abc import Callable
import math
import time
from typing import Any, Final

import numpy as np
import ompl

from rhp_drake.benchmarks.ompl_problem import NO_NODE, Problem
from rhp_drake.benchmarks.planners import Found
from rhp_drake.push_model.transition import PushModel
from rhp_drake.task import (
    GOAL_RADIUS,
    HAND_ACTIONS,
    TABLE_LOWER,
    TABLE_UPPER,
    TaskInstance,
)

# The wheel has the library twice.  This would load the second copy, whose destructors
# free what the first's have freed: a crash at exit.
ompl.dll_loader = lambda library, path: None

from ompl import base, control, util  # noqa: E402

# Tuned on validation tasks 100 to 119.
# Weights of the distance, whose unit is a metre of the target's way: of the hand's way,
# of a radian of its heading (m), and of each obstacle's way.
_HAND_WEIGHT: Final = 0.4
_HEADING_WEIGHT: Final = 0.02
_OBSTACLE_WEIGHT: Final = 0.4
_GOAL_BIAS: Final = 0.1
# m, in the distance above, where an action of the hand alone is 0.01 to 0.02.
_SELECTION_RADIUS: Final = 0.02
_PRUNING_RADIUS: Final = 0.004


def _make_space(num_objects: int) -> Any:
    """The space of the states that `Problem` reads and writes."""
    space = base.CompoundStateSpace()
    space.addSubspace(_plane(), _HAND_WEIGHT)
    space.addSubspace(base.SO2StateSpace(), _HEADING_WEIGHT)
    space.addSubspace(_plane(), 1.0)
    for _ in range(num_objects - 1):
        space.addSubspace(_plane(), _OBSTACLE_WEIGHT)
    node = base.RealVectorStateSpace(1)
    node.setBounds(NO_NODE, 1e9)
    space.addSubspace(node, 0.0)
    return space


def _plane() -> Any:
    """The table's top, with room for the hand, which may stand at its border."""
    plane = base.RealVectorStateSpace(2)
    bounds = base.RealVectorBounds(2)
    for i in range(2):
        bounds.setLow(i, float(TABLE_LOWER[i]))
        bounds.setHigh(i, float(TABLE_UPPER[i]))
    plane.setBounds(bounds)
    return plane


class _Goal(base.GoalSampleableRegion):
    """Every object in its region."""

    def __init__(self, information: Any, problem: Problem) -> None:
        super().__init__(information)
        self._problem = problem
        self.setThreshold(GOAL_RADIUS)

    def distanceGoal(self, state: Any) -> float:
        return self._problem.goal_distance(state)

    def sampleGoal(self, state: Any) -> None:
        self._problem.sample(state, goal=True)

    def maxSampleCount(self) -> int:
        return 1_000_000


class _Sampler(base.StateSampler):
    """Places to grow to."""

    def __init__(self, space: Any, problem: Problem) -> None:
        super().__init__(space)
        self._problem = problem

    def sampleUniform(self, state: Any) -> None:
        self._problem.sample(state, goal=False)


class _DirectedSampler(control.DirectedControlSampler):
    """The action that leads nearest to the sample, of those not in the tree yet."""

    def __init__(self, information: Any, problem: Problem, space: Any) -> None:
        super().__init__(information)
        self._problem = problem
        self._space = space
        self._child = base.State(space)
        self._added: set[int] = set()

    def sampleTo(self, action: Any, *states: Any) -> int:
        """See OMPL.  Between the action and the states may be the previous action."""
        source, sample = states[-2:]
        nearest, nearest_distance = None, math.inf
        for index, node in self._problem.children(self._problem.node(source)).items():
            if node in self._added:
                continue
            child = self._child()
            self._problem.write(child, node)
            distance = self._space.distance(child, sample)
            if self._problem.goal_distance(child) < GOAL_RADIUS:
                distance = 0.0
            if distance < nearest_distance:
                nearest, nearest_distance = node, distance
                action.value = index
        if nearest is None:
            return 0
        self._added.add(nearest)
        self._problem.write(sample, nearest)
        return 1


class _FewestActions(base.OptimizationObjective):
    """SST's: each action costs one, and the first plan is good enough."""

    def __init__(self, information: Any) -> None:
        super().__init__(information)
        self.setCostThreshold(base.Cost(math.inf))

    def stateCost(self, state: Any) -> Any:
        return base.Cost(1.0)

    def motionCost(self, start: Any, end: Any) -> Any:
        return base.Cost(1.0)


def _make_rrt(information: Any) -> Any:
    planner = control.RRT(information)
    planner.setGoalBias(_GOAL_BIAS)
    return planner


def _make_sst(information: Any) -> Any:
    planner = control.SST(information)
    planner.setGoalBias(_GOAL_BIAS)
    planner.setSelectionRadius(_SELECTION_RADIUS)
    planner.setPruningRadius(_PRUNING_RADIUS)
    return planner


# By name: what makes the planner.
OMPL_PLANNERS: Final[dict[str, Callable[[Any], Any]]] = {
    "rrt": _make_rrt,
    "sst": _make_sst,
}


def _make_information(space: Any, problem: Problem) -> Any:
    """OMPL's SpaceInformation: how to sample `space`, and what the actions do in it."""
    information = control.SpaceInformation(
        space, control.DiscreteControlSpace(space, 0, len(HAND_ACTIONS) - 1)
    )

    def propagate(start: Any, action: Any, duration: float, result: Any) -> None:
        node = problem.children(problem.node(start)).get(action.value)
        if node is None:
            problem.write_no_node(result)
        else:
            problem.write(result, node)

    space.setStateSamplerAllocator(
        base.StateSamplerAllocator(lambda of: _Sampler(of, problem))
    )
    information.setDirectedControlSamplerAllocator(
        control.DirectedControlSamplerAllocator(
            lambda of: _DirectedSampler(of, problem, space)
        )
    )
    information.setStatePropagator(control.StatePropagatorFn(propagate))
    information.setStateValidityChecker(
        base.StateValidityCheckerFn(lambda state: problem.node(state) != NO_NODE)
    )
    information.setMinMaxControlDuration(1, 1)
    information.setPropagationStepSize(1.0)
    return information


def plan_with_ompl(
    name: str,
    push_model: PushModel,
    task: TaskInstance,
    generator: np.random.Generator,
    *,
    time_limit: float = math.inf,
    max_transitions: int = 1_000_000,
) -> Found:
    """Plans with one of `OMPL_PLANNERS`.

    The same generator gives the same search.  OMPL's own random numbers come from a
    seed of the whole process, which is set anew here for the planner made here: only
    one search at a time may run in a process.

    Args:
        name: Of the planner.
        push_model: What the actions are simulated in.
        task: What to plan for.
        generator: Of samples, and of OMPL's seed.
        time_limit: Limit of computation, s.
        max_transitions: Limit of simulated actions.
    """
    begin = time.perf_counter()
    # OMPL complains about a new seed, which does what is wanted all the same.
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(int(generator.integers(1, 2**31)))
    problem = Problem(push_model, task, generator)
    space = _make_space(task.num_objects)
    information = _make_information(space, problem)

    def stop() -> bool:
        return (
            problem.num_transitions >= max_transitions
            or time.perf_counter() - begin > time_limit
        )

    definition = base.ProblemDefinition(information)
    start = base.State(space)
    problem.write(start(), 0)
    definition.addStartState(start)
    definition.setGoal(_Goal(information, problem))
    definition.setOptimizationObjective(_FewestActions(information))
    planner = OMPL_PLANNERS[name](information)
    planner.setProblemDefinition(definition)
    planner.setup()
    planner.solve(
        base.PlannerTerminationCondition(base.PlannerTerminationConditionFn(stop))
    )
    actions = None
    if definition.hasExactSolution():
        path = definition.getSolutionPath()
        actions = HAND_ACTIONS[
            [path.getControl(i).value for i in range(path.getControlCount())]
        ]
    seconds = time.perf_counter() - begin
    # Both planners stop at their first plan.
    first_seconds = math.nan if actions is None else seconds
    return Found(actions, problem.num_transitions, seconds, first_seconds)
