"""`read_http`: a small file behind http or https, read within bounds of size and time whatever the
server does: tensorstore takes what comes, without an end where there is none.
"""

from __future__ import annotations

import time
import urllib.error
import urllib.request

_PART = 1 << 16  # bytes


def is_http(root: object) -> bool:
    """Tells such a folder from others."""
    return isinstance(root, str) and root.startswith(("http://", "https://"))


def read_http(url: str, seconds: float, most: int, part: slice | None = None) -> bytes | None:
    """Returns the content of a file, or a part of its bytes, which may count from its end; None if
    there is no such file.

    Raises:
        TimeoutError: It took longer.
        ValueError: It is more than `most` bytes.
        OSError: The server can't be reached, or answers with an error.
    """
    end = time.monotonic() + seconds
    request = urllib.request.Request(url, headers={"Accept-Encoding": "identity"})
    if part is not None:
        first, last = part.start, part.stop
        wanted = f"{first or 0}-{last - 1}" if last is not None else f"{first}-"
        request.add_header("Range", f"bytes={wanted if (first or 0) >= 0 else first}")
    try:
        answer = urllib.request.urlopen(request, timeout=max(1e-3, seconds))
    except urllib.error.HTTPError as error:
        error.close()
        if error.code in (404, 410):
            return None
        raise OSError(f"{error.code} {error.reason}") from None
    except urllib.error.URLError as error:
        if isinstance(error.reason, TimeoutError):
            raise TimeoutError from None
        raise OSError(str(error.reason)) from None
    with answer:
        content, whole = bytearray(), part is not None and answer.status != 206
        while True:
            if time.monotonic() > end:
                raise TimeoutError
            try:
                more = answer.read1(_PART)
            except TimeoutError:
                raise
            except Exception as error:  # of http.client
                raise OSError(" ".join(str(error).split()) or type(error).__name__) from None
            if not more:
                break
            content += more
            if len(content) > most:
                raise ValueError(f"more than {most} bytes")
    return bytes(content[part] if whole and part is not None else content)
