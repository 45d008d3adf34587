"""Floors: a file imports only from lower floors, and siblings on a floor do not import each
other."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from helpers import ROOT

import gvtorch.ops
import gvtorch.shaders
from gvtorch.bench import WORKLOADS
from gvtorch.viewer.protocol import MESSAGES

PACKAGE = ROOT / "gvtorch"
FLOORS = [
    {"base"},
    {"cpp_ext"},
    {"ops"},
    {"meshes", "points", "pool"},
    {"cameras", "fields", "io"},
    {"cache", "opengl", "pictures", "shaders"},
    {"producers"},
    {"tracing"},
    {"engine"},
    {"viewer"},
    {"bench"},
    {"tools"},
]
#: Files that only re-export names.
DOOR = {"__init__.py", "__main__.py"}


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def floor(name: str) -> int:
    return next(number for number, rooms in enumerate(FLOORS) if name in rooms)


@cache
def imported(path: Path) -> set[tuple[str, ...]]:
    """Returns the dotted names that a file imports, also inside functions and for type checkers."""
    names: set[tuple[str, ...]] = set()
    here = path.relative_to(PACKAGE.parent).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            parts = (*base, *(node.module or "").split(".")) if node.module else base
            names |= {(*parts, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {tuple(alias.name.split(".")) for alias in node.names}
    return names


def imported_rooms(path: Path) -> set[str]:
    return {name[1] for name in imported(path) if len(name) > 1 and name[0] == "gvtorch"}


def imported_files(path: Path) -> set[Path]:
    """Returns the package's files that a file imports: modules, or those that define a name."""
    files = set()
    for name in imported(path):
        for parts in (name, name[:-1]):
            stem = PACKAGE.parent.joinpath(*parts)
            existing = [f for f in (stem.with_suffix(".py"), stem / "__init__.py") if f.is_file()]
            if parts[:1] == ("gvtorch",) and existing:
                files.add(existing[0])
                break
    return files - {PACKAGE / "__init__.py"}


def modules() -> list[Path]:
    return [path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE]


def test_there_are_no_loose_files():
    assert {path.name for path in PACKAGE.glob("*.py")} == DOOR
    assert {path.parent.relative_to(PACKAGE).parts[0] for path in modules()} == set.union(*FLOORS)


def test_imports_only_go_down():
    assert len(modules()) > 15
    for path in modules():
        importing = room(path)
        for other in imported_rooms(path) - {importing, "__version__"}:
            assert floor(other) < floor(importing), f"{path.relative_to(ROOT)} imports {other}"


def test_no_import_circle():
    graph = {path: imported_files(path) for path in modules()}
    assert sum(map(len, graph.values())) > 300
    list(TopologicalSorter(graph).static_order())  # raises CycleError, which holds the circle


def test_ops_know_no_objects():
    for path in (PACKAGE / "ops").rglob("*.py"):
        assert imported_rooms(path) <= {"base", "cpp_ext", "ops"}, path


def test_kernel_headers_know_no_torch():
    headers = [*(PACKAGE / "cpp_ext" / "csrc").rglob("*.h")]
    assert len(headers) > 20
    for path in headers:
        if path.name not in ("entry.h", "for_each.h"):
            assert "torch/" not in path.read_text() and "ATen" not in path.read_text(), path


def test_nothing_else_runs_in_a_circle():
    """C++ headers, and the modules of the page, which a notebook gets as one file."""
    csrc, page = PACKAGE / "cpp_ext" / "csrc", PACKAGE / "viewer" / "page"
    headers = {file: csrc for file in csrc.rglob("*.h")}
    modules = {file: page for file in page.glob("*.js")}
    for files, names in ((headers, r'^#include "([^"]+)"'), (modules, r'from "\./([^"]+)"')):
        graph = {
            file: {top / name for name in re.findall(names, file.read_text(), re.M)}
            for file, top in files.items()
        }
        assert len(graph) > 15 and {*graph} >= set().union(*graph.values())
        list(TopologicalSorter(graph).static_order())  # raises CycleError, which holds the circle


def test_kernel_headers_include_only_downward():
    floors = [
        {"base"},
        {"walk"},
        {"cache", "cameras", "fields", "mesh", "noise", "points", "shaders"},
        {"packets"},
        {"entry"},
    ]
    csrc = PACKAGE / "cpp_ext" / "csrc"
    number = {name: floor for floor, names in enumerate(floors) for name in names}
    for path in csrc.glob("*/*.h"):
        folder = path.parent.name
        for other in re.findall(r'#include "(\w+)/', path.read_text()):
            below = number[other] < number[folder] or other == folder
            assert below, f"{path.relative_to(csrc)} includes {other}"


def named_elsewhere(path: Path, name: str) -> bool:
    """Returns whether a name may be used twice: by an op, its twin and the function that they
    serve, or by a shader and its twin; commands, workloads and messages have the names that users
    and pages type; peers have one interface.
    """
    home = path.relative_to(PACKAGE).parts
    return (
        (home[0] == "ops" and name in vars(gvtorch.ops))
        or (home[:2] == ("ops", "reference") and name in vars(gvtorch.shaders))
        or (home[0] == "tools" and name.lower() == path.stem)
        or (home == ("viewer", "protocol.py") and name.lower() in MESSAGES)
        or (home[0] == "bench" and (name in WORKLOADS or "peers" in home))
    )


def test_no_two_things_share_a_name():
    """Checks classes, and functions that other files may import."""
    homes: dict[str, list[str]] = {}
    for path in modules():
        for node in ast.parse(path.read_text()).body:
            shared = isinstance(node, ast.FunctionDef) and node.name[0] != "_"
            if (shared or isinstance(node, ast.ClassDef)) and not named_elsewhere(path, node.name):
                homes.setdefault(node.name, []).append(str(path.relative_to(PACKAGE)))
    assert not {name: files for name, files in homes.items() if len(files) > 1}
    assert len(homes) > 900, "the test must see something"


def test_import_loads_torch_and_nothing_heavier():
    code = (
        "import sys, torch, gvtorch as gv; gv.read_volume; gray = gv.TransferFunction;"
        "tree = gv.N3Tree.from_volume(gv.Volume(torch.zeros(4, 4, 4)));"
        "gv.render(tree, gv.Camera.orbit(30, width=4, height=4), gray.preset('gray', 0, 1));"
        "print(*sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "torch" in loaded
    heavy = {"kornia", "nibabel", "astropy", "tifffile", "nrrd", "tyro", "rich", "PIL", "sympy"}
    assert not loaded & heavy


def test_workers_of_a_conversion_load_no_torch():
    """Each would take a second longer to start, and more memory. They import the task's module and
    those of sources that are read from files.
    """
    modules = "io.formats, gvtorch.io.stores.shard, gvtorch.io.label_source, gvtorch.io.oblique"
    code = f"import sys, tensorstore, gvtorch.{modules}; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "gvtorch.base.downsample" in loaded and "torch" not in loaded


def test_test_files_import_helpers_and_no_test_file():
    for path in (ROOT / "tests").rglob("*.py"):
        for name in imported(path):
            assert name[0] != "conftest" and not name[0].startswith("test_"), path
