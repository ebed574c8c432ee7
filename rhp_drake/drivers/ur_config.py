"""How to reach a UR robot, and what it may be told."""

from dataclasses import dataclass, field

from rhp_drake.errors import InputError
from rhp_drake.safety import JointLimits


@dataclass
class UrDriverConfig:
    """How to reach the robot, and what it may be told.

    Attributes:
        host: Its address.
        lookahead_time: Of servoJ, 0.03 to 0.2 s: more is smoother and later.
        gain: Of servoJ, 100 to 2000: more follows closer.
        limits: On commands.
        command_timeout: How long the arm may move without a new command, s.
        measurement_timeout: How long the robot may be silent, s.
        patience: How long it may stand still without one, s: a policy thinks while the
            hand rests.
        connection_timeout: How long the robot may take to answer at first, s.
        dry_run: Whether everything is done but moving the arm; it is then said to be
            where it was commanded to be.  True unless the file says false.
    """

    host: str = ""
    lookahead_time: float = 0.1
    gain: float = 300.0
    limits: JointLimits = field(default_factory=JointLimits)
    command_timeout: float = 0.08
    measurement_timeout: float = 0.04
    patience: float = 5.0
    connection_timeout: float = 10.0
    dry_run: bool = True

    def validate(self) -> None:
        """Raises an InputError that names the first impossible value."""
        if not self.host:
            raise InputError("ur.host: the robot's address is missing.")
        self.limits.validate("ur.limits.")
        for name, low, high in (
            ("lookahead_time", 0.03, 0.2),
            ("gain", 100.0, 2000.0),
            ("command_timeout", 0.01, 1.0),
            ("measurement_timeout", 0.01, 1.0),
            ("patience", 0.01, 600.0),
            ("connection_timeout", 0.1, 600.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(
                    f"ur.{name} is {value}; it must be from {low:g} to {high:g}."
                )
