"""The tutorial's Python code runs, page by page, as it is printed."""

from __future__ import annotations

import inspect
import re
import runpy
from collections.abc import Iterator
from operator import attrgetter
from typing import Any, get_args, get_type_hints

import pytest
from helpers import ROOT

import gvtorch as gv
from gvtorch.viewer.schema import arguments

FOLDER = ROOT / "docs" / "tutorial"
PAGES = sorted(FOLDER.glob("*.md"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("page", [pytest.param(page, id=page.stem) for page in PAGES])
@pytest.mark.filterwarnings("default", "error::UserWarning")
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    """Runs within this process, because a new one would have to import torch."""
    blocks = BLOCK.findall(page.read_text())
    assert len(blocks) >= 2
    script = tmp_path / "page.py"
    script.write_text("\n".join(blocks))
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(script), run_name="__main__")
    for name in re.findall(r'(?:save|Video)\("(\w+\.\w+)"', "".join(blocks)):
        assert (tmp_path / name).stat().st_size > 500, name


@pytest.mark.parametrize("page", [pytest.param(page, id=page.stem) for page in PAGES])
def test_links_of_a_page_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#]+)", page.read_text())
    assert links
    for link in links:
        assert (page.parent / link).exists(), link


def test_links_from_other_programs_lead_somewhere():
    text = (ROOT / "docs" / "coming_from.md").read_text()
    for link in re.findall(r"\]\(([^)#]+)", text):
        assert (ROOT / "docs" / link).exists(), link
    for name in set(re.findall(r"gv\.([A-Za-z_0-9]+(?:\.[A-Za-z_]+)*)", text)):
        target: object = gv
        for part in name.split("."):
            target = getattr(target, part)


def parameters(function: Any) -> Iterator[str]:
    """Yields the names of a function's parameters, and those of a TypedDict that it unpacks."""
    for parameter in inspect.signature(function).parameters.values():
        yield parameter.name
        if parameter.kind is parameter.VAR_KEYWORD:
            for settings in get_args(get_type_hints(function)[parameter.name]):
                yield from get_type_hints(settings)


def test_arguments_in_the_docs_are_those_of_the_code():
    """In calls without further calls in them, such as `gv.Lit(transfer, ambient=0.5)`."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    calls = [
        (page.name, name, argument)
        for page in pages
        for name, inner in re.findall(r"\bgv\.([\w.]+)\(([^()]*)\)", page.read_text())
        for argument in re.findall(r"\b(\w+)=", inner)
    ]
    assert len(calls) > 100
    for page, name, argument in calls:
        target = attrgetter(name)(gv)
        known = {*arguments(target)} if isinstance(target, type) else set(parameters(target))
        assert argument in known, f"{page}: {name} takes no {argument}"


def test_the_gallery_has_every_example_and_its_picture():
    text = (ROOT / "docs" / "gallery.md").read_text()
    row = r"!\[\]\(images/(\w+)\.png\) \| \[\1\.py\]\(\.\./examples/\1\.py\): \w"
    named = re.findall(row, text)
    assert "[mandelbulb_film.py](../examples/mandelbulb_film.py)" in text, "of it there is a film"
    every = [*named, "mandelbulb_film"]
    assert sorted(every) == sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
    for name in named:
        assert (ROOT / "docs" / "images" / f"{name}.png").stat().st_size > 10_000, name
