import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
import pytest

from rhp_drake import task
from rhp_drake.commands.tree_drawing import TreeDrawing
from rhp_drake.planning.policy import Decision
from rhp_drake.planning.search import Growth
from rhp_drake.random_streams import stream
from rhp_drake.safety import Fault
from rhp_drake.systems.meshcat_overlay import MeshcatOverlay
from rhp_drake.systems.receding_horizon_planner import NO_DECISION, DecisionRecord
from rhp_drake.visualization import _bands, draw_text


class FakeMeshcat:
    """Remembers what was drawn, and what is visible when."""

    def __init__(self):
        self.paths = set()
        self.visible = {}
        self.num_faces = {}
        self.sky = {}

    def Delete(self, path):
        self.paths = {p for p in self.paths if not p.startswith(path)}
        self.visible = {p: v for p, v in self.visible.items() if not p.startswith(path)}

    def SetObject(self, path, shape, rgba):
        self.paths.add(path)

    def SetTransform(self, path, X_ParentPath):
        self.paths.add(path)

    def SetTriangleColorMesh(self, path, vertices, faces, colors):
        assert vertices.shape == colors.shape
        assert faces.max() < vertices.shape[1]
        self.paths.add(path)
        self.num_faces[path] = faces.shape[1]

    def SetProperty(self, path, name, value, time_in_recording):
        if path == "/Background":
            self.sky[name] = value
            return
        assert name == "visible"
        self.visible.setdefault(path, {})[time_in_recording] = value

    def HasPath(self, path):
        return any(p == path or p.startswith(path + "/") for p in self.paths)


@pytest.fixture
def instance():
    return task.sample_instance(stream(0, "test_meshcat_overlay"))


def record(instance, index: int, num_roll_outs: int) -> DecisionRecord:
    roll_outs = np.tile(instance.initial_state, (num_roll_outs, 3, 1))
    roll_outs[:, :, 0] += [0.0, 0.05, 0.1]  # The hand moves, the target does not.
    decision = Decision(
        action=0,
        value=0.0,
        roll_outs=roll_outs,
        returns=np.arange(num_roll_outs, dtype=float),
    )
    return DecisionRecord(index, 0.0, instance.initial_state, decision, 1.0, 0.1)


def publish(
    overlay, instance, time, decision_record, initialize=False, fault=Fault.NONE
):
    context = overlay.CreateDefaultContext()
    context.SetTime(time)
    overlay.GetInputPort("state").FixValue(context, instance.initial_state)
    overlay.GetInputPort("goals").FixValue(context, instance.goals.ravel())
    overlay.GetInputPort("fault").FixValue(context, [float(fault)])
    value = overlay.GetInputPort("decision").Allocate()
    value.set_value(decision_record)
    overlay.GetInputPort("decision").FixValue(context, value)
    if initialize:
        overlay.ExecuteInitializationEvents(context)
    overlay.ForcedPublish(context)
    return context


def test_discs_and_roll_outs(instance):
    meshcat = FakeMeshcat()
    overlay = MeshcatOverlay(meshcat, 3)
    publish(overlay, instance, 0.0, NO_DECISION, initialize=True)
    discs = {f"/overlay/goal/{i}{part}" for i in range(3) for part in ("", "/reached")}
    assert meshcat.paths == discs
    # Only the obstacles start in their regions.
    assert [meshcat.visible[f"/overlay/goal/{i}/reached"][0.0] for i in range(3)] == [
        False,
        True,
        True,
    ]

    publish(overlay, instance, 0.5, record(instance, 0, 2))
    assert {p for p in meshcat.paths - discs if p.endswith(("hand", "target"))} == {
        "/overlay/roll_outs/0/0/hand",
        "/overlay/roll_outs/0/1/hand",
    }
    assert meshcat.visible["/overlay/roll_outs/0"] == {0.0: False, 0.5: True}

    # Again the same decision, then the next one, which has nothing to show.
    publish(overlay, instance, 0.6, record(instance, 0, 2))
    publish(overlay, instance, 1.0, record(instance, 1, 0))
    assert meshcat.visible["/overlay/roll_outs/0"] == {
        0.0: False,
        0.5: True,
        1.0: False,
    }

    publish(overlay, instance, 0.0, NO_DECISION, initialize=True)
    assert meshcat.paths == discs


def test_a_fault_is_shown_until_the_next_run(instance):
    meshcat = FakeMeshcat()
    overlay = MeshcatOverlay(meshcat, 3)
    publish(overlay, instance, 0.0, NO_DECISION, initialize=True)
    well = dict(meshcat.sky)
    for time in (0.5, 0.6):
        publish(overlay, instance, time, NO_DECISION, fault=Fault.STALE_POSE)
    assert {"/overlay/fault/frame", "/overlay/fault/sign"} <= meshcat.paths
    assert meshcat.visible["/overlay/fault"] == {0.0: False, 0.5: True}
    assert meshcat.sky != well
    publish(overlay, instance, 0.0, NO_DECISION, initialize=True)
    assert not meshcat.HasPath("/overlay/fault")
    assert meshcat.sky == well


def grow(state, tree, *, hand=0.0, target=0.0, count=1) -> Growth:
    """A node with `count` children that have moved along x, m."""
    children = np.repeat(state[None], count, axis=0)
    children[:, [0, 3]] += [hand, target]
    return Growth(0, tree, 0, state, children, None)


def test_tree_is_drawn_as_it_grows(instance):
    meshcat, state = FakeMeshcat(), instance.initial_state
    drawing = TreeDrawing(meshcat)
    drawing.begin_search()
    drawing.add(grow(state, 1, hand=0.05))  # The first is drawn at once...
    assert meshcat.paths == {"/overlay/tree/1/1/hand"}
    drawing.add(grow(state, 1, hand=0.05, target=0.04, count=2))
    drawing.add(grow(state, 1, count=0))
    drawing.add(grow(state, 1, target=0.04))
    assert meshcat.paths == {"/overlay/tree/1/1/hand"}  # ...the next ones later.
    drawing.draw()
    drawing.draw()
    second = {"/overlay/tree/1/2/hand": 4, "/overlay/tree/1/2/target": 6}
    assert meshcat.num_faces == {"/overlay/tree/1/1/hand": 2, **second}

    # Another tree takes the place of the first, another search that of this one.
    drawing.add(grow(state, 2, hand=0.05))
    drawing.draw()
    assert meshcat.paths == {"/overlay/tree/1/3/hand"}
    drawing.show_from(0.2)
    drawing.begin_search()
    drawing.add(grow(state, 1, hand=0.05))
    drawing.draw()
    drawing.show_from(0.9)
    assert meshcat.paths == {"/overlay/tree/1/3/hand", "/overlay/tree/2/4/hand"}
    assert meshcat.visible == {
        "/overlay/tree/1": {0.0: False, 0.2: True, 0.9: False},
        "/overlay/tree/2": {0.0: False, 0.9: True},
    }


def test_real_meshcat(instance):
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    overlay = MeshcatOverlay(meshcat, 3)
    meshcat.StartRecording()
    publish(overlay, instance, 0.0, record(instance, 0, 2), initialize=True)
    publish(overlay, instance, 0.1, record(instance, 1, 2))
    publish(overlay, instance, 0.2, record(instance, 1, 2), fault=Fault.HAND_OUTSIDE)
    drawing = TreeDrawing(meshcat)
    drawing.begin_search()
    drawing.add(grow(instance.initial_state, 1, hand=0.05, target=0.05))
    drawing.draw()
    drawing.show_from(0.1)
    meshcat.PublishRecording()
    assert meshcat.HasPath("/overlay/tree/1/1/target")
    assert meshcat.HasPath("/overlay/goal/2/reached")
    assert meshcat.HasPath("/overlay/roll_outs/1/0/hand")
    assert meshcat.HasPath("/overlay/fault")
    assert "<html>" in meshcat.StaticHtml()


def test_text_is_as_wide_as_it_is_long():
    class Canvas:
        def SetTriangleColorMesh(self, path, vertices, faces, colors):
            assert vertices.shape == colors.shape
            assert faces.max() == vertices.shape[1] - 1
            self.vertices = vertices

    canvas = Canvas()
    extents = []
    for text in ("H", "HHHH", "HHHH\nHH"):
        draw_text(canvas, "/sign", text, 0.1, np.array([1.0, 0.0, 0.0]))
        low, high = canvas.vertices.min(axis=1), canvas.vertices.max(axis=1)
        assert low[0] == high[0] == 0
        assert low[1] == pytest.approx(-high[1], abs=0.02)
        assert low[2] >= 0
        extents.append(high - low)
    one, four, lines = extents
    assert 3 * one[1] < four[1] < 6 * one[1]
    assert 0.05 < one[2] < 0.1
    assert one[2] + 0.08 < lines[2] < one[2] + 0.15


def test_bands():
    points = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.2]])
    vertices, faces = _bands(points[:-1], points[1:], width=0.02, height=0.003)
    assert vertices.shape == (3, 8)
    assert faces.shape == (3, 4)
    np.testing.assert_allclose(vertices[2], 0.003)
    np.testing.assert_allclose(vertices[:2].min(axis=1), [-0.01, -0.01], atol=1e-12)
    np.testing.assert_allclose(vertices[:2].max(axis=1), [0.11, 0.21], atol=1e-12)
    corners = vertices[:, faces].transpose(2, 1, 0)  # (face, corner, xyz)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2
    assert areas.sum() == pytest.approx((0.1 + 0.02 + 0.2 + 0.02) * 0.02)
    assert _bands(points[1:2], points[2:3], 0.02, 0.003)[1].size == 0
