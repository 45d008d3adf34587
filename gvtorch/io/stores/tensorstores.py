"""tensorstore: its settings, waiting for its results, and opening files and arrays of a folder."""

from __future__ import annotations

import functools
import os
import re
import time
from pathlib import Path
from typing import Any

from ...base.whole_file import text_path
from ..http import Endless, file_url, is_http, read_http
from ..relay import range_bytes, read_within, relay_folder, with_urls
from ..remote import local_path
from ..resources import cores
from .store_layout import WRITE_ZEROS

MAX_JSON_BYTES = 1 << 24  # of metadata
LOCAL_TIMEOUT = 3600.0  # seconds for one read of local data


class StoreError(OSError):
    """A store could not be read or written."""


class Deadline:
    """The time at which reads are abandoned: `timeout` seconds after this is created."""

    def __init__(self, timeout: float) -> None:
        check_process()
        self.timeout = timeout
        self._end = time.monotonic() + timeout

    @property
    def left(self) -> float:
        """Seconds until then."""
        return max(0.0, self._end - time.monotonic())

    def timeout_error(self, context: str) -> TimeoutError:
        """Returns the error of a read that took too long."""
        return TimeoutError(f"{context}: no answer within {self.timeout:g} s")

    def wait(self, future: Any, context: str) -> Any:
        """Returns the result of one of tensorstore's futures; raises TimeoutError if it took too
        long, StoreError if it failed.
        """
        try:
            return future.result(timeout=self.left)
        except TimeoutError:
            future.cancel()
            raise self.timeout_error(context) from None
        except Exception as error:  # tensorstore raises exceptions of several types
            raise StoreError(f"{context}: {one_line_error(error)}") from None


def one_line_error(error: BaseException) -> str:
    """Returns tensorstore's message in one line, without its annotations."""
    text = re.sub(r"\s*\[[a-z_]+(=| locations=).*", "", str(error), flags=re.DOTALL)
    return with_urls(" ".join(text.split()))[:400] or type(error).__name__


_user_pids: set[int] = set()  # processes that used tensorstore: this one, or one it was forked from


def check_process() -> None:
    """Raises StoreError in a process that was forked after tensorstore was used: it has lost
    tensorstore's threads, and would crash.
    """
    if _user_pids - {os.getpid()}:
        raise StoreError(
            "stores can't be read in a process that was forked after one was opened: open the "
            "first one in the workers, or start these by 'spawn' or 'forkserver' "
            "(DataLoader(multiprocessing_context='forkserver'))"
        )


@functools.cache
def context() -> Any:
    """Returns tensorstore's context: few threads, no cache (pools and host cache replace it)."""
    import tensorstore as ts

    _user_pids.add(os.getpid())
    return ts.Context(
        {
            "cache_pool": {"total_bytes_limit": 0},
            "data_copy_concurrency": {"limit": min(8, cores())},
            "file_io_concurrency": {"limit": min(16, 2 * cores())},
            "http_request_concurrency": {"limit": 16},
        }
    )


def kvstore(location: str | Path) -> Any:
    """Returns tensorstore's spec of a folder, given as a path, or as a URL that tensorstore knows.
    Links and ".." in a path are resolved as the operating system does; a path that tensorstore
    can't take, such as one that is not UTF-8, is replaced by a link to it (`text_path`).
    """
    text = local_path(str(location))
    if re.match(r"[a-z0-9+]{2,}://", text):
        return text if text.endswith("/") or "?" in text else text + "/"
    path = text_path(os.path.realpath(text))
    return {"driver": "file", "path": f"{path.rstrip('/')}/"}


def child(root: Any, path: str) -> Any:
    """Returns the spec of a folder inside a folder."""
    if isinstance(root, str):
        return file_url(root, f"{path}/")
    return {**root, "path": f"{root.get('path', '')}{path}/"}


def read_key(
    location: str,
    root: Any,
    name: str,
    deadline: Deadline,
    byte_range: slice | None = None,
    max_bytes: int = MAX_JSON_BYTES,
) -> Any:
    """Returns the content of a file in a folder, or a part of its bytes, which may count from its
    end; None if there is no such file. A file of more than `max_bytes` is a StoreError. Raises as
    `Deadline.wait`, and ValueError if there can be no such folder.
    """
    import tensorstore as ts

    file = f"{location}/{name}"
    try:
        if is_http(root):
            size = max_bytes if byte_range is None else range_bytes(byte_range, max_bytes)
            limits: Any = {"max_file_bytes": max_bytes, "seconds": deadline.left}
            return read_http(file_url(root, name), min(size, max_bytes), byte_range, **limits)
        if isinstance(root, dict):
            from .chunk_files import check_file

            check_file(f"{root['path']}{name}", max_bytes)
        try:
            folder = deadline.wait(ts.KvStore.open(root, context=context()), location)
        except StoreError as error:
            raise ValueError(f"{location}: not a store: {error}") from None
        wait = functools.partial(deadline.wait, context=file)
        return read_within(folder, name, byte_range, max_bytes, wait)
    except StoreError:
        raise
    except TimeoutError:
        raise deadline.timeout_error(file) from None
    except OSError as error:
        raise StoreError(f"{file}: {one_line_error(error)}") from None


def begin_open(root: Any, spec: dict[str, Any], mode: str = "read") -> Any:
    """Starts opening an array of a store; returns tensorstore's future.

    `root` comes from `kvstore`, `spec` from `StoreLayout`; `mode` is "read", "write" or "create"
    (unless it exists).
    """
    omitted = {"read": ("path", "metadata", WRITE_ZEROS), "write": ("path", "metadata")}
    unused = omitted.get(mode, ("path",))
    array_spec = {key: value for key, value in spec.items() if key not in unused}
    return opened_at(child(root, spec["path"]), array_spec, create=mode == "create")


def open_array(root: dict[str, Any], spec: dict[str, Any], mode: str = "read") -> Any:
    """Opens an array of a store on this machine; see `begin_open`. Raises as `Deadline.wait`."""
    array_path = f"{root['path']}{spec['path']}"
    return Deadline(LOCAL_TIMEOUT).wait(begin_open(root, spec, mode), array_path)


def opened_at(folder: Any, spec: dict[str, Any], *, create: bool = False) -> Any:
    """Starts opening the array in a folder; returns tensorstore's future."""
    import tensorstore as ts

    relayed = relay_folder(folder, context()) if isinstance(folder, str) else None
    if relayed is None:
        from .chunk_files import METADATA_FILES, check_file, failed_future

        try:
            for name in METADATA_FILES:
                check_file(f"{folder['path']}{name}", MAX_JSON_BYTES, name)
        except Endless as error:
            return failed_future(error)
    array_spec = {**spec, "kvstore": relayed.spec if relayed else folder}
    future = ts.open(array_spec, context=context(), open=True, create=create)
    if relayed:
        relayed.future = future
    return future
