"""Meshcat for a run: its camera and light, bands drawn on the table, and text."""

from dataclasses import dataclass, field
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.errors import InputError

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

# s between frames: four periods of the robot's commands, eight steps of the physics.
FRAME_PERIOD: Final = 0.032
# Pixels of a line of text.
_FONT_SIZE: Final = 32
# The background's colors, at the top and at the bottom.
SKY: Final = ([0.93, 0.95, 0.97], [0.72, 0.76, 0.80])


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
    set_sky(meshcat, SKY)
    # One lamp's shadows tell how far things are from the table.
    lamp = "/Lights/PointLightNegativeX/<object>"
    meshcat.SetProperty(lamp, "castShadow", True)
    # Else the shadows' coarse grid draws stripes on what the lamp hardly touches.
    meshcat.SetProperty(lamp, "shadow.normalBias", 0.02)
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "zoom", 2.1)
    meshcat.SetCameraPose(config.camera, config.camera_target)
    return meshcat


def set_sky(
    meshcat: "Meshcat",
    colors: tuple[list[float], list[float]],
    time: float | None = None,
) -> None:
    """Colors the background.

    Args:
        meshcat: Its.
        colors: At the top and at the bottom; red, green and blue, 0 to 1.
        time: In a recording, s; None if that need not know.
    """
    for side, color in zip(("top_color", "bottom_color"), colors, strict=True):
        meshcat.SetProperty("/Background", side, color, time)


def draw_bands(
    meshcat: "Meshcat",
    path: str,
    begins: np.ndarray,
    ends: np.ndarray,
    color: np.ndarray,
    width: float,
    height: float,
) -> None:
    """Draws flat bands from points to points, as one object.

    It is a mesh because WebGL draws all lines one pixel wide.  If no band has a
    length, nothing is drawn.

    Args:
        meshcat: Where to draw.
        path: What to call the object.
        begins: Shape (k, 2), m in W.
        ends: Shape (k, 2), m in W.
        color: Red, green and blue, 0 to 1.
        width: Of the bands, m.
        height: Where they lie, m in W.
    """
    vertices, faces = _bands(begins, ends, width, height)
    if faces.size:
        # The browser takes the colors of vertices to be linear, all others not.
        colors = np.repeat(color[:, None] ** 2.2, vertices.shape[1], axis=1)
        meshcat.SetTriangleColorMesh(path, vertices, faces, colors)


def draw_text(
    meshcat: "Meshcat", path: str, text: str, line_height: float, color: np.ndarray
) -> None:
    """Draws text as one object, since Meshcat has none.

    It stands in the y-z plane of its path's frame, to be read from +x, above the
    origin and centred.

    Args:
        meshcat: Where to draw.
        path: What to call the object.
        text: One line or several.
        line_height: m.
        color: Red, green and blue, 0 to 1.
    """
    from PIL import Image, ImageDraw, ImageFont

    # A pixel row of the letters' bitmap is as many rectangles as it has runs.
    font = ImageFont.load_default(size=_FONT_SIZE)
    size = ImageDraw.Draw(Image.new("1", (1, 1))).multiline_textbbox((0, 0), text, font)
    image = Image.new("1", (math.ceil(size[2]), math.ceil(size[3])))
    ImageDraw.Draw(image).multiline_text((0, 0), text, 1, font)
    edges = np.diff(np.pad(np.asarray(image, dtype=int), ((0, 0), (1, 1))), axis=1)
    rows, begins = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    pixel = line_height / _FONT_SIZE
    left, right = (pixel * (x - image.width / 2) for x in (begins, ends))
    top = pixel * (image.height - rows)
    corners = [(left, top), (right, top), (right, top - pixel), (left, top - pixel)]
    vertices = np.stack([np.stack([0 * y, y, z]) for y, z in corners], axis=2).reshape(
        3, -1
    )
    colors = np.repeat(color[:, None] ** 2.2, vertices.shape[1], axis=1)
    meshcat.SetTriangleColorMesh(path, vertices, _rectangles(len(rows)), colors)


def _rectangles(number: int) -> np.ndarray:
    """Faces (3, 2 number) of rectangles whose corners follow each other."""
    first = 4 * np.arange(number, dtype=np.int32)
    return np.concatenate(
        [[first, first + 1, first + 2], [first, first + 2, first + 3]], axis=1
    ).astype(np.int32)


def _bands(
    begins: np.ndarray, ends: np.ndarray, width: float, height: float
) -> tuple[np.ndarray, np.ndarray]:
    """The triangles of `draw_bands`.

    Returns:
        Vertices of shape (3, 4 s) and faces of shape (3, 2 s), where s counts the
        bands that have a length.
    """
    along = ends - begins
    length = np.linalg.norm(along, axis=1)
    keep = length > 1e-4
    begins, ends, along = begins[keep], ends[keep], along[keep]
    # Half a width longer at both ends, so that bends have no gaps.
    along_half = along / length[keep, None] * width / 2
    across_half = along_half[:, ::-1] * [-1, 1]
    begins, ends = begins - along_half, ends + along_half
    corners = np.stack(
        [
            begins + across_half,
            begins - across_half,
            ends - across_half,
            ends + across_half,
        ],
        axis=1,
    ).reshape(-1, 2)
    vertices = np.column_stack([corners, np.full(len(corners), height)]).T
    return vertices, _rectangles(len(begins))
