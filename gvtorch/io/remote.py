"""`fetch`: downloads the file at a URL into a cache on disk. http and https servers need not
support byte ranges; s3, gs and other schemes use fsspec.

    CACHE/KEY/about.json      the URL, and what identifies the version of the file on the server
    CACHE/KEY/VERSION/NAME    the file; its folder appears once the file is complete

The cache is bounded: the least recently used files are removed first. GVTORCH_CACHE sets another
folder (also for compiled shaders), GVTORCH_CACHE_GB another bound (50), also for a single file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import warnings
from collections.abc import Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote, urlsplit

from ..base.digits import finite_number, whole_number
from ..base.messages import need_library, one_line
from ..base.whole_file import cache_folder, write_text
from .http import (
    MIN_BYTES_PER_SECOND,
    MISSING_STATUS,
    REQUEST_HEADERS,
    HttpStatus,
    TimedResponse,
    ask_by_urllib,
    unpacked,
)
from .resources import amount

_PART_BYTES = 1 << 20  # bytes
_PART_SECONDS = 30.0 + _PART_BYTES / MIN_BYTES_PER_SECOND  # for an answer to begin, and for a part
_FOLDER_ENDINGS = ("zarr", "n5")  # read in parts from the server, not downloaded
_DETACHED_HEADERS = (".mhd", ".nhdr")

Version = dict[str, str]  # what identifies the version of a file on its server, as its ETag


def local_path(text: str) -> str:
    """Returns the path of a file:// URL; any other text as it is."""
    return unquote(urlsplit(text).path) if text.startswith("file://") else text


def is_file_url(text: str) -> bool:
    """Returns whether a URL is of a file, with a file's ending, and not of a Zarr or N5 folder."""
    if not re.match(r"[a-z0-9+]{2,}://", text) or text.startswith("file://"):
        return False
    ending = re.search(r"\.([A-Za-z]\w*)$", _file_name(text))
    is_file = ending is not None and ending[1].lower() not in _FOLDER_ENDINGS
    return is_file and not text.endswith("/")


def cache_limit() -> int:
    """Returns the most bytes that the cache may hold."""
    text = os.environ.get("GVTORCH_CACHE_GB", "50")
    limit = finite_number(text)
    if limit is None or not 0 < limit < 1e6:
        raise ValueError(f"GVTORCH_CACHE_GB must be gigabytes, got {text!r}")
    return int(limit * 1e9)


def fetch(url: str) -> Path:
    """Returns a local copy of the file, downloaded unless the one in the cache is up to date. If
    the server can't be reached or fails, returns the one in the cache, with a warning.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is a header whose numbers lie in another file (.mhd, .nhdr).
        OSError: It can't be downloaded, is cut off, or is larger than the cache or the disk.
        ImportError: A library is missing.
    """
    if url.lower().split("?")[0].endswith(_DETACHED_HEADERS):
        raise ValueError(f"{url}: its numbers are in another file next to it: download both")
    folder = cache_folder("downloads") / hashlib.sha256(url.encode()).hexdigest()[:32]
    cached = _cached_copy(folder)
    opener = _open_http if urlsplit(url).scheme in ("http", "https") else _open_fsspec
    try:
        download = opener(url, cached[1] if cached else {})
    except FileNotFoundError:
        raise
    except OSError as error:
        if cached is None:
            raise OSError(f"{url}: can't be downloaded: {_reason(error)}") from None
        warnings.warn(f"{url}: no answer ({_reason(error)}); using the cached copy", stacklevel=3)
        download = None
    if download is None:
        assert cached is not None
        os.utime(cached[0].parent)
        return cached[0]
    parts, size, version = download
    with closing(parts):
        folder.mkdir(parents=True, exist_ok=True)
        file = _download(url, folder, parts, size)
    key = hashlib.sha256(json.dumps(version, sort_keys=True).encode()).hexdigest()[:16]
    version_folder = folder / (key if version else file.parent.name.strip(".").split("-")[1])
    try:
        file.parent.rename(version_folder)
    except OSError:  # another process has written it already
        shutil.rmtree(file.parent, ignore_errors=True)
    record = {"url": url, "name": file.name, "place": version_folder.name, "version": version}
    write_text(folder / "about.json", json.dumps(record))
    _evict(version_folder)
    return version_folder / file.name


def content_version(file: Path) -> Version | None:
    """Returns what identifies the content of a downloaded file: the same for any copy of it, unlike
    the time of the download. None for other files.
    """
    folder = file.parent.parent
    if not (folder / "about.json").is_file() or folder.parent != cache_folder("downloads"):
        return None
    cached = _cached_copy(folder)
    if cached is not None and cached[0] == file and cached[1]:
        return cached[1]
    with file.open("rb") as stream:
        return {"SHA-256": hashlib.file_digest(stream, "sha256").hexdigest()}


def _file_name(url: str) -> str:
    """Returns a file name for a URL, made of harmless characters."""
    name = unquote(urlsplit(url).path.rpartition("/")[2])
    return re.sub(r"[^\w.+-]", "_", name).lstrip(".")[-120:] or "file"


def _cached_copy(folder: Path) -> tuple[Path, Version] | None:
    """Returns the copy in the cache, and its version; None if there is none."""
    try:
        record = json.loads((folder / "about.json").read_text(encoding="utf-8"))
        file = folder / Path(record["place"]).name / Path(record["name"]).name
        version = {str(name): str(value) for name, value in dict(record["version"]).items()}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return (file, version) if file.is_file() else None


Download = tuple[Generator[bytes, None, None], int | None, Version]


def _open_http(url: str, known_version: Version) -> Download | None:
    """Begins a download; returns None if the server still has the known version."""
    validators = (("ETag", "If-None-Match"), ("Last-Modified", "If-Modified-Since"))
    conditions = {header: known_version[n] for n, header in validators if known_version.get(n)}
    try:
        deadline = time.monotonic() + _PART_SECONDS
        response = ask_by_urllib(url, REQUEST_HEADERS | conditions, deadline)
    except HttpStatus as error:
        if error.status == 304 and known_version:
            return None
        if error.status in MISSING_STATUS:
            raise FileNotFoundError(f"volume not found: {url}") from None
        raise
    if response.status != 200:
        response.close()
        raise HttpStatus(response.status, response.reason)
    length = response.headers.get("Content-Length", "")
    version = {name: response.headers[name] for name, _ in validators if response.headers.get(name)}
    stream = unpacked(url, response)
    size = whole_number(length) if stream is response else None
    return _read_parts(url, stream, response), size, version


def _open_fsspec(url: str, known_version: Version) -> Download | None:
    """Does the same for other schemes; where s3 or gs fails, tries again without credentials."""
    scheme = urlsplit(url).scheme
    fsspec = need_library(f"{url}: reading {scheme}://", "fsspec", extra="remote")
    try:
        system, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise ImportError(
            f"{url}: reading {scheme}:// needs a library: pip install 'gvtorch[remote]' ({error})"
        ) from None
    except ValueError as error:
        raise ValueError(f"{url}: {_reason(error)}") from None
    try:
        info = system.info(path)
    except FileNotFoundError:
        raise FileNotFoundError(f"volume not found: {url}") from None
    except Exception as error:
        if scheme not in ("s3", "gs", "gcs"):
            raise OSError(_reason(error)) from None
        anonymous = {"anon": True} if scheme == "s3" else {"token": "anon"}
        system, path = fsspec.core.url_to_fs(url, **anonymous)
        try:
            info = system.info(path)
        except Exception as retry_error:
            retried = _reason(retry_error)
            raise OSError(f"{_reason(error)}; without credentials: {retried}") from None
    names = ("ETag", "etag", "LastModified", "updated", "mtime", "created", "size")
    version = {name: str(info[name]) for name in names if info.get(name) is not None}
    size = info.get("size")
    if version == known_version and len(version) > 1:
        return None
    parts = _read_parts(url, system.open(path, "rb"))
    return parts, size if isinstance(size, int) else None, version


def _download(url: str, folder: Path, parts: Iterable[bytes], size: int | None) -> Path:
    """Writes parts to a file in a new folder, which is removed again if that fails."""
    limit = cache_limit()
    free = shutil.disk_usage(folder).free
    max_bytes = min(limit, free)
    medium = "the cache (GVTORCH_CACHE_GB)" if limit < free else "the disk"
    if size is not None and size > max_bytes:
        raise OSError(f"{url}: is {amount(size)}, {medium} has room for {amount(max_bytes)}")
    target = Path(tempfile.mkdtemp(prefix=".part-", dir=folder))
    try:
        file, received = target / _file_name(url), 0
        with file.open("wb") as out:
            for part in parts:
                received += len(part)
                if received > max_bytes:
                    raise OSError(f"{url}: is more than {amount(max_bytes)}, the room in {medium}")
                out.write(part)
        if size is not None and received != size:
            raise OSError(f"{url}: is cut off: {received} of {size} bytes came")
    except BaseException:
        shutil.rmtree(target, ignore_errors=True)
        raise
    return file


def _read_parts(
    url: str, stream: IO[bytes], response: TimedResponse | None = None
) -> Generator[bytes, None, None]:
    """Yields the parts of a stream; raises OSError if it is cut off, or if the `response` that it
    comes from takes longer than `_PART_SECONDS` for one.
    """
    with closing(stream):
        while True:
            if response is not None:
                response.read_until(time.monotonic() + _PART_SECONDS)
            try:
                part = stream.read(_PART_BYTES)
            except Exception as error:  # http.client and fsspec have exceptions of their own
                raise OSError(f"{url}: is cut off: {_reason(error)}") from None
            if not part:
                return
            yield part


def _evict(newest: Path) -> None:
    """Removes the least recently used versions until the rest fits into the cache."""
    versions: list[tuple[float, int, Path]] = []
    for folder in newest.parent.parent.glob("*/*"):
        if folder.is_dir():
            try:
                size = sum(file.stat().st_size for file in folder.iterdir())
                versions.append((folder.stat().st_mtime, size, folder))
            except OSError:
                continue  # another process removes it
    total, limit = sum(size for _, size, _ in versions), cache_limit()
    for _, size, folder in sorted(versions):
        if total <= limit:
            break
        if folder != newest:
            shutil.rmtree(folder, ignore_errors=True)
            total -= size


def _reason(error: Any) -> str:
    return one_line(getattr(error, "reason", None) or error)[:300]
