"""The hardware station: the ports of the simulated one, with a robot behind them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
    State,
)
from pydrake.systems.primitives import Demultiplexer

from rhp_drake.drivers.lcm_config import LcmConfig
from rhp_drake.drivers.measurements import ArmMeasurement, ObjectPose
from rhp_drake.drivers.natnet_config import NatNetConfig
from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS
from rhp_drake.station.shown_station import MakeShownStation
from rhp_drake.station.station_models import StationConfig
from rhp_drake.station.ur5_kinematics import DhDeltas


@dataclass
class HardwareConfig:
    """The robot and the tracker.

    Attributes:
        description: One sentence for people.
        ur: The robot.
        kinematics: Its DH parameters, if they are not the nominal ones.
        natnet: The tracker.
        lcm: Where a driver of both is reached, if it runs on its own, as `rhp driver`
            does; `ur` and `natnet` are then its business.  `kinematics` is not: over
            LCM go joint positions, and whoever plans has to know the arm.
    """

    description: str = ""
    ur: UrDriverConfig = field(default_factory=UrDriverConfig)
    kinematics: DhDeltas = field(default_factory=DhDeltas)
    natnet: NatNetConfig = field(default_factory=NatNetConfig)
    lcm: LcmConfig | None = None


class Arm(Protocol):
    """A robot's driver, e.g. `UrDriver`; it never makes anybody wait."""

    def command(self, position: np.ndarray, engaged: bool) -> None:
        """Leaves a command, shape (6,), rad."""
        ...

    def read(self) -> ArmMeasurement:
        """The newest measurement."""
        ...


class Tracker(Protocol):
    """A tracker's driver, e.g. `NatNetDriver`; it never makes anybody wait."""

    def read(self) -> Sequence[ObjectPose]:
        """What is known of the objects, in task order."""
        ...


class ArmInterface(LeafSystem):
    """Passes commands to a robot's driver, and measurements on.

    Before a position arrives that is finite nothing is commanded.

    .. pydrake_system::

        name: ArmInterface
        input_ports:
        - position
        output_ports:
        - position_commanded
        - state_estimated
        - age
        - fault

    `position` and `position_commanded` have size 6 (rad), `state_estimated` 12 (rad,
    rad/s), `age` 1 (s), `fault` 1, a `safety.Fault`.

    Args:
        arm: The driver, which runs.
    """

    def __init__(self, arm: Arm) -> None:
        super().__init__()
        self._arm = arm
        self._position_port = self.DeclareVectorInputPort("position", NUM_JOINTS)
        nan = np.full(NUM_JOINTS, np.nan)
        commanded = self.DeclareDiscreteState(nan)
        state = self.DeclareDiscreteState(np.concatenate([nan, nan]))
        age = self.DeclareDiscreteState(np.array([np.inf]))
        fault = self.DeclareDiscreteState(1)
        self._commanded, self._state = int(commanded), int(state)
        self._age, self._fault = int(age), int(fault)
        self.DeclareStateOutputPort("position_commanded", commanded)
        self.DeclareStateOutputPort("state_estimated", state)
        self.DeclareStateOutputPort("age", age)
        self.DeclareStateOutputPort("fault", fault)
        self.DeclarePeriodicDiscreteUpdateEvent(COMMAND_PERIOD, 0.0, self._Update)

    def Measure(self, discrete_state: DiscreteValues) -> None:
        """Writes what the driver measures now into this system's state."""
        measured = self._arm.read()
        state = np.concatenate([measured.position, measured.velocity])
        discrete_state.set_value(self._state, state)
        discrete_state.set_value(self._age, np.array([measured.age]))
        discrete_state.set_value(self._fault, np.array([float(measured.fault)]))

    def _Update(self, context: Context, discrete_state: DiscreteValues) -> None:
        self.Measure(discrete_state)
        position = self._position_port.Eval(context)
        if np.isfinite(position).all():
            self._arm.command(position, engaged=True)
            discrete_state.set_value(self._commanded, position)


class TrackerInterface(LeafSystem):
    """Passes a tracker's poses on, with their ages.

    .. pydrake_system::

        name: TrackerInterface
        output_ports:
        - object_poses
        - object_ages

    `object_poses` is a list of the m poses X_WB, `object_ages` has size m (s).

    Args:
        tracker: The driver, which runs.
        num_objects: m.
    """

    def __init__(self, tracker: Tracker, num_objects: int) -> None:
        super().__init__()
        self._tracker = tracker
        nowhere = RigidTransform(np.full(3, np.nan))
        unseen = ObjectPose(nowhere, age=np.inf)
        seen = self.DeclareAbstractState(AbstractValue.Make([unseen] * num_objects))
        self._seen = int(seen)
        prerequisites = {self.abstract_state_ticket(seen)}
        self.DeclareAbstractOutputPort(
            "object_poses",
            AbstractValue.Make([RigidTransform()]).Clone,
            self._CalcPoses,
            prerequisites,
        )
        self.DeclareVectorOutputPort(
            "object_ages", num_objects, self._CalcAges, prerequisites
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(COMMAND_PERIOD, 0.0, self._Update)

    def Measure(self, state: State) -> None:
        """Writes what the driver sees now into this system's state."""
        seen = state.get_mutable_abstract_state(self._seen)
        seen.set_value(list(self._tracker.read()))

    def _Update(self, context: Context, state: State) -> None:
        self.Measure(state)

    def _get_seen(self, context: Context) -> list[ObjectPose]:
        return context.get_abstract_state(self._seen).get_value()

    def _CalcPoses(self, context: Context, output: AbstractValue) -> None:
        output.set_value([pose.X_WB for pose in self._get_seen(context)])

    def _CalcAges(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([pose.age for pose in self._get_seen(context)])


def MakeHardwareStation(
    config: StationConfig, arm: Arm, tracker: Tracker, meshcat: Meshcat | None = None
) -> Diagram:
    """Makes the hardware station, whose ports are `ports.station_ports`.

    It lacks those marked `simulation_only`.

    Args:
        config: The models that stand for what is there.
        arm: The robot's driver, which runs.
        tracker: The tracker's driver, which runs.
        meshcat: Where to show measured posture and poses, if anywhere.

    Raises:
        InputError: If the directives lack the arm, the hand or an object.
    """
    builder = DiagramBuilder()
    interface = builder.AddNamedSystem("arm", ArmInterface(arm))
    objects = builder.AddNamedSystem(
        "objects", TrackerInterface(tracker, len(config.objects))
    )
    state = interface.GetOutputPort("state_estimated")
    split = builder.AddSystem(Demultiplexer([NUM_JOINTS, NUM_JOINTS]))
    builder.Connect(state, split.get_input_port())
    builder.ExportInput(interface.GetInputPort("position"), "ur5.position")
    builder.ExportOutput(
        interface.GetOutputPort("position_commanded"), "ur5.position_commanded"
    )
    builder.ExportOutput(split.get_output_port(0), "ur5.position_measured")
    builder.ExportOutput(split.get_output_port(1), "ur5.velocity_estimated")
    builder.ExportOutput(state, "ur5.state_estimated")
    for name in ("age", "fault"):
        builder.ExportOutput(interface.GetOutputPort(name), f"ur5.{name}")
    for name in ("object_poses", "object_ages"):
        builder.ExportOutput(objects.GetOutputPort(name), name)
    if meshcat is not None:
        shown = builder.AddNamedSystem("shown", MakeShownStation(config, meshcat))
        builder.Connect(
            split.get_output_port(0), shown.GetInputPort("position_measured")
        )
        builder.Connect(
            objects.GetOutputPort("object_poses"), shown.GetInputPort("object_poses")
        )
    station = builder.Build()
    station.set_name("station")
    return station


def MeasureStation(station: Diagram, station_context: Context) -> None:
    """Puts what is measured now into the station's context.

    Whatever begins at what is measured, as the servo and the guard do, needs it before
    the simulator is initialized.

    Args:
        station: From `MakeHardwareStation`.
        station_context: The station's own context, also within a larger diagram's.
    """
    arm, objects = map(station.GetSubsystemByName, ("arm", "objects"))
    arm_context = station.GetMutableSubsystemContext(arm, station_context)
    arm.Measure(arm_context.get_mutable_discrete_state())
    objects_context = station.GetMutableSubsystemContext(objects, station_context)
    objects.Measure(objects_context.get_mutable_state())
