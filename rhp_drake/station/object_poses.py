"""The objects' poses, as a perfect tracker would tell them."""

from collections.abc import Sequence

from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, LeafSystem


class ObjectPoses(LeafSystem):
    """Picks the objects' poses out of all bodies' poses, in task order.

    .. pydrake_system::

        name: ObjectPoses
        input_ports:
        - body_poses
        output_ports:
        - object_poses
    """

    def __init__(self, objects: Sequence[str], bodies: Sequence[BodyIndex]) -> None:
        """Makes the system for the bodies of the objects of these names."""
        super().__init__()
        self.objects = tuple(objects)
        self._bodies = [int(body) for body in bodies]
        poses = AbstractValue.Make([RigidTransform()])
        self._body_poses = self.DeclareAbstractInputPort("body_poses", poses)
        self.DeclareAbstractOutputPort(
            "object_poses", poses.Clone, self._CalcObjectPoses
        )

    def _CalcObjectPoses(self, context: Context, output: AbstractValue) -> None:
        body_poses = self._body_poses.Eval(context)
        output.set_value([body_poses[body] for body in self._bodies])
