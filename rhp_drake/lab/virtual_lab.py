"""The simulated station behind a robot's and a tracker's own protocols, on loopback.

Whoever connects to it cannot tell it from a UR5 and OptiTrack, but for what physics
leaves out: `rhp run --hardware` talks to it as it talks to a real lab.
"""

from contextlib import ExitStack
import time
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.lab.controller import Controller
from rhp_drake.lab.dashboard_server import DashboardServer
from rhp_drake.lab.natnet_server import NatNetServer
from rhp_drake.lab.rtde_server import RtdeServer
from rhp_drake.physics import ObjectPhysics
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.simulated_station import (
    MakeSimulatedStation,
    SetStationState,
)
from rhp_drake.station.station_models import StationConfig
from rhp_drake.task import TaskInstance

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat


class VirtualLab:
    """A robot and a tracker that one can connect to.

    The robot's program does not run at first: a client uploads its own.  The tracker's
    frame is W, and its rigid bodies are called as the station's objects.

    Args:
        station: What the lab is made of.
        instance: Where hand and objects are at first.
        physics: Of the objects.
        host: Loopback address of all servers; the ports of the robot's are fixed.
        natnet_port: UDP port of the tracker's; 0 for any free one.
        random: What faults draw from.
        meshcat: Where to show it, if anywhere.

    Attributes:
        objects: Names of the objects in task order.
        controller: The robot's.
        rtde: The robot's server of RTDE.
        dashboard: The robot's dashboard server.
        natnet: The tracker's server.

    Raises:
        InputError: If a server's address is no loopback address, or is taken.
    """

    def __init__(
        self,
        station: StationConfig,
        instance: TaskInstance,
        physics: ObjectPhysics,
        host: str,
        natnet_port: int,
        random: np.random.Generator,
        meshcat: "Meshcat | None" = None,
    ) -> None:
        self.objects = tuple(station.objects)
        self._station = MakeSimulatedStation(station, meshcat)
        self._simulator = Simulator(self._station)
        self._context = self._simulator.get_mutable_context()
        SetStationState(self._station, self._context, instance.initial_state, physics)
        self._position = self._station.GetInputPort("ur5.position")
        start = self._measured("ur5.position_measured")
        self._position.FixValue(self._context, start)
        self._simulator.Initialize()
        self.controller = Controller(start)
        of_robot, of_tracker = random.spawn(2)
        with ExitStack() as stack:
            self.rtde = RtdeServer(self.controller, host, of_robot)
            stack.callback(self.rtde.close)
            self.dashboard = DashboardServer(self.controller, host)
            stack.callback(self.dashboard.close)
            self.natnet = NatNetServer(of_tracker, host, natnet_port)
            stack.callback(self.natnet.stop)
            self._show_objects()
            self.natnet.start()
            self._servers = stack.pop_all()

    def close(self) -> None:
        """Ends all servers."""
        self._servers.close()

    def step(self) -> None:
        """One period of the robot's controller, as fast as it can be computed."""
        now = self._context.get_time()
        position = self.controller.tick(
            now,
            self._measured("ur5.position_measured"),
            self._measured("ur5.velocity_estimated"),
        )
        self._position.FixValue(self._context, position)
        # Between two calls Python handles Ctrl-C, so Drake need not look for it.
        self._simulator.AdvanceTo(now + COMMAND_PERIOD, interruptible=False)
        self._show_objects()
        self.rtde.publish()

    def run(self, seconds: float) -> None:
        """Goes on for so long, no faster than real time."""
        end = self._context.get_time() + seconds
        while self._context.get_time() < end - COMMAND_PERIOD / 2:
            begin = time.monotonic()
            self.step()
            time.sleep(max(0.0, begin + COMMAND_PERIOD - time.monotonic()))

    def _measured(self, port: str) -> np.ndarray:
        return self._station.GetOutputPort(port).Eval(self._context).copy()

    def _show_objects(self) -> None:
        poses = self._station.GetOutputPort("object_poses").Eval(self._context)
        self.natnet.set_bodies(list(zip(self.objects, poses, strict=True)))
