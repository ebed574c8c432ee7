"""The planar diagram whose steps are the push model: hand and boxes, no table.

Bodies slide on planar joints at their height above the (absent) table.  What the
table does to a box, dry friction under a load spread evenly over its bottom, is
viscous damping of its joint here: a quasi-static box then moves only while pushed,
and the ratio of angular to linear damping is that of the box's ellipsoidal limit
surface (Goyal, Ruina and Papadopoulos 1991).
"""

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
# Largest frictional torque over largest frictional force under a uniformly loaded
# square of side 1: the mean distance of its points from its centre.
_LIMIT_SURFACE_LENGTH: Final = 0.3826


def MakePushDiagram(num_objects: int, time_step: float = TIME_STEP) -> RobotDiagram:
    """Builds the planar diagram of the hand and `num_objects` boxes.

    The plant's positions are ordered as a task state: hand, then objects.

    Args:
        num_objects: m.
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
    parser.SetAutoRenaming(True)
    parser.AddModels(url="package://rhp_drake/hand/hand.sdf")
    plant.AddJoint(
        PlanarJoint("hand", plant.world_frame(), plant.GetFrameByName("hand"))
    )
    box_plane = plant.AddFrame(
        FixedOffsetFrame(
            "box_plane", plant.world_frame(), RigidTransform([0, 0, BOX_SIDE / 2])
        )
    )
    for i in range(num_objects):
        (model,) = parser.AddModels(url="package://rhp_drake/box/box.sdf")
        body = plant.GetBodyByName("box", model)
        damping = body.default_mass() / _STOPPING_TIME
        angular_damping = damping * (_LIMIT_SURFACE_LENGTH * BOX_SIDE) ** 2
        plant.AddJoint(
            PlanarJoint(
                f"object_{i}",
                box_plane,
                body.body_frame(),
                [damping, damping, angular_damping],
            )
        )
    plant.Finalize()
    return builder.Build()


def MakePushContext(diagram: RobotDiagram) -> Context:
    """A root context of the push diagram, with the hand as heavy as it must be."""
    context = diagram.CreateDefaultContext()
    plant: MultibodyPlant = diagram.plant()
    plant.GetBodyByName("hand").SetSpatialInertiaInBodyFrame(
        plant.GetMyMutableContextFromRoot(context),
        SpatialInertia.SolidBoxWithMass(_HAND_MASS, 1.0, 1.0, 1.0),
    )
    return context
