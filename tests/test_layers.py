"""Floors: a file imports only from lower floors, and siblings on a floor do not import each
other."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from conftest import ROOT

PACKAGE = ROOT / "gvtorch"
FLOORS = [
    {"config", "check", "frame", "report", "stage", "volume"},
    {"cpp_ext"},
    {"ops"},
    {"pool"},
    {"io"},
    {"cache", "producers", "rendering"},
    {"arrivals", "jobs", "turns"},
    {"production"},
    {"scene"},
    {"engine"},
    {"bench"},
    {"tools"},
]
#: On the ground floor, what stands on what.
GROUND = {"volume": {"check", "config"}, "report": {"frame"}}


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def floor(name: str) -> int:
    return next(number for number, rooms in enumerate(FLOORS) if name in rooms)


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    here = path.relative_to(PACKAGE.parent).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            parts = (*base, *(node.module or "").split(".")) if node.module else base
            targets = [(*parts, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            targets = [tuple(alias.name.split(".")) for alias in node.names]
        else:
            continue
        rooms |= {target[1] for target in targets if len(target) > 1 and target[0] == "gvtorch"}
    return rooms


def modules() -> list[Path]:
    files = [
        p for p in PACKAGE.rglob("*.py") if p.name not in ("__main__.py",) and p.parent != PACKAGE
    ]
    alone = FLOORS[0] | {"arrivals", "jobs", "production", "turns", "scene", "engine"}
    return files + [PACKAGE / f"{name}.py" for name in sorted(alone)]


def test_imports_only_go_down():
    assert len(modules()) > 15
    for path in modules():
        own = room(path)
        for other in imported_rooms(path) - {own, "__version__"}:
            allowed = floor(other) < floor(own) or other in GROUND.get(own, set())
            assert allowed, f"{path.relative_to(ROOT)} imports {other}"


def test_ops_know_no_objects():
    for path in (PACKAGE / "ops").glob("*.py"):
        assert imported_rooms(path) <= {"check", "config", "cpp_ext", "ops", "volume"}, path


def test_kernel_headers_know_no_torch():
    for path in (PACKAGE / "cpp_ext" / "csrc").glob("*.h"):
        if path.name not in ("entry.h", "for_each.h"):
            assert "torch/" not in path.read_text() and "ATen" not in path.read_text(), path


def test_import_loads_torch_and_nothing_heavier():
    code = (
        "import sys, gvtorch as gv; gv.render, gv.N3Tree, gv.Camera, gv.read_volume;"
        "print(*sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "torch" in loaded
    assert not loaded & {"kornia", "nibabel", "astropy", "tifffile", "nrrd", "tyro", "rich", "PIL"}
