import dataclasses
import math

import numpy as np
from pydrake.geometry import Role
from pydrake.multibody.parsing import Parser
from pydrake.planning import RobotDiagramBuilder
from pydrake.systems.analysis import Simulator
import pytest

from rhp_drake import task
from rhp_drake.errors import InputError
from rhp_drake.physics import (
    NOMINAL_FRICTION,
    SIDE_RANGE,
    UNCERTAINTY_LEVELS,
    ObjectPhysics,
    draw_physics,
    nominal_physics,
    set_object_physics,
)
from rhp_drake.random_streams import stream
from rhp_drake.resources import models_path

STATE = np.array([0.3, 0, 0, 0.5, 0.1, 0.2, 0.5, -0.1, 0, 0.65, 0.0, 1.0])
PHYSICS = ObjectPhysics(
    side_lengths=np.array([[0.05, 0.08], [0.07, 0.04]]),
    friction=np.array([0.2, 0.45]),
    support_friction=np.array([0.3, 0.3]),
    density=np.array([1.5, 0.6]),
)


def as_vector(physics: ObjectPhysics) -> np.ndarray:
    *arrays, _ = dataclasses.astuple(physics)
    return np.concatenate([np.ravel(x) for x in arrays])


def test_no_uncertainty_is_nominal():
    drawn = draw_physics("none", STATE, stream(0))
    np.testing.assert_array_equal(as_vector(drawn), as_vector(nominal_physics(3)))


def test_draws_are_repeatable_and_distinct():
    a, b = (draw_physics("high", STATE, stream(5)) for _ in range(2))
    np.testing.assert_array_equal(as_vector(a), as_vector(b))
    assert len(set(as_vector(a))) == 15


@pytest.mark.parametrize("level", ["low", "medium", "high"])
def test_draws_have_the_paper_s_spread(level):
    generator = stream(0, level)
    draws = [draw_physics(level, STATE, generator) for _ in range(1500)]
    relative = np.array([as_vector(d) for d in draws]) / as_vector(nominal_physics(3))
    np.testing.assert_allclose(relative.mean(0), 1, atol=0.03)
    deviation = UNCERTAINTY_LEVELS[level]
    # Truncation, which the sides feel most, takes a little off the highest level.
    assert (relative[:, 6:].std(0) > 0.93 * deviation).all()
    assert (relative[:, :6].std(0) > 0.75 * deviation).all()
    assert (relative.std(0) < 1.07 * deviation).all()
    sides = np.concatenate([d.side_lengths for d in draws])
    assert sides.min() >= SIDE_RANGE[0]
    assert sides.max() <= SIDE_RANGE[1]


def test_nothing_overlaps_at_the_start():
    # Two boxes 1 mm apart: most draws of "high" would overlap.
    state = np.array([0.3, 0, 0, 0.5, 0, 0, 0.561, 0, 0])
    generator = stream(1)
    for _ in range(50):
        sides = draw_physics("high", state, generator).side_lengths
        assert sides[:, 0].sum() / 2 <= 0.061


def test_bad_requests():
    with pytest.raises(InputError, match="'hihg' is not one of none, low"):
        draw_physics("hihg", STATE, stream(0))
    overlapping = np.array([0.3, 0, 0, 0.5, 0, 0, 0.52, 0, 0])
    with pytest.raises(InputError, match="overlap"):
        draw_physics("low", overlapping, stream(0))
    with pytest.raises(InputError, match="density must be positive"):
        dataclasses.replace(PHYSICS, density=np.array([1.0, math.nan]))
    with pytest.raises(InputError, match="friction has shape"):
        dataclasses.replace(PHYSICS, friction=np.ones(3))


def box_sdf(physics: ObjectPhysics, i: int) -> str:
    """The shipped box, or box i of some physics written out as a model of its own."""
    text = (models_path() / "box" / "box.sdf").read_text()
    if physics is None:
        return text
    x, y = physics.side_lengths[i].tolist()
    h = task.BOX_SIDE
    mass = float(0.15 * x * y / h**2 * physics.density[i])
    inertia = {"xx": y * y + h * h, "yy": x * x + h * h, "zz": x * x + y * y}
    text = text.replace(f"{h} {h} {h}", f"{x} {y} {h}")
    text = text.replace("<mass>0.15</mass>", f"<mass>{mass!r}</mass>")
    for axis, square in inertia.items():
        old = f"<i{axis}>0.00009</i{axis}>"
        assert old in text
        text = text.replace(old, f"<i{axis}>{mass * square / 12!r}</i{axis}>")
    nominal = f">{NOMINAL_FRICTION}</drake:mu_"
    assert text.count(nominal) == 2
    return text.replace(nominal, f">{physics.friction[i]}</drake:mu_")


def make_stack(physics: ObjectPhysics | None):
    """Two boxes on the ground, the second pushed off the first by an overlap."""
    robot_builder = RobotDiagramBuilder(time_step=0.002)
    plant = robot_builder.plant()
    config = robot_builder.scene_graph().get_config()
    config.default_proximity_properties.compliance_type = "compliant"
    robot_builder.scene_graph().set_config(config)
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    ground = """
      <sdf version="1.9"><model name="ground"><static>true</static><link name="ground">
      <collision name="top"><pose>0 0 -0.05 0 0 0</pose>
      <geometry><box><size>1 1 0.1</size></box></geometry></collision>
      </link></model></sdf>"""
    parser.AddModelsFromString(ground, "sdf")
    boxes = [parser.AddModelsFromString(box_sdf(physics, i), "sdf")[0] for i in (0, 1)]
    plant.Finalize()
    return robot_builder.Build(), [plant.GetModelInstanceName(box) for box in boxes]


def simulate(diagram, objects, physics=None) -> np.ndarray:
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant, scene_graph = diagram.plant(), diagram.scene_graph()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    if physics is not None:
        set_object_physics(
            physics,
            objects,
            plant=plant,
            plant_context=plant_context,
            scene_graph=scene_graph,
            scene_graph_context=scene_graph.GetMyMutableContextFromRoot(context),
        )
    q = [1, 0, 0, 0, 0, 0, 0.0301, 1, 0, 0, 0, 0.055, 0.005, 0.0301]
    v = [0, 0, 1, 0.8, 0, 0, 0, 0, 0, -0.3, 0.1, 0]
    plant.SetPositionsAndVelocities(plant_context, np.array(q + v, dtype=float))
    simulator.AdvanceTo(0.3)
    return plant.GetPositionsAndVelocities(plant_context)


def test_physics_in_a_context_is_that_of_a_rebuilt_plant():
    diagram, objects = make_stack(None)
    rebuilt = simulate(*make_stack(PHYSICS))
    np.testing.assert_allclose(simulate(diagram, objects, PHYSICS), rebuilt, atol=1e-9)
    assert np.abs(simulate(diagram, objects) - rebuilt).max() > 1e-3


def test_every_geometry_changes_shape():
    diagram, objects = make_stack(None)
    context = diagram.CreateDefaultContext()
    scene_graph = diagram.scene_graph()
    scene_graph_context = scene_graph.GetMyMutableContextFromRoot(context)
    plant = diagram.plant()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    arguments = {
        "plant": plant,
        "plant_context": plant_context,
        "scene_graph": scene_graph,
        "scene_graph_context": scene_graph_context,
    }
    set_object_physics(PHYSICS, objects, **arguments)
    query_object = scene_graph.get_query_output_port().Eval(scene_graph_context)
    inspector = query_object.inspector()
    for i, name in enumerate(objects):
        (body,) = plant.GetBodyIndices(plant.GetModelInstanceByName(name))
        frame = plant.GetBodyFrameIdOrThrow(body)
        for role in (Role.kProximity, Role.kIllustration, Role.kPerception):
            (geometry,) = inspector.GetGeometries(frame, role)
            size = inspector.GetShape(geometry).size()
            np.testing.assert_array_equal(size, [*PHYSICS.side_lengths[i], 0.06])
    with pytest.raises(InputError, match="physics of 3 objects for 2"):
        set_object_physics(nominal_physics(3), objects, **arguments)
