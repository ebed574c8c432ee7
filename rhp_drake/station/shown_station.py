"""What Meshcat shows of a station that is not simulated: what is measured of it."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from rhp_drake.station.ports import NUM_JOINTS
from rhp_drake.station.station_models import (
    AddStationModels,
    StationConfig,
    as_input_errors,
    object_bodies,
)
from rhp_drake.visualization import FRAME_PERIOD


class MeasuredPositions(LeafSystem):
    """The positions of a plant whose arm and objects are where they are measured.

    .. pydrake_system::

        name: MeasuredPositions
        input_ports:
        - position_measured
        - object_poses
        output_ports:
        - positions

    `position_measured` has size 6 (rad); `object_poses` is a list of the m poses X_WB.
    What is not finite, since nothing is known yet, is shown at its default.

    Args:
        plant: Finalized.
        objects: Names of the objects' model instances in task order.
    """

    def __init__(self, plant: MultibodyPlant, objects: Sequence[str]) -> None:
        super().__init__()
        self._default = plant.GetDefaultPositions()
        arm = plant.GetModelInstanceByName("ur5")
        # Which elements are the arm's: they say so of their own numbers.
        numbers = np.arange(float(plant.num_positions()))
        self._arm_rows = plant.GetPositionsFromArray(arm, numbers).astype(int)
        self._object_starts = [
            int(plant.get_body(body).floating_positions_start())
            for body in object_bodies(plant, objects)
        ]
        self._arm_port = self.DeclareVectorInputPort("position_measured", NUM_JOINTS)
        self._poses_port = self.DeclareAbstractInputPort(
            "object_poses", AbstractValue.Make([RigidTransform()])
        )
        self.DeclareVectorOutputPort(
            "positions", len(self._default), self._CalcPositions
        )

    def _CalcPositions(self, context: Context, output: BasicVector) -> None:
        positions = self._default.copy()
        measured = self._arm_port.Eval(context)
        if np.isfinite(measured).all():
            positions[self._arm_rows] = measured
        poses = self._poses_port.Eval(context)
        for start, X_WB in zip(self._object_starts, poses, strict=True):
            if np.isfinite(X_WB.translation()).all():
                positions[start : start + 4] = X_WB.rotation().ToQuaternion().wxyz()
                positions[start + 4 : start + 7] = X_WB.translation()
        output.SetFromVector(positions)


def MakeShownStation(config: StationConfig, meshcat: Meshcat) -> Diagram:
    """Shows the station's models in Meshcat where they are measured.

    The diagram has the input ports `position_measured` and `object_poses`, see
    `MeasuredPositions`.

    Args:
        config: The models.
        meshcat: Where to show them.

    Raises:
        InputError: If the directives lack the arm, the hand or an object.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    # No part of the diagram: nothing is simulated.
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    AddStationModels(config, plant, scene_graph)
    with as_input_errors():
        plant.Finalize()
    positions = builder.AddNamedSystem(
        "positions", MeasuredPositions(plant, config.objects)
    )
    poses = builder.AddNamedSystem("poses", MultibodyPositionToGeometryPose(plant))
    builder.Connect(positions.get_output_port(), poses.get_input_port())
    source = plant.get_source_id()
    builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
    MeshcatVisualizer.AddToBuilder(
        builder,
        scene_graph.get_query_output_port(),
        meshcat,
        MeshcatVisualizerParams(publish_period=FRAME_PERIOD),
    )
    for name in ("position_measured", "object_poses"):
        builder.ExportInput(positions.GetInputPort(name), name)
    return builder.Build()
