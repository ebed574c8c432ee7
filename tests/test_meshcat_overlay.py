import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
import pytest

from rhp_drake import task
from rhp_drake.planning.policy import Decision
from rhp_drake.random_streams import stream
from rhp_drake.systems.meshcat_overlay import MeshcatOverlay
from rhp_drake.systems.receding_horizon_planner import NO_DECISION, DecisionRecord
from rhp_drake.visualization import _bands


class FakeMeshcat:
    """Remembers what was drawn, and what is visible when."""

    def __init__(self):
        self.paths = set()
        self.visible = {}

    def Delete(self, path):
        self.paths = {p for p in self.paths if not p.startswith(path)}
        self.visible.clear()

    def SetObject(self, path, shape, rgba):
        self.paths.add(path)

    def SetTransform(self, path, X_ParentPath):
        self.paths.add(path)

    def SetTriangleColorMesh(self, path, vertices, faces, colors):
        assert vertices.shape == colors.shape
        assert faces.max() < vertices.shape[1]
        self.paths.add(path)

    def SetProperty(self, path, name, value, time_in_recording):
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


def publish(overlay, instance, time, decision_record, initialize=False):
    context = overlay.CreateDefaultContext()
    context.SetTime(time)
    overlay.GetInputPort("state").FixValue(context, instance.initial_state)
    overlay.GetInputPort("goals").FixValue(context, instance.goals.ravel())
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


def test_real_meshcat(instance):
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    overlay = MeshcatOverlay(meshcat, 3)
    meshcat.StartRecording()
    publish(overlay, instance, 0.0, record(instance, 0, 2), initialize=True)
    publish(overlay, instance, 0.1, record(instance, 1, 2))
    meshcat.PublishRecording()
    assert meshcat.HasPath("/overlay/goal/2/reached")
    assert meshcat.HasPath("/overlay/roll_outs/1/0/hand")
    assert "<html>" in meshcat.StaticHtml()


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
