"""The objects' physics: what a planner believes, and what the world is drawn to be.

One description serves every `MultibodyPlant` that holds the boxes, in the plane or in
three dimensions: `set_object_physics` writes it into a context.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.planar_geometry import rectangles_overlap
from rhp_drake.task import BOX_SIDE, HAND_RECTANGLES, state_rectangles

if TYPE_CHECKING:
    from pydrake.geometry import SceneGraph
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.systems.framework import Context

# What the planner believes; the means of section VII's footnote, whose density is
# per area, as seen from above.
NOMINAL_DENSITY: Final = 1.0  # kg/m^2
NOMINAL_FRICTION: Final = 0.3
NOMINAL_SUPPORT_FRICTION: Final = 0.3

# The shapes an object may have, seen from above a rectangle and a circle.
BOX: Final = "box"
CYLINDER: Final = "cylinder"

# Standard deviation over mean, of each quantity, by the paper's name of the level.
UNCERTAINTY_LEVELS: Final = {"none": 0.0, "low": 0.1, "medium": 0.2, "high": 0.3}

# Draws are truncated, symmetrically so that the means stay.  A side of 0.09 m still
# goes into the hand's opening of 0.10 m.
SIDE_RANGE: Final = (0.03, 0.09)  # m
_RELATIVE_RANGE: Final = (0.1, 1.9)  # Of friction and density: three times "high".


@dataclass(frozen=True)
class ObjectPhysics:
    """Physics of m objects.

    Attributes:
        side_lengths: Extents along x and y of each object's own frame, shape (m, 2),
            m; the diameter twice for a cylinder.
        friction: Coefficient between bodies (hand or box, and this box), shape (m,).
            Every box carries its own as both static and dynamic coefficient, the hand
            the nominal one; two bodies meet with Drake's combination of their two,
            2 a b / (a + b), which is a where a = b.
        support_friction: Coefficient between box and table, shape (m,).  It belongs to
            planar models.  With gravity, in 3-D, a box has one coefficient for every
            face: `friction`, which meets the table's (nominal) one by the same
            combination, and this field is not used.  Slow pushing hardly sees the
            difference: one and the same factor on all support friction changes no path.
        density: Mass per area seen from above, shape (m,), kg/m^2.
        shapes: "box" or "cylinder", m of them; all boxes if not given.
    """

    side_lengths: np.ndarray
    friction: np.ndarray
    support_friction: np.ndarray
    density: np.ndarray
    shapes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        m = len(self.side_lengths)
        if not self.shapes:
            object.__setattr__(self, "shapes", (BOX,) * m)
        if len(self.shapes) != m or not set(self.shapes) <= {BOX, CYLINDER}:
            raise InputError(
                f"shapes must be {m} of {BOX!r} and {CYLINDER!r}, not {self.shapes}."
            )
        shapes = {
            "side_lengths": (m, 2),
            "friction": (m,),
            "support_friction": (m,),
            "density": (m,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise InputError(f"{name} has shape {value.shape}, not {shape}.")
            if not (np.isfinite(value) & (value > 0)).all():
                raise InputError(f"{name} must be positive and finite: {value}.")
        for name, (x, y) in zip(self.shapes, self.side_lengths, strict=True):
            if name == CYLINDER and x != y:
                raise InputError(f"a cylinder's side lengths {x} and {y} must agree.")

    def key(self) -> bytes:
        """Equal for equal physics, for use in a dictionary."""
        arrays = (self.side_lengths, self.friction, self.support_friction, self.density)
        numbers = b"".join(array.tobytes() for array in arrays)
        return numbers + ",".join(self.shapes).encode()

    def inner_side_lengths(self) -> np.ndarray:
        """Sides of rectangles that the objects contain, shape (m, 2), m.

        Those of the boxes themselves, and of the squares inside cylinders.
        """
        is_round = np.array([shape == CYLINDER for shape in self.shapes])
        return np.where(is_round[:, None], math.sqrt(0.5), 1.0) * self.side_lengths

    @property
    def num_objects(self) -> int:
        """m, the target included."""
        return len(self.side_lengths)


def nominal_physics(num_objects: int) -> ObjectPhysics:
    """What the planner believes of `num_objects` boxes."""
    return ObjectPhysics(
        side_lengths=np.full((num_objects, 2), BOX_SIDE),
        friction=np.full(num_objects, NOMINAL_FRICTION),
        support_friction=np.full(num_objects, NOMINAL_SUPPORT_FRICTION),
        density=np.full(num_objects, NOMINAL_DENSITY),
    )


def draw_physics(
    level: str, state: np.ndarray, generator: np.random.Generator
) -> ObjectPhysics:
    """Draws the physics of a world under the paper's uncertainty (section VII).

    Every quantity of every box, both sides included, is a Gaussian around its nominal
    value, truncated to `SIDE_RANGE` or to within 0.1 and 1.9 times the mean; the sides
    are drawn again until nothing overlaps in `state`.

    Args:
        level: One of `UNCERTAINTY_LEVELS`.
        state: The start, shape (3 + 3 m,).
        generator: Where the draws come from.

    Raises:
        InputError: If the level is unknown, or if nominal boxes overlap in `state`.
    """
    if level not in UNCERTAINTY_LEVELS:
        known = ", ".join(UNCERTAINTY_LEVELS)
        raise InputError(f"uncertainty level '{level}' is not one of {known}.")
    deviation = UNCERTAINTY_LEVELS[level]
    m = len(state) // 3 - 1
    nominal = nominal_physics(m)
    if _overlap(state, nominal.side_lengths):
        raise InputError("bodies overlap in the state for which physics is drawn.")
    if deviation == 0:
        return nominal

    side_range = (SIDE_RANGE[0] / BOX_SIDE, SIDE_RANGE[1] / BOX_SIDE)
    friction, support, density = (
        _draw_factors(deviation, _RELATIVE_RANGE, (m,), generator) for _ in range(3)
    )
    while True:
        sides = BOX_SIDE * _draw_factors(deviation, side_range, (m, 2), generator)
        if not _overlap(state, sides):
            return ObjectPhysics(
                side_lengths=sides,
                friction=nominal.friction * friction,
                support_friction=nominal.support_friction * support,
                density=nominal.density * density,
            )


def set_object_physics(
    physics: ObjectPhysics,
    objects: Sequence[str],
    *,
    plant: "MultibodyPlant",
    plant_context: "Context",
    scene_graph: "SceneGraph",
    scene_graph_context: "Context",
) -> list[float]:
    """Writes the physics of objects into the contexts of a plant and its scene graph.

    Shapes (of every role) keep their height; masses are those of the model times area
    and density over the nominal ones; inertias are those of solid boxes.  The result is
    that of a plant built with these values.

    Args:
        physics: The physics of m objects.
        objects: Names of their m model instances, each of one body with one collision
            shape, a box or a cylinder, around its origin.
        plant: The finalized plant; `plant_context` is its context.
        plant_context: Changed.
        scene_graph: The plant's scene graph; `scene_graph_context` is its context.
        scene_graph_context: Changed.

    Returns:
        The objects' heights, m.

    Raises:
        InputError: If there are not as many objects as in `physics`, or one has another
            shape.
    """
    from pydrake.geometry import Box, Cylinder, ProximityProperties, Role, RoleAssign
    from pydrake.multibody.plant import CoulombFriction
    from pydrake.multibody.tree import SpatialInertia

    if len(objects) != physics.num_objects:
        raise InputError(
            f"physics of {physics.num_objects} objects for {len(objects)}: "
            f"{', '.join(objects)}."
        )
    # The context's own inspector knows the defaults of proximity properties, which
    # the model's does not.
    inspector = (
        scene_graph.get_query_output_port().Eval(scene_graph_context).inspector()
    )
    source = plant.get_source_id()
    nominal_area_density = BOX_SIDE**2 * NOMINAL_DENSITY
    heights = []
    for i, name in enumerate(objects):
        (index,) = plant.GetBodyIndices(plant.GetModelInstanceByName(name))
        body = plant.get_body(index)
        x, y = physics.side_lengths[i].tolist()
        frame = plant.GetBodyFrameIdOrThrow(index)
        round_one = physics.shapes[i] == CYLINDER
        (collision, *_) = inspector.GetGeometries(frame, Role.kProximity)
        shape = inspector.GetShape(collision)
        if not isinstance(shape, Box | Cylinder):
            raise InputError(f"the object '{name}' must be a box or a cylinder.")
        height = shape.length() if isinstance(shape, Cylinder) else shape.height()
        heights.append(height)
        new_shape = Cylinder(x / 2, height) if round_one else Box(x, y, height)
        for role in (Role.kProximity, Role.kIllustration, Role.kPerception):
            for geometry in inspector.GetGeometries(frame, role):
                scene_graph.ChangeShape(
                    scene_graph_context, source, geometry, new_shape
                )
        coefficient = float(physics.friction[i])
        for geometry in inspector.GetGeometries(frame, Role.kProximity):
            properties = ProximityProperties(inspector.GetProximityProperties(geometry))
            properties.UpdateProperty(
                "material",
                "coulomb_friction",
                CoulombFriction(coefficient, coefficient),
            )
            scene_graph.AssignRole(
                scene_graph_context, source, geometry, properties, RoleAssign.kReplace
            )
        area = math.pi * x**2 / 4 if round_one else x * y
        density = float(physics.density[i])
        mass = body.default_mass() * area * density / nominal_area_density
        body.SetSpatialInertiaInBodyFrame(
            plant_context,
            SpatialInertia.SolidCylinderWithMass(mass, x / 2, height, [0.0, 0.0, 1.0])
            if round_one
            else SpatialInertia.SolidBoxWithMass(mass, x, y, height),
        )
    return heights


def _draw_factors(
    deviation: float,
    limits: tuple[float, float],
    shape: tuple[int, ...],
    generator: np.random.Generator,
) -> np.ndarray:
    """Gaussian factors of mean 1, those outside the limits drawn again."""
    factors = generator.normal(1.0, deviation, shape)
    while (outside := (factors < limits[0]) | (factors > limits[1])).any():
        factors[outside] = generator.normal(1.0, deviation, int(outside.sum()))
    return factors


def _overlap(state: np.ndarray, side_lengths: np.ndarray) -> bool:
    """Whether boxes of these sides overlap one another or the hand in the state."""
    rectangles = state_rectangles(state)
    hand = len(HAND_RECTANGLES)
    rectangles[hand:, 3:] = side_lengths / 2
    overlaps = np.triu(rectangles_overlap(rectangles[:, None], rectangles[None]), 1)
    return bool(overlaps[:, hand:].any())
