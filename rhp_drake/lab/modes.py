"""The states of a robot, as numbered by Universal Robots' RTDE guide."""

import enum


class RobotMode(enum.IntEnum):
    """How far the robot is switched on."""

    POWER_OFF = 3
    IDLE = 5  # On, brakes engaged.
    RUNNING = 7  # Brakes released.


class SafetyMode(enum.IntEnum):
    """What the safety system allows."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7
    FAULT = 9


class RuntimeState(enum.IntEnum):
    """What the robot's program does."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


# Bits of safety_status_bits that are set in each mode: bit 7 is "emergency stopped",
# bit 10 "stopped due to safety".
SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
    SafetyMode.FAULT: 1 << 9 | 1 << 10,
}
