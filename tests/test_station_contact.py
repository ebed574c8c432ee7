"""The station's contact against a theory that knows nothing of it.

A flat palm pushes the corner of a box slowly.  K. M. Lynch, H. Maekawa and K. Tanie,
"Manipulation and active sensing by pushing using tactile feedback" (IROS 1992), give
the box's motion in closed form for an ellipsoidal limit surface.  The yaws below are
those at which the corner sticks to the palm.  Where it slides, the box turns nearly on
the spot, and what the theory leaves out counts: pushed above its bottom, a box presses
more on the table in front.
"""

import math

import numpy as np
from pydrake.systems.analysis import Simulator
import pytest

from rhp_drake.physics import NOMINAL_FRICTION, nominal_physics
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.simulated_station import (
    MakeSimulatedStation,
    SetStationState,
)
from rhp_drake.station.station_models import StationConfig
from rhp_drake.station.ur5_kinematics import inverse_kinematics
from rhp_drake.task import BOX_SIDE

HALF = BOX_SIDE / 2
# Largest frictional torque over largest force of a uniformly pressed square.
LIMIT_SURFACE_LENGTH = 0.3826 * BOX_SIDE
HAND_X, PALM_X = 0.4, 0.36  # m, of H and of the palm's face.
SPEED = 0.05  # m/s


def initial_box(yaw: float) -> np.ndarray:
    """The box whose corner nearest to the palm is 1 mm before it."""
    return np.array([PALM_X + HALF * (math.cos(yaw) + math.sin(yaw)) + 1e-3, 0, yaw])


def quasi_static_push(yaw: float, distance: float) -> np.ndarray:
    """Where theory has the box after the palm has moved along +x, shape (3,)."""
    x, y, theta = initial_box(yaw)
    steps = 2000
    for palm in PALM_X + distance * np.arange(1, steps + 1) / steps:
        # The touching corner, seen from the box's centre.
        a = HALF * (-math.cos(theta) - math.sin(theta))
        b = HALF * (-math.sin(theta) + math.cos(theta))
        push = palm - (x + a)
        if push <= 0:
            continue
        # Sticking: the corner moves with the palm, and force is along velocity.
        c2 = LIMIT_SURFACE_LENGTH**2
        vx, vy = np.array([c2 + a * a, a * b]) * push / (c2 + a * a + b * b)
        if abs(vy) > NOMINAL_FRICTION * vx:  # Sliding: force at the cone's edge.
            vy = math.copysign(NOMINAL_FRICTION, vy)
            scale = push / (1 - b * (a * vy - b) / c2)
            vx, vy = scale, vy * scale
        x, y, theta = x + vx, y + vy, theta + (a * vy - b * vx) / c2
    return np.array([x, y, theta])


def simulated_push(yaw: float, distance: float) -> np.ndarray:
    """Where the station has it, shape (3,)."""
    station = MakeSimulatedStation(StationConfig())
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    hand = np.array([HAND_X, 0, 0])
    away = [0.7, 0.25, 0, 0.7, -0.25, 0]
    state = np.concatenate([hand, initial_box(yaw), away])
    SetStationState(station, context, state, nominal_physics(3))
    position = station.GetInputPort("ur5.position")
    num_commands = round(distance / SPEED / COMMAND_PERIOD)
    for k in range(1, num_commands + 13):
        hand[0] = HAND_X + distance * min(k / num_commands, 1)
        position.FixValue(context, inverse_kinematics(hand))
        simulator.AdvanceTo(k * COMMAND_PERIOD)
    X_WB = station.GetOutputPort("object_poses").Eval(context)[0]
    angle = X_WB.rotation().ToRollPitchYaw().yaw_angle()
    return np.array([*X_WB.translation()[:2], angle])


@pytest.mark.parametrize("yaw", [0.6, 0.65, 0.7])
def test_pushing_a_corner_is_as_in_theory(yaw):
    distance = 0.02
    theory = quasi_static_push(yaw, distance)
    simulated = simulated_push(yaw, distance)
    assert theory[2] < yaw - math.radians(1)
    np.testing.assert_allclose(simulated[:2], theory[:2], rtol=0, atol=4e-4)
    assert abs(simulated[2] - theory[2]) < math.radians(0.5)
