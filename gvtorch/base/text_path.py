"""`text_path`: a path as libraries take it that do not take all: by a link in a folder of this
process, which goes when the process ends. They want UTF-8; and tensorstore makes "/" of backslashes
and refuses folders that are named as its locks are.
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
    can be written as UTF-8, and holds no backslash (where these part no folders) and no ".__lock".
    """
    bytes_of = os.fsencode(path)
    plain = path.encode(errors="replace") == bytes_of and ".__lock" not in path
    if plain and (os.sep == "\\" or "\\" not in path):
        return path
    name = hashlib.sha256(bytes_of).hexdigest()[:32]
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
