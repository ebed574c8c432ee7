"""Runs a policy in closed loop: one action at a time, whenever the scene is at rest.

Any `planning.policy.Policy` will do, not RHP alone.
"""

from dataclasses import dataclass, replace
import enum
import time
from typing import Any, Final

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from rhp_drake.errors import InputError
from rhp_drake.planning.policy import Decision, Policy, PolicyError
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.task import (
    MAX_ACTIONS,
    Action,
    allowed_actions,
    goals_reached,
    hand_targets,
    object_positions,
    objects_fallen,
)

PLANNER_PERIOD: Final = 0.05  # s
# How close to its target the hand has arrived.
ARRIVAL_DISTANCE: Final = 0.002  # m
ARRIVAL_ANGLE: Final = 0.02  # rad
# The longest action takes under 2 s.
PATIENCE: Final = 5.0  # s
# What may move while the policy thinks, of each body; trackers err by less.
_UNCHANGED_DISTANCE: Final = 0.002  # m
_UNCHANGED_ANGLE: Final = 0.02  # rad
# A parameter of the context is a double; up to here it holds every integer.
MAX_SEED: Final = 2**53


def has_arrived(hand: np.ndarray, target: np.ndarray) -> bool:
    """Whether the hand's pose, shape (3,), is the target's, as near as it gets."""
    x, y, angle = np.abs(hand - target)
    return bool(np.hypot(x, y) <= ARRIVAL_DISTANCE and angle <= ARRIVAL_ANGLE)


def _unchanged(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether all bodies of two states, shape (3 + 3 m,), are in the same places."""
    moved = (now - before).reshape(-1, 3)
    angles = np.remainder(moved[:, 2] + np.pi, 2 * np.pi) - np.pi
    return bool(
        (np.linalg.norm(moved[:, :2], axis=1) <= _UNCHANGED_DISTANCE).all()
        and (np.abs(angles) <= _UNCHANGED_ANGLE).all()
    )


class Status(enum.IntEnum):
    """Whether the episode runs, and how it ended."""

    RUNNING = 0
    SUCCEEDED = 1
    OUT_OF_ACTIONS = 2
    OBJECT_FELL = 3
    POLICY_FAILED = 4
    TIMED_OUT = 5  # An action did not come to its end.


@dataclass(frozen=True)
class DecisionRecord:
    """A decision and its circumstances.

    Attributes:
        index: How many decisions the episode had before.
        time: Of the simulation, s.
        state: What the policy saw, shape (3 + 3 m,).
        decision: What it decided.
        milliseconds: How long it computed, by the clock on the wall.
        target_distance: From the target object to its goal, m.
    """

    index: int
    time: float
    state: np.ndarray
    decision: Decision
    milliseconds: float
    target_distance: float


# Before the first decision.  Newer Drake's abstract values do not take None.
NO_DECISION: Final = DecisionRecord(
    index=-1,
    time=0.0,
    state=np.empty(0),
    decision=Decision(action=-1, value=np.nan),
    milliseconds=0.0,
    target_distance=np.nan,
)


@dataclass(frozen=True)
class _Episode:
    """The planner's state: all that changes in the course of an episode.

    Attributes:
        hand_target: Where the hand was sent last, shape (3,).
        sent_time: When, s.
        num_actions: How many actions there were.
        record: The latest decision that is executed, None before the first.
        pending: A decision after it, made a moment ago.
    """

    hand_target: np.ndarray
    sent_time: float = 0.0
    num_actions: int = 0
    record: DecisionRecord | None = None
    pending: DecisionRecord | None = None
    status: Status = Status.RUNNING
    message: str = ""

    def ended(self, status: Status, message: str) -> "_Episode":
        """The episode after its end; the hand's target stays."""
        return replace(self, status=status, message=message)


class RecedingHorizonPlanner(LeafSystem):
    """Asks a policy for an action, waits until it is done, and asks again.

    Named for RHP, the paper's policy, it runs any: greedy, KDP (open loop or checked),
    predictive sampling, MPPI, and random, too.

    An action is done when the hand has arrived at its target and the scene is at
    rest.  A decision is executed at the tick after, if nothing has moved since: a real
    scene may change while the policy thinks, and then the policy decides anew.

    The episode ends when all objects are at their goals, after `MAX_ACTIONS` actions,
    when an object has fallen, when the policy fails, state or goals are not finite, or
    when an action is not done after `PATIENCE`.  Then the hand's target stays where it
    is.

    The policy's computation takes no simulated time, so results do not depend on the
    computer; `DecisionRecord.milliseconds` tells how long it was.

    The policy itself does not change.  Its memory is part of the context, which Drake
    copies, so it must work with `copy.deepcopy`.

    .. pydrake_system::

        name: RecedingHorizonPlanner
        input_ports:
        - state
        - at_rest
        - goals
        output_ports:
        - hand_target
        - decision
        - status
        - message

    `state` has size 3 + 3 m, see `rhp_drake.task`; `at_rest` has size 1 and is 0 or
    1; `goals` has size 2 m, the rows of an (m, 2) array one after the other.
    `hand_target` has size 3, a pose of the hand; `decision` is a `DecisionRecord`,
    `NO_DECISION` before the first; `status` has size 1, a value of `Status`; `message`
    is a string that says why the episode ended.

    Args:
        policy: Chooses the actions.
        num_objects: m, the target included.
    """

    def __init__(self, policy: Policy, num_objects: int) -> None:
        super().__init__()
        self._policy = policy
        self._state_port = self.DeclareVectorInputPort(
            name="state", size=3 + 3 * num_objects
        )
        self._at_rest_port = self.DeclareVectorInputPort(name="at_rest", size=1)
        self._goals_port = self.DeclareVectorInputPort(
            name="goals", size=2 * num_objects
        )
        self._seed = self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        episode = self.DeclareAbstractState(
            AbstractValue.Make(_Episode(hand_target=np.full(3, np.nan)))
        )
        self._episode = int(episode)
        prerequisites = {self.abstract_state_ticket(episode)}
        self.DeclareVectorOutputPort(
            name="hand_target",
            size=3,
            calc=self._CalcHandTarget,
            prerequisites_of_calc=prerequisites,
        )
        self.DeclareAbstractOutputPort(
            name="decision",
            alloc=lambda: AbstractValue.Make(NO_DECISION),
            calc=self._CalcDecision,
            prerequisites_of_calc=prerequisites,
        )
        self.DeclareVectorOutputPort(
            name="status",
            size=1,
            calc=self._CalcStatus,
            prerequisites_of_calc=prerequisites,
        )
        self.DeclareAbstractOutputPort(
            name="message",
            alloc=lambda: AbstractValue.Make(""),
            calc=self._CalcMessage,
            prerequisites_of_calc=prerequisites,
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(update=self._Initialize)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec=PLANNER_PERIOD, offset_sec=0.0, update=self._Update
        )

    def set_seed(self, context: Context, seed: int) -> None:
        """Sets the seed of the policy's random draws in this system's context.

        Raises:
            InputError: If the seed is negative or above `MAX_SEED`.
        """
        if not 0 <= seed <= MAX_SEED:
            raise InputError(f"seed {seed} is not in 0 to {MAX_SEED}.")
        context.get_mutable_numeric_parameter(self._seed).SetAtIndex(0, float(seed))

    def _get_episode(self, context: Context) -> _Episode:
        return context.get_abstract_state(self._episode).get_value()

    def _CalcHandTarget(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._get_episode(context).hand_target)

    def _CalcDecision(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._get_episode(context).record or NO_DECISION)

    def _CalcStatus(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._get_episode(context).status))

    def _CalcMessage(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._get_episode(context).message)

    def _set_episode(self, state: State, episode: _Episode) -> None:
        state.get_mutable_abstract_state(self._episode).set_value(episode)

    def _Initialize(self, context: Context, state: State) -> None:
        hand = self._state_port.Eval(context)[:3].copy()
        self._set_episode(
            state, _Episode(hand_target=hand, sent_time=context.get_time())
        )

    def _Update(self, context: Context, state: State) -> None:
        episode = self._get_episode(context)
        if episode.status == Status.RUNNING:
            self._set_episode(state, self._Step(context, episode))

    def _Step(self, context: Context, episode: _Episode) -> _Episode:
        """The episode after this moment."""
        state = self._state_port.Eval(context)
        goals = self._goals_port.Eval(context).reshape(-1, 2)
        if not np.isfinite(state).all():
            return episode.ended(
                Status.POLICY_FAILED, f"the measured state {state} is not finite."
            )
        if not np.isfinite(goals).all():
            return episode.ended(
                Status.POLICY_FAILED, f"the goals {goals.tolist()} are not finite."
            )
        if objects_fallen(state):
            return episode.ended(Status.OBJECT_FELL, "an object fell off the table.")
        arrived = has_arrived(state[:3], episode.hand_target)
        if not (arrived and self._at_rest_port.Eval(context)[0]):
            if context.get_time() - episode.sent_time < PATIENCE:
                return replace(episode, pending=None)
            x, y, angle = np.abs(state[:3] - episode.hand_target)
            problem = (
                f"the objects have not come to rest within {PATIENCE} s."
                if arrived
                else f"after {PATIENCE} s the hand is still "
                f"{1000 * np.hypot(x, y):.1f} mm and {angle:.3f} rad from its target."
            )
            return episode.ended(Status.TIMED_OUT, problem)
        return self._AtRest(context, episode, state, goals)

    def _AtRest(
        self, context: Context, episode: _Episode, state: np.ndarray, goals: np.ndarray
    ) -> _Episode:
        """The episode after a moment in which an action is done."""
        if goals_reached(state, goals):
            return episode.ended(Status.SUCCEEDED, "all objects are at their goals.")
        if episode.num_actions >= MAX_ACTIONS:
            return episode.ended(
                Status.OUT_OF_ACTIONS, f"{MAX_ACTIONS} actions did not suffice."
            )
        pending = episode.pending
        if pending is not None and _unchanged(pending.state, state):
            return replace(
                episode,
                hand_target=hand_targets(state, np.array(pending.decision.action)),
                sent_time=context.get_time(),
                num_actions=pending.index + 1,
                record=pending,
                pending=None,
            )
        return self._Decide(context, episode, state, goals)

    def _Decide(
        self, context: Context, episode: _Episode, state: np.ndarray, goals: np.ndarray
    ) -> _Episode:
        """The episode after one more decision of the policy, which is pending."""
        index = episode.num_actions
        seed = int(context.get_numeric_parameter(self._seed).GetAtIndex(0))
        memory: Any = episode.record.decision.memory if episode.record else None
        start = time.perf_counter()
        try:
            decision = self._policy.decide(
                state, goals, stream(seed, "decision", index), memory
            )
        except (PolicyError, PushModelError) as failure:
            return episode.ended(Status.POLICY_FAILED, str(failure))
        milliseconds = 1000 * (time.perf_counter() - start)
        if not allowed_actions(state, np.array([decision.action])).item():
            return episode.ended(
                Status.POLICY_FAILED,
                f"the policy chose {Action(decision.action).name}, which takes the "
                "hand out of its workspace.",
            )
        return replace(
            episode,
            pending=DecisionRecord(
                index=index,
                time=context.get_time(),
                state=state.copy(),
                decision=decision,
                milliseconds=milliseconds,
                target_distance=float(
                    np.linalg.norm(object_positions(state)[0] - goals[0])
                ),
            ),
        )
