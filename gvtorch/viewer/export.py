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

_MOST = 1 << 28  # most bytes of a file, which a page holds in memory
_EVERY = 0.2  # seconds between two messages of progress


class SurfaceExport:
    """A surface that is being made for a page."""

    def __init__(self, client: Client, wanted: Surface, data: Volume | Store, number: int) -> None:
        """Starts to make the surface that a page asked for, of component `number` of voxels."""
        self._client, self._wanted, self._data, self._number = client, wanted, data, number
        self._ended, self._told = False, 0.0
        self._thread = threading.Thread(target=self._run, name="gvtorch surface", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether it is still being made."""
        return self._thread.is_alive()

    def serves(self, client: Client) -> bool:
        """Returns whether it is made for this page."""
        return client is self._client

    def end(self) -> None:
        """Stops it at the next block; does not wait for that."""
        self._ended = True

    def _run(self) -> None:
        wanted, client = self._wanted, self._client
        name = f"surface.{wanted.format}"
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / name
                made = export_surface(
                    *(self._data, wanted.value, path),
                    level=wanted.level,
                    component=self._number,
                    progress=self._progress,
                )
                size = path.stat().st_size
                if size > _MOST:
                    raise ValueError(
                        f"surface: {made.triangles} triangles, {amount(size)}, are more than the "
                        f"{amount(_MOST)} that a page takes: a coarser level, or gvtorch surface"
                    )
                client.send_file(name, path.read_bytes())
        except Interrupted:
            pass
        except Exception as error:  # whatever it was, the view goes on
            client.tell("refused", text=one_line(error))

    def _progress(self, _what: str, done: int, total: int) -> None:
        if self._ended:
            raise Interrupted
        now = time.monotonic()
        if now > self._told + _EVERY and done < total:
            self._told = now
            self._client.tell("exporting", done=done, total=total)
