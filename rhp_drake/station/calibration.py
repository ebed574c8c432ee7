"""The pose of the cameras' frame in the robot's, from points that both know."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from rhp_drake.errors import InputError

_COLUMNS: Final = ("x_O", "y_O", "z_O", "x_W", "y_W", "z_W")
_FEWEST: Final = 4
# m: points nearer to one line than this do not tell how frames are turned about it.
_LEAST_SPREAD: Final = 0.02


@dataclass(frozen=True)
class Calibration:
    """What came of a fit.

    Attributes:
        X_WO: Pose of OptiTrack's frame O in the robot's frame W.
        residuals: How far each point is from where the fit has it, shape (N,), m.
    """

    X_WO: RigidTransform
    residuals: np.ndarray


def read_pairs(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads points in both frames, a CSV file with the columns x_O ... z_W, m.

    Returns:
        The points in O and in W, each of shape (N, 3), m.

    Raises:
        InputError: If it cannot be read, or a number in it.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            lacking = [c for c in _COLUMNS if c not in (reader.fieldnames or ())]
            if lacking:
                raise InputError(f"{path}: lacks the column {lacking[0]}.")
            rows = []
            for row in reader:
                try:
                    rows.append([float(row[column]) for column in _COLUMNS])
                except (TypeError, ValueError):
                    raise InputError(
                        f"{path}, line {reader.line_num}: expected six numbers."
                    ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}.") from None
    pairs = np.reshape(rows, (-1, 6))
    if not np.isfinite(pairs).all():
        raise InputError(f"{path}: not all numbers are finite.")
    return pairs[:, :3], pairs[:, 3:]


def fit_calibration(points_O: np.ndarray, points_W: np.ndarray) -> Calibration:
    """Fits the pose that takes the points of one frame to those of the other.

    It has the least sum of squared residuals (Kabsch 1976).

    Args:
        points_O: In OptiTrack's frame, shape (N, 3), m, N >= 4.
        points_W: The same points in the robot's frame, shape (N, 3), m.

    Raises:
        InputError: If there are too few points, or they lie on a line.
    """
    if len(points_O) < _FEWEST:
        raise InputError(
            f"{len(points_O)} pairs of points are too few; there must be {_FEWEST}."
        )
    mean_O, mean_W = points_O.mean(axis=0), points_W.mean(axis=0)
    around_O, around_W = points_O - mean_O, points_W - mean_W
    spreads = np.linalg.svd(around_O, compute_uv=False) / np.sqrt(len(points_O))
    if spreads[1] < _LEAST_SPREAD:
        raise InputError(
            "the points lie on a line, or in one place; spread them over the table."
        )
    rotation, _ = Rotation.align_vectors(around_W, around_O)
    R_WO = RotationMatrix(rotation.as_matrix())
    X_WO = RigidTransform(R_WO, mean_W - R_WO @ mean_O)
    fitted = (X_WO @ points_O.T).T
    return Calibration(X_WO, np.linalg.norm(fitted - points_W, axis=1))
