import numpy as np
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.geometry import Role
from pydrake.multibody.parsing import AddDirectives, ModelDirective
from pydrake.multibody.plant import ContactModel
from pydrake.systems.analysis import Simulator
import pytest

from rhp_drake import task
from rhp_drake.errors import InputError
from rhp_drake.physics import (
    NOMINAL_FRICTION,
    NOMINAL_SUPPORT_FRICTION,
    draw_physics,
    nominal_physics,
)
from rhp_drake.random_streams import stream
from rhp_drake.resources import models_path
from rhp_drake.scenario import load_scenario
from rhp_drake.station.ports import COMMAND_PERIOD, declared_ports, station_ports
from rhp_drake.station.simulated_station import (
    MakeSimulatedStation,
    SetStationState,
)
from rhp_drake.station.station_models import StationConfig
from rhp_drake.station.ur5_kinematics import hand_pose, inverse_kinematics

# The target in front of the palm, an obstacle touching the target.
STATE = np.array([0.35, 0.0, 0.0, 0.47, 0.01, 0.1, 0.54, 0.02, 0.0, 0.5, 0.25, 0.5])


@pytest.fixture(scope="module")
def station():
    return MakeSimulatedStation(StationConfig())


def start(station, state=STATE, physics=None) -> Simulator:
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    SetStationState(station, context, state, physics or nominal_physics(3))
    return simulator


def planar_state(station, context) -> np.ndarray:
    """The state (3 + 3 m,) as the ports tell it."""
    poses = station.GetOutputPort("object_poses").Eval(context)
    q = station.GetOutputPort("ur5.position_measured").Eval(context)
    rows = [
        [*X.translation()[:2], X.rotation().ToRollPitchYaw().yaw_angle()] for X in poses
    ]
    return np.concatenate([hand_pose(q), np.ravel(rows)])


def sweep(station, simulator, distance, speed) -> None:
    """Pushes straight along +x of W and waits 0.2 s, commanded every period."""
    context = simulator.get_mutable_context()
    port = station.GetInputPort("ur5.position")
    pose = planar_state(station, context)[:3]
    forward = np.array([1, 0, 0])
    num_commands = round(distance / speed / COMMAND_PERIOD)
    start_time = context.get_time()
    for k in range(1, num_commands + 26):
        travel = distance * min(k / num_commands, 1)
        port.FixValue(context, inverse_kinematics(pose + travel * forward))
        simulator.AdvanceTo(start_time + k * COMMAND_PERIOD)


def test_ports_are_those_of_the_table(station):
    ports = station_ports(num_objects=3)
    declared = {(p.name, p.direction, p.size) for p in ports}
    assert declared_ports(station) == declared
    assert len(ports) == len(declared)


def test_table_covers_the_task_s_table(station):
    inspector = station.scene_graph().model_inspector()
    plant = station.plant()
    frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName("table").index())
    (top,) = inspector.GetGeometries(frame, Role.kProximity)
    centre = inspector.GetPoseInFrame(top).translation()
    half = inspector.GetShape(top).size() / 2
    np.testing.assert_allclose(
        (centre - half)[:2], task.TABLE_LOWER, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        (centre + half)[:2], task.TABLE_UPPER, rtol=0, atol=1e-12
    )
    assert centre[2] + half[2] == pytest.approx(0, abs=1e-12)


def test_nominal_friction(station):
    query_object = station.GetOutputPort("query_object").Eval(
        station.CreateDefaultContext()
    )
    inspector = query_object.inspector()
    plant = station.plant()

    def coefficient(body: str) -> float:
        frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(body).index())
        geometry = inspector.GetGeometries(frame, Role.kProximity)[0]
        properties = inspector.GetProximityProperties(geometry)
        return properties.GetProperty("material", "coulomb_friction").dynamic_friction()

    # A nominal box meets the hand and the table with these.
    assert coefficient("hand") == NOMINAL_FRICTION
    a, b = coefficient("table"), NOMINAL_FRICTION
    assert 2 * a * b / (a + b) == pytest.approx(NOMINAL_SUPPORT_FRICTION)


def test_state_and_physics_are_set(station):
    physics = draw_physics("high", STATE, stream(0))
    context = station.CreateDefaultContext()
    SetStationState(station, context, STATE, physics)
    np.testing.assert_allclose(planar_state(station, context), STATE, atol=1e-9)
    plant_context = station.plant().GetMyContextFromRoot(context)
    box = station.plant().GetBodyByName(
        "box", station.plant().GetModelInstanceByName("target")
    )
    area = np.prod(physics.side_lengths[0])
    expected = 0.15 * area / task.BOX_SIDE**2 * physics.density[0]
    assert box.get_mass(plant_context) == pytest.approx(expected)


def test_holds_still_before_the_first_command(station):
    simulator = start(station, physics=draw_physics("high", STATE, stream(1)))
    simulator.AdvanceTo(1.0)
    context = simulator.get_context()
    np.testing.assert_allclose(planar_state(station, context), STATE, atol=2e-5)
    commanded = station.GetOutputPort("ur5.position_commanded").Eval(context)
    np.testing.assert_array_equal(commanded, inverse_kinematics(STATE[:3]))


def test_default_context_holds_still(station):
    simulator = Simulator(station)
    before = planar_state(station, simulator.get_context())
    simulator.AdvanceTo(0.5)
    after = planar_state(station, simulator.get_context())
    np.testing.assert_allclose(after, before, atol=2e-5)


def test_pushing(station):
    simulator = start(station)
    sweep(station, simulator, distance=0.15, speed=0.1)
    context = simulator.get_context()
    state = planar_state(station, context)
    # The hand arrives, in spite of what it pushes.
    np.testing.assert_allclose(state[:3], [0.5, 0, 0], atol=5e-4)
    # Both boxes lie before the palm's face, at x = -0.04 m in H, the far one untouched.
    assert state[3] > 0.5 - 0.04 + 0.029
    assert state[6] > state[3] + 0.055
    np.testing.assert_allclose(state[9:], STATE[9:], atol=1e-4)
    # Nothing coasts, and nothing moves any more.
    assert state[3] < 0.5 - 0.04 + 0.045
    velocity = station.plant().GetVelocities(
        station.plant().GetMyContextFromRoot(context)
    )
    assert np.abs(velocity).max() < 1e-3


def test_runs_are_repeatable(station):
    ends = []
    simulator = start(station)
    for _ in range(2):
        context = simulator.get_mutable_context()
        context.SetTime(0)
        SetStationState(station, context, STATE, nominal_physics(3))
        simulator.Initialize()
        sweep(station, simulator, distance=0.05, speed=0.1)
        ends.append(planar_state(station, context))
    np.testing.assert_array_equal(*ends)


def test_a_box_off_the_table_falls(station):
    state = STATE.copy()
    state[9:] = [0.5, 0.41, 0.0]
    simulator = start(station, state)
    simulator.AdvanceTo(0.5)
    poses = station.GetOutputPort("object_poses").Eval(simulator.get_context())
    assert poses[2].translation()[2] < -0.1


def test_colours_tell_roles():
    # Whatever the order of the models, the first of the task is green.
    station = MakeSimulatedStation(
        StationConfig(objects=["obstacle_2", "target", "obstacle_1"])
    )
    inspector = station.scene_graph().model_inspector()
    plant = station.plant()
    for name, green in (("obstacle_2", 0.66), ("target", 0.16), ("obstacle_1", 0.16)):
        body = plant.GetBodyByName("box", plant.GetModelInstanceByName(name))
        (visual,) = plant.GetVisualGeometriesForBody(body)
        for properties in (
            inspector.GetIllustrationProperties(visual),
            inspector.GetPerceptionProperties(visual),
        ):
            assert properties.GetProperty("phong", "diffuse").g() == green


def test_config_is_yaml():
    text = """
    objects: [obstacle_1, target, obstacle_2]
    plant: {time_step: 0.002, contact_model: point}
    """
    config = yaml_load_typed(schema=StationConfig, data=text, defaults=StationConfig())
    assert config.plant.time_step == 0.002
    # What the text leaves out keeps this package's defaults, not Drake's.
    defaults = config.scene_graph.default_proximity_properties
    assert defaults.compliance_type == "compliant"
    dumped = yaml_dump_typed(config)
    again = yaml_load_typed(schema=StationConfig, data=dumped)
    assert yaml_dump_typed(again) == dumped
    station = MakeSimulatedStation(config)
    assert station.plant().get_contact_model() == ContactModel.kPoint


def write_station(folder, shape: str) -> str:
    """Beside one another: a scenario, its directives, and an object of that shape."""
    box = (models_path() / "box/box.sdf").read_text()
    text = box.replace("<box><size>0.06 0.06 0.06</size></box>", shape)
    (folder / "object.sdf").write_text(text)
    (folder / "mine.yaml").write_text(
        """
        mine:
          station:
            directives:
            - add_directives: {file: package://rhp_drake/station.dmd.yaml}
            - add_model: {name: target, file: object.sdf}
            objects: [target]
        """
    )
    return str(folder / "mine.yaml")


@pytest.mark.parametrize(
    "shape",
    [
        "<box><size>0.06 0.06 0.12</size></box>",
        "<cylinder><radius>0.03</radius><length>0.12</length></cylinder>",
    ],
    ids=["box", "cylinder"],
)
def test_an_object_of_ones_own_stands_on_the_table(shape, tmp_path):
    """Its file is named relative to the scenario's; its height is its own."""
    _, scenario = load_scenario(write_station(tmp_path, shape))
    station = MakeSimulatedStation(scenario.station)
    simulator = start(station, STATE[:6], nominal_physics(1))
    for time in (0.0, 0.5):
        simulator.AdvanceTo(time)
        (pose,) = station.GetOutputPort("object_poses").Eval(simulator.get_context())
        assert pose.translation()[2] == pytest.approx(0.06, abs=5e-4)


def test_an_object_of_an_unknown_shape(tmp_path):
    shape = "<sphere><radius>0.03</radius></sphere>"
    _, scenario = load_scenario(write_station(tmp_path, shape))
    station = MakeSimulatedStation(scenario.station)
    with pytest.raises(InputError, match="'target' must be a box or a cylinder"):
        start(station, STATE[:6], nominal_physics(1))


def test_bad_requests(station):
    with pytest.raises(InputError, match="no model named 'green_box'"):
        MakeSimulatedStation(StationConfig(objects=["green_box"]))
    only_arm = ModelDirective(
        add_directives=AddDirectives(file="package://rhp_drake/station.dmd.yaml")
    )
    with pytest.raises(InputError, match="no model named 'target'"):
        MakeSimulatedStation(StationConfig(directives=[only_arm]))
    with pytest.raises(InputError, match="'table' must be one free body"):
        MakeSimulatedStation(StationConfig(objects=["table"]))
    with pytest.raises(InputError, match="free body 'obstacle_2' of the directives"):
        MakeSimulatedStation(StationConfig(objects=["target", "obstacle_1"]))
    context = station.CreateDefaultContext()
    with pytest.raises(InputError, match="9 elements for a station of 3 objects"):
        SetStationState(station, context, STATE[:9], nominal_physics(2))
    with pytest.raises(InputError, match="physics of 2 objects for 3"):
        SetStationState(station, context, STATE, nominal_physics(2))
    far = STATE.copy()
    far[0] = 1.2
    with pytest.raises(InputError, match="reach"):
        SetStationState(station, context, far, nominal_physics(3))
