"""The simulated station: UR5, hand, table and boxes, with gravity and contact."""

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import ApplyMultibodyPlantConfig
from pydrake.multibody.tree import PdControllerGains
from pydrake.planning import RobotDiagram, RobotDiagramBuilder
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer

from rhp_drake.errors import InputError
from rhp_drake.physics import ObjectPhysics, set_object_physics
from rhp_drake.station.object_poses import ObjectPoses
from rhp_drake.station.ports import JOINT_NAMES, NUM_JOINTS
from rhp_drake.station.position_servo import PositionServo
from rhp_drake.station.station_models import (
    AddStationModels,
    StationConfig,
    as_input_errors,
    object_bodies,
)
from rhp_drake.station.ur5_kinematics import PUSHING_HEIGHT, inverse_kinematics
from rhp_drake.visualization import FRAME_PERIOD


def MakeSimulatedStation(
    config: StationConfig, meshcat: Meshcat | None = None
) -> RobotDiagram:
    """Makes the simulated station, whose ports are `ports.station_ports`.

    The joints follow `ur5.position` by PD servos within their effort limits; gravity
    does not act on the arm and the hand, since a UR5's controller compensates it.
    Until something is connected to `ur5.position` the arm holds its place.

    Args:
        config: What it is made of.
        meshcat: Where to show it, if anywhere.

    Raises:
        InputError: If Drake refuses directives or settings, the arm, the hand or an
            object is lacking, or a free body is no object.
    """
    robot_builder = RobotDiagramBuilder(time_step=config.plant.time_step)
    builder, plant = robot_builder.builder(), robot_builder.plant()
    scene_graph = robot_builder.scene_graph()
    with as_input_errors():
        ApplyMultibodyPlantConfig(config.plant, plant)
        scene_graph.set_config(config.scene_graph)
    AddStationModels(config, plant, scene_graph)
    arm = plant.GetModelInstanceByName("ur5")
    for name in ("ur5", "hand"):
        plant.set_gravity_enabled(plant.GetModelInstanceByName(name), False)
    gains = zip(config.position_gains, config.velocity_gains, strict=True)
    for joint, (p, d) in zip(JOINT_NAMES, gains, strict=True):
        actuator = plant.GetJointActuatorByName(joint, arm)
        actuator.set_controller_gains(PdControllerGains(p=p, d=d))
    with as_input_errors():
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

    bodies = object_bodies(plant, config.objects)
    object_poses = builder.AddNamedSystem(
        "object_poses", ObjectPoses(config.objects, bodies)
    )
    builder.Connect(plant.get_body_poses_output_port(), object_poses.get_input_port())
    builder.ExportOutput(object_poses.get_output_port(), "object_poses")

    # Simulation measures at once, and its robot has no faults of its own.
    for name, size in (("ur5.age", 1), ("ur5.fault", 1), ("object_ages", len(bodies))):
        source = builder.AddNamedSystem(name, ConstantVectorSource(np.zeros(size)))
        builder.ExportOutput(source.get_output_port(), name)

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

    The hand is at its pushing height, the objects stand on the table.

    Args:
        station: From `MakeSimulatedStation`.
        station_context: The station's own context, also within a larger diagram's.
        state: Shape (3 + 3 m,), as in `rhp_drake.task`.
        physics: Of the m objects.

    Raises:
        InputError: If the station has not m objects, one of them is neither box nor
            cylinder, or the arm cannot reach the hand's pose.
    """
    objects = station.GetSubsystemByName("object_poses").objects
    if len(state) != 3 + 3 * len(objects):
        raise InputError(
            f"a state of {len(state)} elements for a station of {len(objects)} "
            f"objects, which needs {3 + 3 * len(objects)}."
        )
    plant, scene_graph = station.plant(), station.scene_graph()
    plant_context = station.GetMutableSubsystemContext(plant, station_context)
    heights = set_object_physics(
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
    poses = state[3:].reshape(-1, 3)
    for name, height, (x, y, theta) in zip(objects, heights, poses, strict=True):
        (body,) = plant.GetBodyIndices(plant.GetModelInstanceByName(name))
        plant.SetFloatingBaseBodyPoseInWorldFrame(
            plant_context,
            plant.get_body(body),
            RigidTransform(RotationMatrix.MakeZRotation(theta), [x, y, height / 2]),
        )
