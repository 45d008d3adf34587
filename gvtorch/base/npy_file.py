"""`write_npy`: an array as a .npy file, whose errors are told. NumPy's `save` and `tofile` end well
where the disk is full within the last bytes, which the C library holds back.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import numpy as np


class _Bytes:
    """A file that NumPy takes for none on disk, so that it hands bytes on."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def write(self, content: Any) -> int:
        """Writes bytes."""
        return self._file.write(content)


def write_npy(file: IO[bytes], values: np.ndarray) -> None:
    """Writes into an open file, which is not flushed; raises OSError where the disk is full."""
    plain: Any = _Bytes(file)
    np.lib.format.write_array(plain, np.asarray(values), allow_pickle=False)


def save_npy(path: Path, values: np.ndarray) -> None:
    """Writes a file; raises OSError where the disk is full."""
    with path.open("wb") as file:
        write_npy(file, values)
