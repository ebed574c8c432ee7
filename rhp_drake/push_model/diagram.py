"""The planar diagram whose motion is the push model: hand and boxes, no table.

Bodies slide on planar joints at their height above the (absent) table.  What the
table does to a box, dry friction under a load spread evenly over its bottom, is
viscous damping of its joint here: a quasi-static box then moves only while pushed,
and the ratio of angular to linear damping is that of the box's ellipsoidal limit
surface (Goyal, Ruina and Papadopoulos 1991).

Drake's convex integrator (CENIC) takes steps of fixed length.  Contacts are springs: a
step of it treats them implicitly, so that they may be as stiff as the step demands.
"""

import math
from typing import Final

import numpy as np
from pydrake.geometry import ProximityProperties, RoleAssign, SceneGraphConfig
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PlanarJoint,
    RigidBody,
    SpatialInertia,
)
from pydrake.planning import RobotDiagram, RobotDiagramBuilder
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context

from rhp_drake.physics import (
    CYLINDER,
    NOMINAL_SUPPORT_FRICTION,
    ObjectPhysics,
    set_object_physics,
)
from rhp_drake.resources import make_package_map
from rhp_drake.task import BOX_SIDE

# s.  One step of the integrator, in which the hand travels 5 mm or 3 degrees
# (`transition.STEPS_PER_ACTION`).  Times add up without rounding, also those of steps
# 2, 4 or 20 times finer: so no push depends on how many were before it.
TIME_STEP: Final = 5 / 128
# kg: so heavy that no push changes its velocity; the hand then needs no actuators.
_HAND_MASS: Final = 1000.0
# N/m: the hand is rigid beside the boxes.
_HAND_STIFFNESS: Final = 1e12
# s: time constant of a released box, well under a time step.
_STOPPING_TIME: Final = 0.005
# Bodies that overlap at the beginning of a step come out of each other in it, all but
# the (1 + this)-th part.  Stiffer contact overlaps less; but friction, which CENIC
# takes from the overlap at the beginning, is then too large at a touch.  Between 3 and
# 5, errors are least.
_STIFFNESS_RATIO: Final = 4.0


def MakePushDiagram(num_objects: int) -> RobotDiagram:
    """Builds the planar diagram of the hand and `num_objects` boxes.

    The plant's positions are ordered as a task state: hand, then objects.
    """
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    # Friction comes with the models, and the boxes' stiffness with their physics.
    scene_graph_config = SceneGraphConfig()
    properties = scene_graph_config.default_proximity_properties
    properties.point_stiffness = _HAND_STIFFNESS
    properties.hunt_crossley_dissipation = 0.0
    builder.scene_graph().set_config(scene_graph_config)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))

    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    parser.AddModels(url="package://rhp_drake/hand/hand.sdf")
    plant.AddJoint(
        PlanarJoint("hand", plant.world_frame(), plant.GetFrameByName("hand"))
    )
    box_plane = plant.AddFrame(
        FixedOffsetFrame(
            "box_plane", plant.world_frame(), RigidTransform([0, 0, BOX_SIDE / 2])
        )
    )
    parser.SetAutoRenaming(True)
    for i in range(num_objects):
        (model,) = parser.AddModels(url="package://rhp_drake/box/box.sdf")
        plant.RenameModelInstance(model, _object_name(i))
        body = plant.GetBodyByName("box", model)
        plant.AddJoint(PlanarJoint(_object_name(i), box_plane, body.body_frame()))
    plant.Finalize()
    return builder.Build()


def _object_name(index: int) -> str:
    return f"object_{index}"


def MakePushSimulator(
    diagram: RobotDiagram, physics: ObjectPhysics, time_step: float = TIME_STEP
) -> Simulator:
    """A simulator of the push diagram with its own context, ready to step.

    Args:
        diagram: Of as many objects as `physics`.
        physics: Of the objects.
        time_step: Of the integrator, s; finer for a reference.
    """
    context = diagram.CreateDefaultContext()
    plant: MultibodyPlant = diagram.plant()
    scene_graph = diagram.scene_graph()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant.GetBodyByName("hand").SetSpatialInertiaInBodyFrame(
        plant_context, SpatialInertia.SolidBoxWithMass(_HAND_MASS, 1.0, 1.0, 1.0)
    )
    set_object_physics(
        physics,
        [_object_name(i) for i in range(physics.num_objects)],
        plant=plant,
        plant_context=plant_context,
        scene_graph=scene_graph,
        scene_graph_context=scene_graph.GetMyMutableContextFromRoot(context),
    )
    for i in range(physics.num_objects):
        joint = plant.GetJointByName(_object_name(i))
        mass = joint.child_body().get_mass(plant_context)
        roughness = float(physics.support_friction[i]) / NOMINAL_SUPPORT_FRICTION
        damping = roughness * mass / _STOPPING_TIME
        x, y = physics.side_lengths[i]
        # Of a disc, the mean distance of its points from its centre is 2/3 radius.
        length = x / 3 if physics.shapes[i] == CYLINDER else limit_surface_length(x, y)
        joint.SetDampingVector(plant_context, [damping, damping, damping * length**2])
        # Of a force over the velocity that it gives the box by the end of a step.  Two
        # boxes' springs are in series and so are their motions: the ratio holds, too.
        resistance = mass / time_step + damping
        stiffness = _STIFFNESS_RATIO * resistance / time_step
        _set_stiffness(diagram, context, joint.child_body(), stiffness)
    simulator = Simulator(diagram, context)
    config = SimulatorConfig(
        integration_scheme="cenic", max_step_size=time_step, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.Initialize()
    return simulator


def _set_stiffness(
    diagram: RobotDiagram, context: Context, body: RigidBody, stiffness: float
) -> None:
    """Sets a body's stiffness in point contact, N/m."""
    plant = diagram.plant()
    scene_graph = diagram.scene_graph()
    scene_graph_context = scene_graph.GetMyMutableContextFromRoot(context)
    inspector = (
        scene_graph.get_query_output_port().Eval(scene_graph_context).inspector()
    )
    for geometry in plant.GetCollisionGeometriesForBody(body):
        properties = ProximityProperties(inspector.GetProximityProperties(geometry))
        properties.UpdateProperty("material", "point_contact_stiffness", stiffness)
        scene_graph.AssignRole(
            scene_graph_context,
            plant.get_source_id(),
            geometry,
            properties,
            RoleAssign.kReplace,
        )


def limit_surface_length(x: float, y: float) -> float:
    """Largest frictional torque over largest frictional force of a support, m.

    Under a load spread evenly over a rectangle this is the mean distance of its points
    from its centre, 0.3826 sides for a square (Goyal, Ruina and Papadopoulos 1991).

    Args:
        x: One side, m.
        y: The other, m.
    """
    diagonal = math.hypot(x, y)
    return (
        diagonal / 6
        + x**2 / (12 * y) * math.asinh(y / x)
        + y**2 / (12 * x) * math.asinh(x / y)
    )
