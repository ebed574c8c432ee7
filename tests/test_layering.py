"""Who may import whom; the README says it in words."""

import ast
from pathlib import Path

import pytest

import rhp_drake

ROOT = Path(rhp_drake.__file__).parent
# From the ground up.  A module imports its own folder and layers below; late imports
# count, too.
LAYERS = (
    {
        "drivers",
        "errors",
        "files",
        "frozen_instances",
        "physics",
        "planar_geometry",
        "random_streams",
        "resources",
        "safety",
        "task",
        "typed_yaml",
        "visualization",
        "workers",
    },
    {"push_model", "station", "value"},
    {"planning"},
    {"learning", "systems"},
    {"gymnasium_env", "scenario"},
    {"closed_loop"},
    {"hardware", "lcm_bridge"},
    {"run_closed_loop"},
    {"lab"},
    {"evaluation", "run_record"},
    {"benchmarks"},
    {"commands"},
    {"cli"},
)
HEIGHTS = {room: height for height, layer in enumerate(LAYERS) for room in layer}


def imported_rooms(path: Path) -> set[str]:
    """The folders or top modules of ours that a file imports."""
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "rhp_drake":
            rooms |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            first, _, rest = node.module.partition(".")
            rooms |= {rest.partition(".")[0]} if first == "rhp_drake" else set()
    return rooms


@pytest.mark.parametrize(
    "path",
    sorted({*ROOT.rglob("*.py")} - {ROOT / "__init__.py"}),
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_imports_go_down(path):
    room = path.relative_to(ROOT).parts[0].removesuffix(".py")
    for other in imported_rooms(path) - {room}:
        ground = HEIGHTS[room] == HEIGHTS[other] == 0
        assert HEIGHTS[other] < HEIGHTS[room] or ground, f"{room} imports {other}"
