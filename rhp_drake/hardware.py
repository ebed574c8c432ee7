"""A real robot and its tracker: what a file says of them, and their drivers.

A file maps names to labs, as a scenario file maps names to scenarios.  What it leaves
out has the default that `station.hardware_station.HardwareConfig` gives it.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rhp_drake import typed_yaml
from rhp_drake.closed_loop import Hardware
from rhp_drake.drivers.natnet_driver import NatNetDriver
from rhp_drake.drivers.ur_driver import UrDriver
from rhp_drake.errors import InputError
from rhp_drake.scenario import read_named
from rhp_drake.station.hardware_station import HardwareConfig
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import Ur5Kinematics


def load_hardware(path: Path, name: str | None = None) -> HardwareConfig:
    """Reads what is known of a robot and its tracker.

    Args:
        path: The file, or the bare name of one that comes with the package.
        name: Which of the file's labs; may be None if it has one.

    Raises:
        InputError: If anything is wrong with it; the message names file and key.
    """
    where, _, node = read_named(path, name, "lab")
    config = typed_yaml.merge(node, HardwareConfig(), where)
    try:
        config.ur.validate()
        Ur5Kinematics(config.kinematics)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return config


@contextmanager
def running_hardware(config: HardwareConfig, num_objects: int) -> Iterator[Hardware]:
    """Starts the drivers, and stops them whatever happens: the arm then stands still.

    Args:
        config: What to connect to.
        num_objects: m; the tracker must know as many.

    Raises:
        InputError: If the robot cannot be used, or the tracker lacks an object.
        WorkError: If the tracker does not answer.
    """
    if len(config.natnet.bodies) != num_objects:
        raise InputError(
            f"natnet.bodies names {len(config.natnet.bodies)} rigid bodies; the "
            f"scenario has {num_objects} objects."
        )
    tracker = NatNetDriver(config.natnet)
    arm = UrDriver(config.ur, COMMAND_PERIOD)
    with ExitStack() as stack:
        # The arm first, and each even if the other's fails.
        stack.callback(tracker.stop)
        stack.callback(arm.stop)
        tracker.start()
        arm.start()
        yield Hardware(arm, tracker, Ur5Kinematics(config.kinematics))
