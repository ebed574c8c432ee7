"""Packages of RTDE, protocol version 2, as Universal Robots' RTDE guide defines them.

A package is its size, header included (2 bytes), its type (1 byte) and a payload.  All
numbers are big-endian.
"""

import asyncio
from collections.abc import Mapping
import enum
import struct
from typing import Final, TypeAlias

# A number, or the elements of a vector.
Value: TypeAlias = float | tuple[float, ...]

PROTOCOL_VERSION: Final = 2
_HEADER: Final = struct.Struct(">HB")

# RTDE's types, as the struct module writes them.
_FORMATS: Final = {
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
_NOT_FOUND: Final = "NOT_FOUND"
_IN_USE: Final = "IN_USE"

_NUM_REGISTERS: Final = 48  # Of each kind and direction, from PolyScope 3.9 on.


def _registers(direction: str) -> dict[str, str]:
    return {
        f"{direction}_{kind}_register_{i}": data_type
        for kind, data_type in (("int", "INT32"), ("double", "DOUBLE"))
        for i in range(_NUM_REGISTERS)
    }


# Name and type of what a CB3 with PolyScope 3.15 sends, as far as ur_rtde asks for it.
OUTPUT_TYPES: Final = {
    **dict.fromkeys(
        (
            "timestamp",
            "actual_execution_time",
            "speed_scaling",
            "target_speed_fraction",
            "actual_momentum",
            "actual_main_voltage",
            "actual_robot_voltage",
            "actual_robot_current",
            "standard_analog_input0",
            "standard_analog_input1",
            "standard_analog_output0",
            "standard_analog_output1",
            "payload",
        ),
        "DOUBLE",
    ),
    **dict.fromkeys(
        (
            "target_q",
            "target_qd",
            "target_qdd",
            "target_current",
            "target_moment",
            "actual_q",
            "actual_qd",
            "actual_current",
            "joint_control_output",
            "actual_TCP_pose",
            "actual_TCP_speed",
            "actual_TCP_force",
            "target_TCP_pose",
            "target_TCP_speed",
            "joint_temperatures",
            "actual_joint_voltage",
            "payload_inertia",
        ),
        "VECTOR6D",
    ),
    "actual_tool_accelerometer": "VECTOR3D",
    "payload_cog": "VECTOR3D",
    "joint_mode": "VECTOR6INT32",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "output_bit_registers0_to_31": "UINT32",
    "output_bit_registers32_to_63": "UINT32",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    **_registers("output"),
}
# Likewise what it takes.
INPUT_TYPES: Final = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **_registers("input"),
}


class PackageType(enum.IntEnum):
    """The types of package that are understood, by their letters."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


class MalformedPackageError(ValueError):
    """What was received cannot be a package, or not one of this kind."""


async def read_package(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """Receives type and payload of the next package.

    Raises:
        MalformedPackageError: If its size is impossible.  Where the next package begins
            is unknown then.
        IncompleteReadError: If the client goes away.
    """
    size, package_type = _HEADER.unpack(await reader.readexactly(_HEADER.size))
    if size < _HEADER.size:
        raise MalformedPackageError(f"a package of {size} bytes")
    return package_type, await reader.readexactly(size - _HEADER.size)


def pack_package(package_type: int, payload: bytes) -> bytes:
    """A package, ready to be sent."""
    return _HEADER.pack(_HEADER.size + len(payload), package_type) + payload


def split_names(payload: bytes) -> tuple[str, ...]:
    """The variables that a client lists, separated by commas; a last one is ignored."""
    return tuple(payload.decode("ascii", "replace").removesuffix(",").split(","))


class Recipe:
    """Which variables a data package has, in what order.

    Attributes:
        names: Of the variables.
        types: Of the variables; "NOT_FOUND" or "IN_USE" if that is why there can be no
            such recipe.
        recipe_id: By which packages name it; 0 if there can be no such recipe.

    Args:
        names: Of the variables.
        types: All variables that there are, and their types.
        recipe_id: 1 to 255.
        in_use: Variables that somebody else has.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        types: Mapping[str, str],
        recipe_id: int,
        in_use: frozenset[str] = frozenset(),
    ) -> None:
        self.names = names
        self.types = tuple(
            _IN_USE if name in in_use else types.get(name, _NOT_FOUND) for name in names
        )
        known = all(data_type in _FORMATS for data_type in self.types)
        self.recipe_id = recipe_id if known else 0
        formats = [_FORMATS[x] for x in self.types] if known else []
        self._struct = struct.Struct(">B" + "".join(formats))
        self._sizes = [int(x[:-1] or 1) for x in formats]

    @property
    def reply(self) -> bytes:
        """The payload that answers a client's setup of this recipe."""
        return bytes([self.recipe_id]) + ",".join(self.types).encode()

    def pack(self, values: Mapping[str, Value]) -> bytes:
        """The payload of a data package; variables without a value are 0."""
        numbers: list[float] = []
        for name, size in zip(self.names, self._sizes, strict=True):
            value = values.get(name)
            if value is None:
                numbers.extend([0] * size)
            elif isinstance(value, tuple):
                numbers.extend(value)
            else:
                numbers.append(value)
        return self._struct.pack(self.recipe_id, *numbers)

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """The values that a data package's payload has, by name.

        Raises:
            MalformedPackageError: If its size is wrong.
        """
        if len(payload) != self._struct.size:
            raise MalformedPackageError(
                f"{len(payload)} bytes of data for {self._struct.size}"
            )
        numbers = self._struct.unpack(payload)[1:]
        values: dict[str, Value] = {}
        start = 0
        for name, size in zip(self.names, self._sizes, strict=True):
            part = numbers[start : start + size]
            values[name] = part if size > 1 else part[0]
            start += size
        return values
