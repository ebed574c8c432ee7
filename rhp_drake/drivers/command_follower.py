"""From commands that come when they come to positions that are safe to send."""

from typing import Final

import numpy as np

from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.safety import Fault, check_command

# rad from command to command: slower than this is rounding, not motion.
_STILL: Final = 1e-5


class CommandFollower:
    """Checks commands, and goes from one to the next no faster than allowed.

    Args:
        config: The limits.
        command_period: Time from command to command, s.

    Attributes:
        accepted: The newest command that was, shape (6,), rad; None until the arm is
            engaged.
        moving: Whether it differs from the one before.
    """

    def __init__(self, config: UrDriverConfig, command_period: float) -> None:
        self._config = config
        self._command_period = command_period
        self.let_go()

    def let_go(self) -> None:
        """Forgets everything: the next command has to be where the arm is."""
        self.accepted: np.ndarray | None = None
        self.moving = False
        # When the newest command was accepted, s, and what had been sent by then.
        self._accepted_at = np.nan
        self._before: np.ndarray | None = None
        # What was sent last.
        self._sent: np.ndarray | None = None
        # How much later than due the newest command may have come, s.
        self._slack = self._command_period

    def accept(self, desired: np.ndarray, measured: np.ndarray, now: float) -> Fault:
        """Checks a new command, and makes it the one to follow if it is safe.

        Args:
            desired: The command, shape (6,), rad.
            measured: Where the joints are, shape (6,), rad.
            now: s.
        """
        config, previous = self._config, self.accepted
        # The first command has to be where the arm is.
        accepted = measured if previous is None else previous
        # After a long rest, too, the arm must not be sent far away at once.
        elapsed = now - self._accepted_at if previous is not None else 0.0
        # The commands' clock and this one may be a command apart, but no more: what a
        # command takes beyond its time, the next ones lack.
        allowed = min(elapsed, config.command_timeout) + self._slack
        fault = check_command(
            config.limits,
            allowed,
            desired,
            accepted,
            accepted if config.dry_run else measured,
        )
        if fault == Fault.NONE:
            taken = np.abs(desired - accepted).max() / config.limits.velocity_limit
            self._slack = min(allowed - taken, self._command_period)
            self.moving = (
                previous is not None and np.abs(desired - previous).max() > _STILL
            )
            self._before = desired if self._sent is None else self._sent
            self.accepted, self._accepted_at = desired, now
        return fault

    def next_position(self, now: float, period: float) -> np.ndarray:
        """Where the arm is to be by now, on a straight line to the command.

        It never goes faster than the limit, also after commands that came late or were
        missed.

        Args:
            now: s.
            period: From one call to the next, s.

        Returns:
            Shape (6,), rad.
        """
        assert self.accepted is not None
        assert self._before is not None
        # A controller that is faster than the commands gets several points of the line.
        share = (now - self._accepted_at + period) / self._command_period
        position = self._before + min(share, 1.0) * (self.accepted - self._before)
        sent = position if self._sent is None else self._sent
        step = position - sent
        longest = self._config.limits.velocity_limit * period
        self._sent = sent + step * min(1.0, longest / max(np.abs(step).max(), longest))
        return self._sent
