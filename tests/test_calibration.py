"""`rhp calibrate`: the pose that two frames' points tell."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
import pytest

from rhp_drake import cli
from rhp_drake.errors import InputError
from rhp_drake.random_streams import stream
from rhp_drake.station.calibration import fit_calibration, read_pairs

X_WO = RigidTransform(RollPitchYaw(0.1, -0.2, 2.5), [0.5, -0.1, 0.02])
POINTS_O = stream(0, "test_calibration").uniform(-0.3, 0.3, (8, 3))
HEADER = "x_O,y_O,z_O,x_W,y_W,z_W\n"


def test_exact_points_tell_the_pose():
    result = fit_calibration(POINTS_O, (X_WO @ POINTS_O.T).T)
    assert result.X_WO.IsNearlyEqualTo(X_WO, 1e-9)
    assert result.residuals.max() < 1e-9


def test_points_in_one_plane_are_enough():
    flat = POINTS_O * [1, 1, 0]
    assert fit_calibration(flat, (X_WO @ flat.T).T).X_WO.IsNearlyEqualTo(X_WO, 1e-9)


def test_residuals_tell_of_noise_and_of_a_bad_point():
    points_W = (X_WO @ POINTS_O.T).T
    noise = stream(0, "test_calibration", "noise").normal(0, 0.001, points_W.shape)
    result = fit_calibration(POINTS_O, points_W + noise)
    assert 0.0005 < np.sqrt(np.mean(result.residuals**2)) < 0.002
    points_W[3] += [0.02, 0, 0]
    assert fit_calibration(POINTS_O, points_W).residuals.argmax() == 3


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (POINTS_O[:3], "3 pairs of points are too few"),
        (np.outer(np.arange(5), [0.1, 0, 0]), "the points lie on a line"),
        (np.zeros((5, 3)), "the points lie on a line, or in one place"),
    ],
)
def test_points_that_tell_nothing(points, message):
    with pytest.raises(InputError, match=message):
        fit_calibration(points, points)


def test_the_command(monkeypatch, capsys, tmp_path):
    rows = np.hstack([POINTS_O, (X_WO @ POINTS_O.T).T])
    path = tmp_path / "pairs.csv"
    lines = [",".join(f"{x:.9f}" for x in row) for row in rows]
    path.write_text(HEADER + "\n".join(lines) + "\n")
    monkeypatch.setattr("sys.argv", ["rhp", "calibrate", str(path)])
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert not info.value.code
    printed = capsys.readouterr().out
    assert "xyz: [0.50000, -0.10000, 0.02000]" in printed
    assert "rpy_deg: [5.730, -11.459, 143.239]" in printed
    assert "Residuals of 8 points: 0.00 mm RMS" in printed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_O,y_O\n1,2\n", "lacks the column z_O"),
        (HEADER + "1,2,3,4,5\n", "line 2: expected six numbers"),
        (HEADER + "1,2,3,4,5,six\n", "line 2: expected six numbers"),
        (HEADER + "1,2,3,4,5,nan\n", "not all numbers are finite"),
        ("", "lacks the column x_O"),
    ],
)
def test_bad_files(text, message, tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_pairs(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_pairs(tmp_path / "nothing.csv")
