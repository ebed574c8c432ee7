"""Where OptiTrack streams, and what is where."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from rhp_drake.errors import InputError

if TYPE_CHECKING:
    from pydrake.math import RigidTransform


@dataclass
class PoseConfig:
    """A pose X_AB of a frame B in a frame A.

    Attributes:
        xyz: Position of B's origin in A, m.
        rpy_deg: Roll, pitch and yaw of B in A, degrees, as Drake's RollPitchYaw.
    """

    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def validate(self, where: str) -> None:
        """Raises an InputError that begins with `where` unless it is a pose."""
        numbers = [*self.xyz, *self.rpy_deg]
        if not (len(self.xyz) == len(self.rpy_deg) == 3 and np.isfinite(numbers).all()):
            raise InputError(
                f"{where}: a pose is three finite numbers xyz and three rpy_deg, not "
                f"{self.xyz} and {self.rpy_deg}."
            )

    def to_transform(self) -> "RigidTransform":
        """The pose, which must be valid."""
        from pydrake.math import RigidTransform, RollPitchYaw

        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz)


@dataclass
class NatNetConfig:
    """Where Motive streams, and what is where.

    Frames: W is the world, at the robot's base; O is OptiTrack's, as set in Motive; R
    is a rigid body as Motive defines it; B is its box, at the box's centre.

    Attributes:
        server_address: IP address of Motive's computer.
        local_address: IP address of this computer in the same network.
        use_multicast: Whether Motive streams multicast; else unicast.
        multicast_address: Motive's multicast group; not used in unicast.
        command_port: Where Motive takes requests, UDP.
        data_port: Where multicast frames come, UDP; not used in unicast.
        bodies: Names of the rigid bodies in Motive, in the task's order of objects.
        X_WO: Pose of O in W: the calibration of the cameras to the robot.
        X_RB: Pose of the box in its rigid body, by name; identity where not given.
    """

    server_address: str = "127.0.0.1"
    local_address: str = "127.0.0.1"
    use_multicast: bool = False
    # The address and the ports are Motive's defaults.
    multicast_address: str = "239.255.42.99"
    command_port: int = 1510
    data_port: int = 1511
    bodies: list[str] = field(default_factory=list)
    X_WO: PoseConfig = field(default_factory=PoseConfig)
    X_RB: dict[str, PoseConfig] = field(default_factory=dict)

    def validate(self) -> None:
        """Raises an InputError that names the first impossible value."""
        names = self.bodies
        if not names or len(set(names)) < len(names):
            raise InputError(
                f"natnet.bodies must name different rigid bodies, not {names}."
            )
        unknown = sorted(self.X_RB.keys() - set(names))
        if unknown:
            raise InputError(
                f"natnet.X_RB has a pose for {listed(unknown)}, but the rigid bodies "
                f"are {listed(names)}."
            )
        self.X_WO.validate("natnet.X_WO")
        for name, pose in self.X_RB.items():
            pose.validate(f"natnet.X_RB.{name}")


def listed(names: list[str]) -> str:
    """Names of rigid bodies, for people."""
    return ", ".join(map(repr, names))
