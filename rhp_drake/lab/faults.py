"""Faults of a virtual lab, by the words that call for them."""

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Final, TypeAlias

from rhp_drake.errors import InputError
from rhp_drake.lab.natnet_server import Freeze
from rhp_drake.lab.rtde_server import Stream
from rhp_drake.lab.virtual_lab import VirtualLab

_Inject: TypeAlias = Callable[..., object]


@dataclass(frozen=True)
class LabFault:
    """Something that goes wrong, or comes right again.

    Attributes:
        arguments: What is said behind its word: "object" or "number" each.
        help: What it does, for people.
        inject: Does it, given the lab and the arguments.
    """

    arguments: tuple[str, ...]
    help: str
    inject: _Inject


def _restart_robot(lab: VirtualLab) -> None:
    lab.controller.release_emergency_stop()
    lab.controller.release_safeguard_stop()
    lab.controller.restart_safety()
    lab.controller.power_on()
    lab.controller.release_brakes()


def _reboot(lab: VirtualLab) -> None:
    lab.controller.reboot()
    lab.rtde.drop_connections()
    lab.dashboard.drop_connections()


def _clear(lab: VirtualLab) -> None:
    lab.rtde.stream = Stream.LIVE
    lab.rtde.delay = lab.rtde.jitter = 0.0
    natnet = lab.natnet
    natnet.freeze = Freeze.NONE
    natnet.drop_share = natnet.malformed_share = natnet.delay = natnet.jitter = 0.0
    natnet.overwritten.clear()
    for name in lab.objects:
        natnet.reveal(name)


def _make_not_finite(lab: VirtualLab, name: str) -> None:
    lab.natnet.overwritten[name] = math.nan


def _set(server: str, attribute: str, value: object) -> _Inject:
    """Sets an attribute of one of the lab's servers."""
    return lambda lab: setattr(getattr(lab, server), attribute, value)


def _set_number(server: str, attribute: str) -> _Inject:
    """Sets an attribute of one of the lab's servers to the argument."""
    return lambda lab, number: setattr(getattr(lab, server), attribute, number)


FAULTS: Final = {
    "protective_stop": LabFault(
        (),
        "the robot stops as after a collision",
        lambda lab: lab.controller.protective_stop(),
    ),
    "safeguard_stop": LabFault(
        (),
        "somebody steps into the light curtain",
        lambda lab: lab.controller.safeguard_stop(),
    ),
    "emergency_stop": LabFault(
        (),
        "somebody presses the red button",
        lambda lab: lab.controller.emergency_stop(),
    ),
    "unlock": LabFault(
        (),
        "ends a protective stop, after 5 s",
        lambda lab: lab.controller.unlock_protective_stop(),
    ),
    "restart": LabFault(
        (), "releases all but a protective stop, and powers on", _restart_robot
    ),
    "reboot": LabFault((), "the robot's controller starts anew", _reboot),
    "drop_connection": LabFault(
        (), "the robot's connections break", lambda lab: lab.rtde.drop_connections()
    ),
    "robot_silent": LabFault(
        (), "the robot tells nothing more", _set("rtde", "stream", Stream.SILENT)
    ),
    "robot_repeats": LabFault(
        (), "the robot tells the same again", _set("rtde", "stream", Stream.REPEATING)
    ),
    "robot_corrupt": LabFault(
        (), "the robot's frames are noise", _set("rtde", "stream", Stream.CORRUPT)
    ),
    "robot_delay": LabFault(
        ("number",), "its frames are so late, s", _set_number("rtde", "delay")
    ),
    "robot_jitter": LabFault(
        ("number",), "up to so much later still, s", _set_number("rtde", "jitter")
    ),
    "tracker_silent": LabFault(
        (), "the tracker tells nothing more", _set("natnet", "freeze", Freeze.SILENT)
    ),
    "tracker_repeats": LabFault(
        (), "it tells the same frame again", _set("natnet", "freeze", Freeze.REPEAT)
    ),
    "tracker_delay": LabFault(
        ("number",), "its frames are so late, s", _set_number("natnet", "delay")
    ),
    "tracker_jitter": LabFault(
        ("number",), "up to so much later still, s", _set_number("natnet", "jitter")
    ),
    "tracker_drops": LabFault(
        ("number",), "this share of frames is lost", _set_number("natnet", "drop_share")
    ),
    "tracker_malformed": LabFault(
        ("number",), "this share is malformed", _set_number("natnet", "malformed_share")
    ),
    "occlude": LabFault(
        ("object",), "the cameras lose it", lambda lab, name: lab.natnet.occlude(name)
    ),
    "reveal": LabFault(
        ("object",), "they see it again", lambda lab, name: lab.natnet.reveal(name)
    ),
    "not_finite": LabFault(
        ("object",),
        "its pose is nan",
        _make_not_finite,
    ),
    "swap": LabFault(
        ("object", "object"),
        "the cameras take one for the other",
        lambda lab, first, second: lab.natnet.swap(first, second),
    ),
    "clear": LabFault((), "streams are well again, but for what is swapped", _clear),
}


def inject(lab: VirtualLab, text: str) -> None:
    """Does what a line of words says.

    Args:
        lab: Where.
        text: A key of `FAULTS` and its arguments, such as "occlude target".

    Raises:
        InputError: If it means nothing.
    """
    word, *arguments = text.split() or [""]
    fault = FAULTS.get(word)
    if fault is None:
        raise InputError(f"{word!r} is none of {', '.join(FAULTS)}.")
    if len(arguments) != len(fault.arguments):
        wanted = " ".join([word, *fault.arguments])
        raise InputError(f"{text!r}: expected {wanted!r}.")
    values = [
        _parse(kind, argument, lab.objects)
        for kind, argument in zip(fault.arguments, arguments, strict=True)
    ]
    fault.inject(lab, *values)


def _parse(kind: str, argument: str, objects: tuple[str, ...]) -> str | float:
    if kind == "object":
        if argument not in objects:
            raise InputError(f"{argument!r} is none of {', '.join(objects)}.")
        return argument
    try:
        value = float(argument)
    except ValueError:
        raise InputError(f"{argument!r} is no number.") from None
    if not 0 <= value <= 60:
        raise InputError(f"{argument} is not from 0 to 60.")
    return value
