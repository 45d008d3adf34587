"""A view below a cell of a real JupyterLab, turned by a mouse."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.browser import Tab
from helpers.viewer import TIMEOUT

pytestmark = pytest.mark.backend("browser")
CELLS = (
    """\
import numpy as np, gvtorch as gv
z, y, x = np.mgrid[-1:1:32j, -1:1:32j, -1:1:32j]
view = gv.view(gv.Volume(np.clip(300 * (1.2 - x * x - 2 * y * y - z * z), 0, 255).astype(np.uint8)))
view""",
    "view.close_view()",
)


def notebook() -> str:
    """Returns the cells as a Jupyter notebook."""
    cell_fields = {"metadata": {}, "outputs": [], "execution_count": None, "cell_type": "code"}
    cells = [{"id": f"cell{n}", "source": text, **cell_fields} for n, text in enumerate(CELLS)]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    content = {"cells": cells, "metadata": {"kernelspec": kernel}}
    return json.dumps({**content, "nbformat": 4, "nbformat_minor": 5})


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[str]:
    """The address of a JupyterLab that writes everything in the test's folder."""
    (tmp_path / "view.ipynb").write_text(notebook())
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    variables = ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR")
    variables += ("JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR")
    environment = {**os.environ, **{name: str(tmp_path / name) for name in variables}}
    options = ("--no-browser", "--allow-root", "--ip=127.0.0.1", f"--port={port}")
    options += (
        "--IdentityProvider.token=",
        f"--ServerApp.root_dir={tmp_path}",
        "--LabApp.news_url=",
    )
    command = [sys.executable, "-m", "jupyterlab", *options]
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    try:
        end = time.monotonic() + TIMEOUT
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/api", timeout=5).close()
                break
            except OSError:
                assert time.monotonic() < end, (tmp_path / "log").read_text()
                time.sleep(0.1)
        yield f"http://127.0.0.1:{port}/lab/tree/view.ipynb"
    finally:
        server.terminate()
        server.wait()


@pytest.mark.long
def test_a_cell_shows_the_live_page(chromium, lab):
    tab = Tab(chromium, lab, viewport={"width": 1200, "height": 900})
    try:
        cells, accept = (
            tab.page.locator(".jp-Notebook .jp-Cell"),
            tab.page.locator(".jp-mod-accept"),
        )

        def run(number: int) -> None:
            cells.nth(number).locator(".jp-InputArea-editor").click()
            tab.page.keyboard.press("Shift+Enter")

        prompt, tried = cells.first.locator(".jp-InputPrompt"), [time.monotonic()]

        def frame_count() -> int:
            busy = accept.count()  # dialogs "which kernel?", as it had not started
            if busy:
                accept.first.click()
            late = time.monotonic() > tried[0] + 5 and prompt.inner_text() == "[ ]:"
            if busy or late:  # the key was not handled
                run(0)
                tried[0] = time.monotonic()
            return tab.page.locator(".gv-picture").count()

        run(0)
        tab.until(frame_count)
        before = tab.final()
        assert before.max() > 100
        box = tab.page.locator(".gv-picture").bounding_box()
        x, y = box["x"] + box["width"] / 3, box["y"] + box["height"] / 2
        tab.drag((x, y), (x + 60, y + 90))
        tab.until(lambda: (tab.final() != before).mean() > 0.02)
        run(1)
        tab.page.wait_for_selector(".gv-lost", timeout=1e3 * TIMEOUT)
        assert tab.page.locator(".gv-note").inner_text().startswith("The view was closed")
        assert not [complaint for complaint in tab.complaints if "gv" in complaint]
    finally:
        tab.close()
