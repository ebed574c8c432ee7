"""The station's ports: what simulation and hardware promise alike."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rhp_drake.safety import NUM_JOINTS

if TYPE_CHECKING:
    from pydrake.systems.framework import System

# Base to wrist: the order of every vector of joint positions.
JOINT_NAMES: Final = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
# A UR5 of the CB3 series takes one command every 8 ms.
COMMAND_PERIOD: Final = 0.008  # s


@dataclass(frozen=True)
class Port:
    """One port of the station.

    Attributes:
        name: As exported, `<model instance>.<port>` where a model instance has it.
        direction: "input" or "output".
        size: Number of elements; None if the port is abstract.
        units: Of the elements, or the type of an abstract port.
        simulation_only: Whether hardware cannot have it.
    """

    name: str
    direction: str
    size: int | None
    units: str
    simulation_only: bool = False


def station_ports(num_objects: int) -> tuple[Port, ...]:
    """The ports of a station of m = `num_objects` objects.

    A measurement comes with its age, which in simulation is 0; `ur5.fault` is a
    `safety.Fault` of the robot's own.
    """
    simulation = {"simulation_only": True}
    return (
        Port("ur5.position", "input", NUM_JOINTS, "rad"),
        Port("ur5.position_commanded", "output", NUM_JOINTS, "rad"),
        Port("ur5.position_measured", "output", NUM_JOINTS, "rad"),
        Port("ur5.velocity_estimated", "output", NUM_JOINTS, "rad/s"),
        Port("ur5.state_estimated", "output", 2 * NUM_JOINTS, "rad, rad/s"),
        Port("ur5.age", "output", 1, "s"),
        Port("ur5.fault", "output", 1, "safety.Fault"),
        Port("object_poses", "output", None, "list[RigidTransform], m in task order"),
        Port("object_ages", "output", num_objects, "s"),
        Port("body_poses", "output", None, "list[RigidTransform]", **simulation),
        Port("contact_results", "output", None, "ContactResults", **simulation),
        Port("query_object", "output", None, "QueryObject", **simulation),
    )


def declared_ports(station: "System") -> set[tuple[str, str, int | None]]:
    """Name, direction and size of each port that a station really has."""
    from pydrake.systems.framework import PortDataType

    inputs = [station.get_input_port(i) for i in range(station.num_input_ports())]
    outputs = [station.get_output_port(i) for i in range(station.num_output_ports())]
    return {
        (
            port.get_name(),
            direction,
            port.size() if port.get_data_type() == PortDataType.kVectorValued else None,
        )
        for direction, ports in (("input", inputs), ("output", outputs))
        for port in ports
    }
