"""Who makes demonstrations: the RRT, a search guided by a Q-network, and RHP."""

from dataclasses import dataclass, field, replace
from functools import cached_property
import time
from typing import Final

import numpy as np

from rhp_drake.learning.dataset import Dataset
from rhp_drake.learning.demonstration import Demonstration, training_task
from rhp_drake.physics import ObjectPhysics, draw_physics, nominal_physics
from rhp_drake.planning.best_first import plan_best_first
from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.planning.policy import PolicyError
from rhp_drake.planning.receding_horizon import RecedingHorizon
from rhp_drake.planning.search import Plan, Search, SearchRecord, chain
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.task import (
    MAX_ACTIONS,
    TaskInstance,
    allowed_actions,
    goals_reached,
    objects_fallen,
)
from rhp_drake.value.q_network import QNetwork

# A task not solved with this many simulated actions yields its trees but no plan.
_MAX_TRANSITIONS: Final = 6000


@dataclass(frozen=True)
class PlanningDemonstrator:
    """Plans with the kinodynamic RRT (section IV-A of the paper), and shortens plans.

    Attributes:
        seed: Of the tasks and the searches.
        num_objects: m.
    """

    seed: int
    num_objects: int

    @cached_property
    def _push_model(self) -> PushModel:
        return PushModel(self.num_objects)

    def demonstrate(self, task: int) -> Demonstration:
        """See `demonstration.Demonstrator`."""
        instance = training_task(self.seed, task, self.num_objects)
        found = plan(
            self._push_model,
            instance.initial_state,
            instance.goals,
            stream(self.seed, TRAINING, task, "kinodynamic_rrt"),
            max_transitions=_MAX_TRANSITIONS,
        )
        return _demonstration(self.seed, task, instance, found)


@dataclass(frozen=True)
class GuidedDemonstrator:
    """Plans best first, with the actions that a Q-network proposes.

    Attributes:
        seed: Of the tasks.
        q_network: Proposes; its m is that of the tasks.
    """

    seed: int
    q_network: QNetwork

    @property
    def num_objects(self) -> int:
        """See `demonstration.Demonstrator`."""
        return self.q_network.num_objects

    @cached_property
    def _push_model(self) -> PushModel:
        return PushModel(self.num_objects)

    def demonstrate(self, task: int) -> Demonstration:
        """See `demonstration.Demonstrator`."""
        instance = training_task(self.seed, task, self.num_objects)
        found = plan_best_first(
            self._push_model,
            self.q_network,
            instance.initial_state,
            instance.goals,
            max_transitions=_MAX_TRANSITIONS,
        )
        return _demonstration(self.seed, task, instance, found)


@dataclass(frozen=True, kw_only=True)
class Acting:
    """How epsilon-RHP acts, and what is kept of it.

    Attributes:
        epsilon: How often the action is a random one.
        temperature: tau of Eq. 5, in actions.
        num_roll_outs: n.
        horizon: h; 0 makes it epsilon-greedy.
        uncertainty: Of the physics in which it acts, which RHP does not know.
        executed_only: Whether nothing but what was executed is kept.
    """

    epsilon: float = 0.1
    temperature: float = 0.5
    num_roll_outs: int = 6
    horizon: int = 6
    uncertainty: str = "none"
    executed_only: bool = False
    resets: float = 0.0


@dataclass(frozen=True)
class RecedingHorizonDemonstrator:
    """Acts by epsilon-RHP (section V of the paper).

    It keeps what was executed, as the paper's replay buffer does, or all roll-outs,
    which are more and as true.

    Attributes:
        seed: Of the tasks and the policy.
        q_network: RHP's; its m is that of the tasks.
        acting: How.
    """

    seed: int
    q_network: QNetwork
    acting: Acting = Acting()
    plans: Dataset | None = field(default=None, repr=False)

    @property
    def num_objects(self) -> int:
        """See `demonstration.Demonstrator`."""
        return self.q_network.num_objects

    @cached_property
    def _recorder(self) -> "_RecordingPushModel":
        return _RecordingPushModel(self.num_objects)

    @cached_property
    def _policy(self) -> RecedingHorizon:
        return RecedingHorizon(
            self._recorder,
            self.q_network,
            self.acting.num_roll_outs,
            self.acting.horizon,
            self.acting.temperature,
        )

    def demonstrate(self, task: int) -> Demonstration:
        """See `demonstration.Demonstrator`."""
        begin = time.perf_counter()
        instance = training_task(self.seed, task, self.num_objects)
        physics = draw_physics(
            self.acting.uncertainty,
            instance.initial_state,
            stream(self.seed, TRAINING, task, "world_physics"),
        )
        instance = self._reset(instance, task)
        states, actions = self._act(instance, physics, task)
        seconds = time.perf_counter() - begin
        search = (
            chain(np.array(states), np.array(actions, int))
            if self.acting.executed_only
            else self._recorder.search()
        )
        if goals_reached(states[-1], instance.goals):
            found = Plan(np.array(actions), np.array(states), search, seconds, seconds)
        else:
            found = Plan(None, instance.initial_state[None], search, seconds, np.nan)
        return _demonstration(self.seed, task, instance, found)

    def _reset(self, instance: TaskInstance, task: int) -> TaskInstance:
        """Now and then a state of a plan, and its goals, instead of a fresh task."""
        if self.plans is None:
            return instance
        generator = stream(self.seed, TRAINING, task, "reset")
        if generator.random() >= self.acting.resets:
            return instance
        row = generator.integers(len(self.plans.plan_states))
        return replace(
            instance,
            initial_state=self.plans.plan_states[row].astype(float),
            goals=self.plans.goals[self.plans.plan_tasks[row]].astype(float),
        )

    def _act(
        self, instance: TaskInstance, physics: ObjectPhysics, task: int
    ) -> tuple[list[np.ndarray], list[int]]:
        """An episode: its states, and the actions between them."""
        generator = stream(self.seed, TRAINING, task, "epsilon_rhp")
        state, goals = instance.initial_state, instance.goals
        self._recorder.forget()
        states, actions = [state], []
        for _ in range(MAX_ACTIONS):
            explores = generator.random() < self.acting.epsilon
            try:
                decision = self._policy.decide(state, goals, generator)
                action = decision.action
                if explores:
                    allowed = np.flatnonzero(allowed_actions(state))
                    action = int(generator.choice(allowed))
                state = self._recorder.execute(state, action, physics)
            except (PolicyError, PushModelError):
                # Where the boxes are smaller than RHP believes, they may come so close
                # to one another that it sees them overlap.
                break
            states.append(state)
            actions.append(action)
            if goals_reached(state, goals) or objects_fallen(state):
                break
        return states, actions


def _demonstration(
    seed: int, task: int, instance: TaskInstance, found: Plan
) -> Demonstration:
    return Demonstration(
        seed, task, instance, found.actions, found.states, found.search, found.seconds
    )


class _RecordingPushModel:
    """A push model that remembers what it simulates, and simulates nothing twice."""

    def __init__(self, num_objects: int) -> None:
        self._push_model = PushModel(num_objects)
        self._physics = nominal_physics(num_objects)
        self.forget()

    def forget(self) -> None:
        """Starts an empty record."""
        self._record = SearchRecord(3 + 3 * self._push_model.num_objects)
        self._known: dict[tuple[bytes, int], np.ndarray] = {}
        # Which transition led to each state.
        self._origins: dict[bytes, int] = {}

    def search(self) -> Search:
        """All that was simulated since."""
        return self._record.search()

    def execute(
        self, state: np.ndarray, action: int, physics: ObjectPhysics
    ) -> np.ndarray:
        """The state after an action in a world of these physics."""
        actions = np.array([action])
        if physics.key() == self._physics.key():
            return self.step(state[None], actions)[0]
        child = self._push_model.step(state[None], actions, physics)[0]
        self._add(state, action, child)
        return child

    def _add(self, state: np.ndarray, action: int, child: np.ndarray) -> None:
        origin = self._origins.get(state.tobytes(), -1)
        (index,) = self._record.add(
            state[None], np.array([action]), child[None], np.array([origin])
        )
        self._origins.setdefault(child.tobytes(), int(index))

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """See `PushModel.step`."""
        keys = [
            (state.tobytes(), int(action))
            for state, action in zip(states, actions, strict=True)
        ]
        new = [i for i, key in enumerate(keys) if key not in self._known]
        if new:
            children = self._push_model.step(states[new], actions[new])
            for i, child in zip(new, children, strict=True):
                self._known[keys[i]] = child
                self._add(states[i], int(actions[i]), child)
        return np.array([self._known[key] for key in keys])
