"""What is said of a run that failed."""

import numpy as np

from rhp_drake.evaluation.failure import (
    OBSTACLE_MOVED,
    cause_of_failure,
    describe_ending,
)
from rhp_drake.task import GOAL_RADIUS

GOALS = np.array([[0.6, 0.0], [0.3, 0.2]])


def state(hand_x=0.35, target_x=0.42, obstacle_y=0.2):
    return np.array([hand_x, 0, 0, target_x, 0, 0, 0.3, obstacle_y, 0])


def test_what_is_outside_is_named_with_its_distance():
    end = state(target_x=0.6 - GOAL_RADIUS - 0.031, obstacle_y=0.2 + GOAL_RADIUS + 0.02)
    assert describe_ending([state(), end], GOALS) == (
        "target 3.1 cm outside, obstacle 1 2.0 cm outside, 0 of 2 states seen before"
    )


def test_circles_are_counted():
    there, back = state(0.35), state(0.40)
    text = describe_ending([there, back, there, back, there], GOALS)
    assert text.endswith("3 of 5 states seen before")


def test_a_target_at_home_is_not_what_failed():
    home, away = 0.6, 0.5
    moved, kept = 0.2 + GOAL_RADIUS + 0.01, 0.2
    for target, obstacle, cause in (
        (home, moved, OBSTACLE_MOVED),
        (away, moved, "out of actions"),
        (away, kept, "out of actions"),
    ):
        end = state(target_x=target, obstacle_y=obstacle)
        assert cause_of_failure("out of actions", end, GOALS) == cause
