"""`text_path`: a path as UTF-8, for libraries that take no other: by a link in a folder of this
process, which goes when the process ends.
"""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import shutil
import tempfile


def text_path(path: str) -> str:
    """Returns an absolute path itself, or another one of the same place, which need not exist, that
    can be written as UTF-8.
    """
    try:
        path.encode()
        return path
    except UnicodeEncodeError:
        name = hashlib.sha256(os.fsencode(path)).hexdigest()[:32]
    link = os.path.join(_folder(os.getpid()), name)
    try:
        os.symlink(path, link)
    except FileExistsError:
        pass  # made before
    return link


@functools.cache
def _folder(process: int) -> str:
    folder = tempfile.mkdtemp(prefix="gvtorch-")

    def remove() -> None:
        if os.getpid() == process:  # not in one that was forked
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder
