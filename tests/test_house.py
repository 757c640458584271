"""The house: imports go down the floors, and each tool is named in one room only."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import unprocess_gen

HOUSE = Path(unprocess_gen.__file__).parent

FLOORS = (
    {"errors", "records", "shortcuts"},
    {"bayer", "colour", "compiled", "headers", "lanes", "markup", "streams", "tables"},
    {"normals"},
    {"methods", "poisson"},
    {
        *("config", "decode", "draws", "effects", "manifest", "patches", "process"),
        *("sensor", "shards", "sources", "synthetic", "unprocess", "video"),
    },
    {"fused", "physics", "planner"},
    {"electrons", "floats", "single"},
    {"pair", "photographs", "plan", "reader", "workspace"},
    {"selftest"},
    {"accuracy", "runner", "sweep", "transfer", "verify"},
    {"dng", "forecast", "preview", "repair", "report"},
    {"figures", "page"},
    {"compose"},
    {"cli"},
)
FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
DOORSTEP = {"__init__", "__main__"}

ONLY_IN = {
    "hydra": {"compose"},
    "omegaconf": {"compose", "config"},
    "joblib": {"runner"},
    "llvmlite": {"lanes", "shortcuts"},
    "numba": {"compiled", "lanes", "shortcuts"},
    "cv2": {"decode", "page", "preview", "process", "runner"},
    "PIL": {"decode"},
    "av": {"video"},
    "tarfile": {"shards"},
    "tifffile": {"dng"},
}
"""Which rooms may name a tool."""


def rooms() -> list[Path]:
    return sorted(HOUSE.glob("*.py"))


def imported(path: Path) -> list[str]:
    """Every module a room imports, by its full name, inside functions too."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "unprocess_gen":
            names += [f"unprocess_gen.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import, which hides where it goes"
            names.append(node.module or "")
    return names


@pytest.mark.parametrize("path", rooms(), ids=lambda path: path.stem)
def test_every_room_stands_on_a_floor(path: Path) -> None:
    assert path.stem in FLOOR or path.stem in DOORSTEP


@pytest.mark.parametrize("path", [path for path in rooms() if path.stem in FLOOR], ids=lambda path: path.stem)
def test_imports_go_down_the_floors(path: Path) -> None:
    used = {name.split(".")[1] for name in imported(path) if name.startswith("unprocess_gen.")} - {"__version__"}

    upwards = {room for room in used if FLOOR[room] >= FLOOR[path.stem]}

    assert not upwards, f"{path.stem} (floor {FLOOR[path.stem]}) imports {sorted(upwards)}"


@pytest.mark.parametrize("tool", ONLY_IN)
def test_a_tool_is_named_only_in_its_rooms(tool: str) -> None:
    named = {path.stem for path in rooms() if any(name.split(".")[0] == tool for name in imported(path))}

    assert named == ONLY_IN[tool]


def test_the_import_test_sees_an_upward_import(tmp_path: Path) -> None:
    room = tmp_path / "bayer.py"
    room.write_text("def late():\n    from unprocess_gen import cli\n    import unprocess_gen.runner\n")

    assert imported(room) == ["unprocess_gen.cli.main", "unprocess_gen.pipeline.generate"]


def test_no_fast_math_on_the_way_to_the_output() -> None:
    from unprocess_gen.simulation.kernels import gaussian as fused
    from unprocess_gen.simulation.kernels import normal as normals
    from unprocess_gen.simulation.kernels import physical as electrons
    from unprocess_gen.simulation.kernels import poisson

    kernels = [value for room in (electrons, fused, normals, poisson) for value in vars(room).values()]
    kernels = [value for value in kernels if hasattr(value, "targetoptions")]

    assert len(kernels) >= 20
    assert not any(kernel.targetoptions.get("fastmath") for kernel in kernels)
