"""`SurfaceExport`: makes a surface that a page asks for, as a file of triangles, in a thread, so
that rendering goes on.
"""

from __future__ import annotations

import tempfile
import threading
import time
from pathlib import Path

from ..base.messages import one_line
from ..base.volume import Volume
from ..io.resources import amount
from ..io.stores.store import Store
from ..io.surface import export_surface
from .client import Client, Interrupted
from .protocol import Surface

_MAX_FILE_BYTES = 1 << 28  # most bytes of a file, which a page holds in memory
_PROGRESS_SECONDS = 0.2  # seconds between two messages of progress


class SurfaceExport:
    """A surface that is being made for a page; it ends, at the next block, when the page leaves."""

    def __init__(
        self, client: Client, request: Surface, data: Volume | Store, component: int
    ) -> None:
        """Starts to make the surface that a page asked for, of one component of the voxels."""
        self._client, self._request, self._data, self._component = client, request, data, component
        self._last_progress = 0.0
        self._thread = threading.Thread(target=self._run, name="gvtorch surface", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        return self._thread.is_alive()

    def _run(self) -> None:
        request, client = self._request, self._client
        name = f"surface.{request.format}"
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / name
                surface = export_surface(
                    *(self._data, request.value, path),
                    level=request.level,
                    component=self._component,
                    progress=self._progress,
                )
                size = path.stat().st_size
                if size > _MAX_FILE_BYTES:
                    raise ValueError(
                        f"surface: {surface.triangles} triangles, {amount(size)}, are more than "
                        f"the {amount(_MAX_FILE_BYTES)} that a page takes: a coarser level, or "
                        "gvtorch surface"
                    )
                client.send_file(name, path.read_bytes())
        except Interrupted:
            pass
        except Exception as error:  # whatever it was, the view goes on
            client.send_message("refused", text=one_line(error))

    def _progress(self, _stage: str, done: int, total: int) -> None:
        if self._client.gone:
            raise Interrupted
        now = time.monotonic()
        if now > self._last_progress + _PROGRESS_SECONDS and done < total:
            self._last_progress = now
            self._client.send_message("exporting", done=done, total=total)
