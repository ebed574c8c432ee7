"""The simulated station: UR5, hand, table and boxes, with gravity and contact."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import (
    DefaultProximityProperties,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    SceneGraph,
    SceneGraphConfig,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import (
    AddDirectives,
    ModelDirective,
    ModelDirectives,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import (
    ApplyMultibodyPlantConfig,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import BodyIndex, PdControllerGains
from pydrake.planning import RobotDiagram, RobotDiagramBuilder
from pydrake.systems.framework import Context
from pydrake.systems.primitives import Demultiplexer

from rhp_drake.errors import InputError
from rhp_drake.physics import ObjectPhysics, set_object_physics
from rhp_drake.resources import make_package_map
from rhp_drake.station.object_poses import ObjectPoses
from rhp_drake.station.ports import JOINT_NAMES, NUM_JOINTS
from rhp_drake.station.position_servo import PositionServo
from rhp_drake.station.ur5_kinematics import PUSHING_HEIGHT, inverse_kinematics
from rhp_drake.task import BOX_SIDE
from rhp_drake.visualization import FRAME_PERIOD

_TARGET_COLOR = Rgba(0.20, 0.66, 0.33)
_OBSTACLE_COLOR = Rgba(0.80, 0.16, 0.14)


def _default_directives() -> list[ModelDirective]:
    file = "package://rhp_drake/three_boxes.dmd.yaml"
    return [ModelDirective(add_directives=AddDirectives(file=file))]


def _default_plant() -> MultibodyPlantConfig:
    # Hydroelastic contact, because point contact lets boxes sink and tumble; "lagged",
    # because it comes nearest to quasi-static theory, and changes least with the time
    # step; triangles, because table friction resists turning only as well as the
    # pressure under a box is sampled.
    return MultibodyPlantConfig(
        time_step=0.004,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
        contact_surface_representation="triangle",
    )


def _default_scene_graph() -> SceneGraphConfig:
    return SceneGraphConfig(
        default_proximity_properties=DefaultProximityProperties(
            compliance_type="compliant"
        )
    )


@dataclass
class StationConfig:
    """What the simulated station is made of.

    Attributes:
        directives: Models and welds: the model instances "ur5", "hand", whatever stands
            around, and the objects, which are free bodies.
        objects: Names of the objects' model instances in task order, target first.
        plant: Time step and contact.
        scene_graph: Contact defaults.  Friction there has no effect, because Drake's
            parser fills in its own where a model has none.
        position_gains: Of the joints' servos, N m/rad, base to wrist.
        velocity_gains: Likewise, N m s/rad.
    """

    directives: list[ModelDirective] = field(default_factory=_default_directives)
    objects: list[str] = field(
        default_factory=lambda: ["target", "obstacle_1", "obstacle_2"]
    )
    plant: MultibodyPlantConfig = field(default_factory=_default_plant)
    scene_graph: SceneGraphConfig = field(default_factory=_default_scene_graph)
    position_gains: list[float] = field(
        default_factory=lambda: [2e4, 2e4, 1e4, 2e3, 2e3, 1e3]
    )
    velocity_gains: list[float] = field(
        default_factory=lambda: [600.0, 600.0, 300.0, 40.0, 40.0, 20.0]
    )


def MakeSimulatedStation(
    config: StationConfig, meshcat: Meshcat | None = None
) -> RobotDiagram:
    """Makes the simulated station, whose ports are `ports.STATION_PORTS`.

    The joints follow `ur5.position` by PD servos within their effort limits; gravity
    does not act on the arm and the hand, since a UR5's controller compensates it.
    Until something is connected to `ur5.position` the arm holds its place.

    Args:
        config: What it is made of.
        meshcat: Where to show it, if anywhere.

    Raises:
        InputError: If the directives lack the arm, the hand or an object.
    """
    robot_builder = RobotDiagramBuilder(time_step=config.plant.time_step)
    builder, plant = robot_builder.builder(), robot_builder.plant()
    scene_graph = robot_builder.scene_graph()
    ApplyMultibodyPlantConfig(config.plant, plant)
    scene_graph.set_config(config.scene_graph)
    parser = robot_builder.parser()
    parser.package_map().AddMap(make_package_map())
    ProcessModelDirectives(ModelDirectives(directives=config.directives), parser)

    for name in ("ur5", "hand", *config.objects):
        if not plant.HasModelInstanceNamed(name):
            raise InputError(f"the station's directives add no model named '{name}'.")
    arm = plant.GetModelInstanceByName("ur5")
    for name in ("ur5", "hand"):
        plant.set_gravity_enabled(plant.GetModelInstanceByName(name), False)
    gains = zip(config.position_gains, config.velocity_gains, strict=True)
    for joint, (p, d) in zip(JOINT_NAMES, gains, strict=True):
        actuator = plant.GetJointActuatorByName(joint, arm)
        actuator.set_controller_gains(PdControllerGains(p=p, d=d))
    for i, name in enumerate(config.objects):
        color = _OBSTACLE_COLOR if i else _TARGET_COLOR
        _paint(plant, scene_graph, name, color)
    plant.Finalize()

    servo = builder.AddNamedSystem(
        "servo", PositionServo(plant.GetDefaultPositions(arm))
    )
    builder.Connect(
        servo.GetOutputPort("desired_state"), plant.get_desired_state_input_port(arm)
    )
    builder.ExportInput(servo.GetInputPort("position"), "ur5.position")
    builder.ExportOutput(
        servo.GetOutputPort("position_commanded"), "ur5.position_commanded"
    )
    state = plant.get_state_output_port(arm)
    split = builder.AddSystem(Demultiplexer([NUM_JOINTS, NUM_JOINTS]))
    builder.Connect(state, split.get_input_port())
    builder.ExportOutput(split.get_output_port(0), "ur5.position_measured")
    builder.ExportOutput(split.get_output_port(1), "ur5.velocity_estimated")
    builder.ExportOutput(state, "ur5.state_estimated")

    bodies = [_only_body(plant, name) for name in config.objects]
    object_poses = builder.AddNamedSystem(
        "object_poses", ObjectPoses(config.objects, bodies)
    )
    builder.Connect(plant.get_body_poses_output_port(), object_poses.get_input_port())
    builder.ExportOutput(object_poses.get_output_port(), "object_poses")

    # What only simulation can know.
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
    builder.ExportOutput(plant.get_contact_results_output_port(), "contact_results")
    builder.ExportOutput(scene_graph.get_query_output_port(), "query_object")

    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(
            builder,
            scene_graph.get_query_output_port(),
            meshcat,
            MeshcatVisualizerParams(publish_period=FRAME_PERIOD),
        )
    station = robot_builder.Build()
    station.set_name("station")
    return station


def SetStationState(
    station: RobotDiagram,
    station_context: Context,
    state: np.ndarray,
    physics: ObjectPhysics,
) -> None:
    """Puts the whole station at rest in a planar state, under some physics.

    The hand is at its pushing height, the boxes stand on the table.

    Args:
        station: From `MakeSimulatedStation`.
        station_context: The station's own context, also within a larger diagram's.
        state: Shape (3 + 3 m,), as in `rhp_drake.task`.
        physics: Of the m objects.

    Raises:
        InputError: If the station has not m objects, or if the arm cannot reach the
            hand's pose.
    """
    objects = station.GetSubsystemByName("object_poses").objects
    if len(state) != 3 + 3 * len(objects):
        raise InputError(
            f"a state of {len(state)} elements for a station of {len(objects)} "
            f"objects, which needs {3 + 3 * len(objects)}."
        )
    plant, scene_graph = station.plant(), station.scene_graph()
    plant_context = station.GetMutableSubsystemContext(plant, station_context)
    set_object_physics(
        physics,
        objects,
        plant=plant,
        plant_context=plant_context,
        scene_graph=scene_graph,
        scene_graph_context=station.GetMutableSubsystemContext(
            scene_graph, station_context
        ),
    )
    q = inverse_kinematics(state[:3], PUSHING_HEIGHT)
    plant.SetVelocities(plant_context, np.zeros(plant.num_velocities()))
    plant.SetPositions(plant_context, plant.GetModelInstanceByName("ur5"), q)
    servo = station.GetSubsystemByName("servo")
    servo.Hold(station.GetMutableSubsystemContext(servo, station_context), q)
    for name, (x, y, theta) in zip(objects, state[3:].reshape(-1, 3), strict=True):
        plant.SetFloatingBaseBodyPoseInWorldFrame(
            plant_context,
            plant.get_body(_only_body(plant, name)),
            RigidTransform(RotationMatrix.MakeZRotation(theta), [x, y, BOX_SIDE / 2]),
        )


def _only_body(plant: MultibodyPlant, name: str) -> BodyIndex:
    """The free body that the object `name` is."""
    bodies = plant.GetBodyIndices(plant.GetModelInstanceByName(name))
    if len(bodies) != 1 or not plant.get_body(bodies[0]).is_floating_base_body():
        raise InputError(f"the object '{name}' must be one free body.")
    return bodies[0]


def _paint(
    plant: MultibodyPlant, scene_graph: SceneGraph, name: str, color: Rgba
) -> None:
    """Gives the objects' visual geometry the colour of its role in the task."""
    inspector = scene_graph.model_inspector()
    source = plant.get_source_id()
    for body in plant.GetBodyIndices(plant.GetModelInstanceByName(name)):
        for geometry in plant.GetVisualGeometriesForBody(plant.get_body(body)):
            for role in (Role.kIllustration, Role.kPerception):
                properties = inspector.GetProperties(geometry, role)
                if properties is None:
                    continue
                properties = type(properties)(properties)
                properties.UpdateProperty("phong", "diffuse", color)
                scene_graph.RemoveRole(source, geometry, role)
                scene_graph.AssignRole(source, geometry, properties)
