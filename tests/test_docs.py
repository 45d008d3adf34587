"""Every link of the docs leads to an existing file and heading, and every name in backticks, there
and in docstrings and comments, exists in the code.
"""

import ast
import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def prose(page: str) -> str:
    """Returns a page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page, flags=re.M | re.S)


def anchors(text: str) -> set[str]:
    """Returns the anchors that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", prose(text), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", h.strip().lower()).replace(" ", "-") for h in headings}


def broken(page: Path, text: str) -> list[str]:
    """Returns the links of a page that lead nowhere."""
    links = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if re.match(r"\w+:", link):
            continue
        if not target.exists():
            links.append(link)
        elif anchor and anchor not in anchors(target.read_text(encoding="utf-8")):
            links.append(link)
    return links


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page):
    assert broken(page, page.read_text(encoding="utf-8")) == []


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One `two`, three\n```\n# no heading\n```\n")
    links = "[a](#one-two-three) [b](gone.md) [c](page.md#no-heading) [d](https://example.org/#x)"
    assert broken(page, links) == ["gone.md", "page.md#no-heading"]


# --- names in backticks

WORD = re.compile(r"(?<!\w)[A-Za-z_]\w+")
#: Words in backticks that are no names of this project.
FOREIGN = {
    # names of other projects, programs and standards
    *("GvShader", "GvSimpleHostProducer", "ShadeOn", "ray_marching", "render_weight_from_density"),
    *("vtkGPUVolumeRayCastMapper", "vtkSmartVolumeMapper", "add_image", "tofile", "forkserver"),
    *("ccache", "nccopy", "commit", "glfw", "get_proc_address", "gl_FragDepth", "glReadPixels"),
    *("glClipControl", "glDepthFunc", "Bone"),
    # what a reader replaces by a name, a number or a file
    *("COLUMN", "VOLUME", "RRGGBB", "_XxYxZ_dtype", "ex", "ey", "ez", "tx", "ty"),
    *("open_NAME", "_take_NAME", "test_formats_"),
    *("smoke", "hyg_stars", "scan_512x512x300_int16"),
}
#: Fields of a syntax tree's nodes that hold names.
NAME_FIELDS = frozenset(("id", "attr", "name", "arg", "asname", "module"))
#: Endings of files of code that is not Python.
CODE = (".h", ".cpp", ".cu", ".js", ".css", ".html", ".toml")
#: Pages on the past, whose names may be gone.
HISTORY = ("CHANGELOG.md", "changes.md")


@cache
def tracked() -> list[Path]:
    """Returns the files of the repository."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [path for name in run.stdout.splitlines() if (path := ROOT / name).is_file()]


@cache
def names_and_docstrings(path: Path) -> tuple[set[str], list[str]]:
    """Returns a module's identifiers, with the words of strings without a space, which may be
    names; and the strings that are statements: docstrings, and texts below fields.
    """
    names: set[str] = set()
    strings: dict[int, str] = {}
    docstrings: dict[int, str] = {}
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant):
            if isinstance(node.value, str):
                strings[id(node)] = node.value
        elif isinstance(node, ast.Expr):
            if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
                docstrings[id(node.value)] = node.value.value
        else:
            for field in NAME_FIELDS.intersection(node._fields):
                value = getattr(node, field)
                names.update(value.split(".") if isinstance(value, str) else ())
    for key, value in strings.items():
        if " " not in value and key not in docstrings:
            names.update(WORD.findall(value))
    return names, [*docstrings.values()]


@cache
def names_in_code() -> set[str]:
    """Returns all names in the code, and those of files and folders."""
    names = set(FOREIGN)
    for path in tracked():
        names |= {*path.relative_to(ROOT).parts, path.stem}
        if path == Path(__file__):
            continue
        if path.suffix in (".py", ".pyi"):
            names |= names_and_docstrings(path)[0]
        elif path.suffix in CODE or path.name in ("Makefile", "run"):
            code = re.sub(r"//.*|^#.*", "", path.read_text(encoding="utf-8"), flags=re.M)
            names |= set(WORD.findall(code))
    return names


def documentation(path: Path) -> str:
    """Returns the prose of a page, or the docstrings and comments of a module."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return prose(text)
    comments = re.findall(r"#.*", text)
    return "\n\n".join(names_and_docstrings(path)[1] + comments)


def unknown(text: str) -> list[str]:
    """Returns the words in backticks that are no names, and the paths that lead to no file."""
    spans = re.findall(r"`([^`]+)`", text)
    words = [word for span in spans for word in WORD.findall(span)]
    paths = [p for span in spans for p in re.findall(r"[\w./]+/[\w.]+\.(?:py|h|cpp|js|md)\b", span)]
    return [word for word in words if word not in names_in_code()] + [
        path
        for path in paths
        if "NAME" not in path and not any(str(file).endswith(f"/{path}") for file in tracked())
    ]


def test_names_in_backticks_exist():
    files = [path for path in tracked() if path.suffix in (".py", ".md")]
    found = {
        str(path.relative_to(ROOT)): words
        for path in files
        if path.name not in HISTORY and (words := unknown(documentation(path)))
    }
    assert len(files) > 500 and not found


def test_a_name_that_does_not_exist_is_found():
    text = "`Engine.frame` in `engine/engine.py`, `Engine.renderr` in `engine/engin.py` and `a + b`"
    assert unknown(text) == ["renderr", "engin", "engine/engin.py"]
