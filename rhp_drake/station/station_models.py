"""The models of a station: what both stations are described by.

In simulation the plant is the world; on hardware it is what is shown.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    DefaultProximityProperties,
    Rgba,
    Role,
    SceneGraph,
    SceneGraphConfig,
)
from pydrake.multibody.parsing import (
    AddDirectives,
    ModelDirective,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import BodyIndex

from rhp_drake.errors import InputError
from rhp_drake.resources import make_package_map
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS

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

    def validate(self) -> None:
        """Raises an InputError if a value is impossible."""
        if not self.objects or len(set(self.objects)) < len(self.objects):
            raise InputError(
                "station.objects: must be names of different objects, at least one, "
                f"not {self.objects}."
            )
        time_step = self.plant.time_step
        if not 0 < time_step <= COMMAND_PERIOD:
            raise InputError(
                "station.plant.time_step: must be above 0 and at most the period of "
                f"commands, {COMMAND_PERIOD} s, not {time_step}."
            )
        for name in ("position_gains", "velocity_gains"):
            gains = getattr(self, name)
            good = len(gains) == NUM_JOINTS and np.isfinite(gains).all()
            if not good or min(gains) < 0:
                raise InputError(
                    f"station.{name}: must be {NUM_JOINTS} finite numbers, none of "
                    f"them negative, not {gains}."
                )


def resolve_directives(config: StationConfig, folder: Path) -> None:
    """Makes URIs of the directives' plain paths, which are relative to a folder.

    Drake itself takes nothing but URIs here.
    """
    for directive in config.directives:
        for added in (directive.add_model, directive.add_directives):
            if added is not None and "://" not in added.file:
                added.file = (folder / added.file).as_uri()


@contextmanager
def as_input_errors() -> Iterator[None]:
    """Makes InputErrors of what Drake says about models and settings in a scenario."""
    try:
        yield
    except (RuntimeError, ValueError, SystemExit) as error:
        # A failed assertion in Drake comes as a SystemExit.
        raise InputError(f"station: {error}") from error


def AddStationModels(
    config: StationConfig, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Adds the station's models to a plant, which is not finalized here.

    Args:
        config: What the station is made of.
        plant: A source of `scene_graph`.
        scene_graph: Where its geometry goes.

    Raises:
        InputError: If the directives cannot be processed, or lack the arm, the hand or
            an object.
    """
    parser = Parser(plant, scene_graph)
    parser.package_map().AddMap(make_package_map())
    with as_input_errors():
        ProcessModelDirectives(ModelDirectives(directives=config.directives), parser)
    for name in ("ur5", "hand", *config.objects):
        if not plant.HasModelInstanceNamed(name):
            raise InputError(f"the station's directives add no model named '{name}'.")
    for i, name in enumerate(config.objects):
        _paint(plant, scene_graph, name, _OBSTACLE_COLOR if i else _TARGET_COLOR)


def object_bodies(plant: MultibodyPlant, objects: Sequence[str]) -> list[BodyIndex]:
    """The free bodies that the objects are, of a plant that is finalized.

    Raises:
        InputError: If an object is not one free body, or one is not among the objects:
            it would be pushed without the planner's knowing.
    """
    found = []
    for name in objects:
        bodies = plant.GetBodyIndices(plant.GetModelInstanceByName(name))
        if len(bodies) != 1 or not plant.get_body(bodies[0]).is_floating_base_body():
            raise InputError(f"the object '{name}' must be one free body.")
        found += bodies
    for body in sorted(plant.GetFloatingBaseBodies() - set(found)):
        model = plant.get_body(body).model_instance()
        raise InputError(
            f"station.objects: the free body '{plant.GetModelInstanceName(model)}' of "
            "the directives is not among them."
        )
    return found


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
