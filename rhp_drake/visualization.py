"""Meshcat for a run: where it listens, where its camera stands, how it is lit."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.errors import InputError

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

# s between frames: four periods of the robot's commands, eight steps of the physics.
FRAME_PERIOD: Final = 0.032


@dataclass
class VisualizationConfig:
    """What a run looks like.

    Attributes:
        host: The address Meshcat listens at; by default this machine alone can look.
        port: The port, null for the first free one from 7000 on.
        camera: Where the camera stands, m in W.
        camera_target: What it looks at, m in W.
    """

    host: str = "localhost"
    port: int | None = None
    camera: np.ndarray = field(default_factory=lambda: np.array([1.70, -0.55, 1.15]))
    camera_target: np.ndarray = field(
        default_factory=lambda: np.array([0.42, 0.0, 0.13])
    )


def MakeMeshcat(config: VisualizationConfig) -> "Meshcat":
    """Starts Meshcat with a clear view of the table.  One per process is enough.

    Raises:
        InputError: If it cannot listen there.
    """
    from pydrake.geometry import Meshcat, MeshcatParams

    params = MeshcatParams(host=config.host, port=config.port, show_stats_plot=False)
    try:
        meshcat = Meshcat(params)
    except RuntimeError as error:
        raise InputError(f"visualization: {error}") from None
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.72, 0.76, 0.80])
    # One lamp's shadows tell how far things are from the table.
    lamp = "/Lights/PointLightNegativeX/<object>"
    meshcat.SetProperty(lamp, "castShadow", True)
    # Else the shadows' coarse grid draws stripes on what the lamp hardly touches.
    meshcat.SetProperty(lamp, "shadow.normalBias", 0.02)
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "zoom", 2.1)
    meshcat.SetCameraPose(config.camera, config.camera_target)
    return meshcat
