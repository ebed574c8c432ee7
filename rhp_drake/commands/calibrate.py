"""`rhp calibrate`: where the cameras' frame stands in the robot's."""

from pathlib import Path
from typing import Annotated

import typer


def calibrate(
    pairs: Annotated[
        Path,
        typer.Argument(
            help="CSV with the columns x_O, y_O, z_O, x_W, y_W, z_W: points as "
            "OptiTrack and as the robot see them, m."
        ),
    ],
) -> None:
    """Fits natnet.X_WO of a hardware file, and says how well it fits.

    Put a marker on the hand, stop at several places over the table, and note for each
    where Motive and where the robot says that the marker is. W is the robot's
    base_link: where PolyScope's Base has x and y, it has -x and -y.
    """
    import numpy as np
    from pydrake.math import RollPitchYaw

    from rhp_drake.station.calibration import fit_calibration, read_pairs

    result = fit_calibration(*read_pairs(pairs))
    xyz = ", ".join(f"{x:.5f}" for x in result.X_WO.translation())
    angles = np.rad2deg(RollPitchYaw(result.X_WO.rotation()).vector())
    rpy = ", ".join(f"{angle:.3f}" for angle in angles)
    print(f"X_WO:\n  xyz: [{xyz}]\n  rpy_deg: [{rpy}]")
    millimetres = 1000 * result.residuals
    worst = int(millimetres.argmax())
    print(
        f"Residuals of {len(millimetres)} points: "
        f"{np.sqrt(np.mean(millimetres**2)):.2f} mm RMS, "
        f"{millimetres[worst]:.2f} mm at most (point {worst + 1})."
    )
