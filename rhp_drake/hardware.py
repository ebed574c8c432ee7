"""A real robot and its tracker: what a file says of them, and their drivers.

A file maps a name to a lab, as a scenario file maps names to scenarios.  What it leaves
out has the default that `station.hardware_station.HardwareConfig` gives it.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rhp_drake import typed_yaml
from rhp_drake.closed_loop import Hardware
from rhp_drake.drivers.lcm_driver import LcmDriver
from rhp_drake.drivers.natnet_driver import NatNetDriver
from rhp_drake.drivers.ur_driver import UrDriver
from rhp_drake.errors import InputError
from rhp_drake.scenario import read_named
from rhp_drake.station.hardware_station import HardwareConfig
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import Ur5Kinematics


def load_hardware(path: Path) -> HardwareConfig:
    """Reads what is known of a robot and its tracker.

    Args:
        path: The file, or the bare name of one that comes with the package.

    Raises:
        InputError: If anything is wrong with it; the message names file and key.
    """
    where, _, node = read_named(path, None, "lab")
    config = typed_yaml.merge(node, HardwareConfig(), where)
    try:
        Ur5Kinematics(config.kinematics)
        if config.lcm is not None:
            config.lcm.validate()
        # A file may be for both sides of LCM.
        if config.lcm is None or config.ur.host:
            config.ur.validate()
            config.natnet.validate()
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
        WorkError: If the tracker, or the driver on the other side of LCM, does not
            answer.
    """
    kinematics = Ur5Kinematics(config.kinematics)
    if config.lcm is not None:
        _check_number("lcm.objects", "objects", config.lcm.objects, num_objects)
        driver = LcmDriver(config.lcm, COMMAND_PERIOD)
        with ExitStack() as stack:
            stack.callback(driver.stop)
            driver.start()
            yield Hardware(driver.arm, driver.tracker, kinematics)
        return
    _check_number("natnet.bodies", "rigid bodies", config.natnet.bodies, num_objects)
    arm = UrDriver(config.ur, COMMAND_PERIOD)
    tracker = NatNetDriver(config.natnet)
    with ExitStack() as stack:
        # The arm first, and each even if the other's fails.
        stack.callback(tracker.stop)
        stack.callback(arm.stop)
        tracker.start()
        arm.start()
        yield Hardware(arm, tracker, kinematics)


def _check_number(key: str, kind: str, names: list[str], num_objects: int) -> None:
    """Raises an InputError unless there are as many names as objects."""
    if len(names) != num_objects:
        raise InputError(
            f"{key} names {len(names)} {kind}; the scenario has {num_objects} objects."
        )
