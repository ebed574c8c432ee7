"""The planar diagram whose steps are the push model: hand and boxes, no table.

Bodies slide on planar joints at their height above the (absent) table.  What the
table does to a box, dry friction under a load spread evenly over its bottom, is
viscous damping of its joint here: a quasi-static box then moves only while pushed,
and the ratio of angular to linear damping is that of the box's ellipsoidal limit
surface (Goyal, Ruina and Papadopoulos 1991).
"""

import math
from typing import Final

import numpy as np
from pydrake.geometry import SceneGraphConfig
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    ApplyMultibodyPlantConfig,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import FixedOffsetFrame, PlanarJoint, SpatialInertia
from pydrake.planning import RobotDiagram, RobotDiagramBuilder
from pydrake.systems.framework import Context

from rhp_drake.physics import (
    CYLINDER,
    NOMINAL_SUPPORT_FRICTION,
    ObjectPhysics,
    set_object_physics,
)
from rhp_drake.resources import make_package_map
from rhp_drake.task import BOX_SIDE

# s.  One step of the contact solver, in which the hand travels 5 mm or 3 degrees
# (`transition.STEPS_PER_ACTION`).
TIME_STEP: Final = 0.05
# kg: so heavy that no push changes its velocity; the hand then needs no actuators.
_HAND_MASS: Final = 1000.0
# s: time constant of a released box, well under a time step.
_STOPPING_TIME: Final = 0.01
# s: how fast an overlap is pushed out.  Drake's default of 0.1 s is as long as two time
# steps: the palm would sink 1 cm into a box at a push.
_RELAXATION_TIME: Final = 0.005
# m: where a body that takes no part is parked; they stand this far apart.
_PARKING_PLACE: Final = 10.0


def MakePushDiagram(num_objects: int, time_step: float = TIME_STEP) -> RobotDiagram:
    """Builds the planar diagram of the hand and `num_objects` boxes.

    The plant's positions are ordered as a task state: hand, then objects.

    Args:
        num_objects: The largest m; a context may park some (`MakePushContext`).
        time_step: Of the contact solver, s; finer for a reference.
    """
    builder = RobotDiagramBuilder(time_step=time_step)
    plant = builder.plant()
    ApplyMultibodyPlantConfig(
        MultibodyPlantConfig(
            time_step=time_step,
            contact_model="point",
            discrete_contact_approximation="sap",
            use_sampled_output_ports=False,
        ),
        plant,
    )
    # Friction comes with the models.
    scene_graph_config = SceneGraphConfig()
    properties = scene_graph_config.default_proximity_properties
    properties.relaxation_time = _RELAXATION_TIME
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


def MakePushContext(diagram: RobotDiagram, physics: ObjectPhysics) -> Context:
    """A root context of the push diagram for so many objects of such physics.

    Objects that the diagram has and `physics` has not are parked far away and locked,
    so that the solver does not see them.
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
    for i in range(diagram.plant().num_joints() - 1):
        joint = plant.GetJointByName(_object_name(i))
        if i >= physics.num_objects:
            joint.set_translation(plant_context, [_PARKING_PLACE * (1 + i), 0.0])
            joint.Lock(plant_context)
            continue
        mass = joint.child_body().get_mass(plant_context)
        roughness = float(physics.support_friction[i]) / NOMINAL_SUPPORT_FRICTION
        damping = roughness * mass / _STOPPING_TIME
        x, y = physics.side_lengths[i]
        # Of a disc, the mean distance of its points from its centre is 2/3 radius.
        length = x / 3 if physics.shapes[i] == CYLINDER else limit_surface_length(x, y)
        joint.SetDampingVector(plant_context, [damping, damping, damping * length**2])
    return context


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
