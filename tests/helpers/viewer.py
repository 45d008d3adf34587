"""Pages without a browser, which store what a view sends, for tests to inspect."""

from __future__ import annotations

import io
import json
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import gvtorch as gv
from gvtorch.viewer.session import Session

TIMEOUT = 300.0  # time limit in seconds for an answer, on the slowest machine


class Page:
    """Joins a session, stores what it sends, and acknowledges pictures as a browser does."""

    def __init__(self, session: Session, width: int = 64, height: int = 48, acks: bool = True):
        self.session, self.acks = session, acks
        self.messages: list[dict[str, Any]] = []
        self.pictures: list[tuple[dict[str, Any], bytes]] = []
        self.files: dict[str, bytes] = {}
        self._arrived = threading.Condition()
        self.client = session.join(self._take)
        self.send("hello", width=width, height=height)

    def _take(self, data: str | bytes) -> None:
        with self._arrived:
            if isinstance(data, str):
                self.messages.append(json.loads(data))
            else:
                head, picture = split(data)
                if "file" in head:
                    self.files[head["file"]] = picture
                else:
                    self.pictures.append((head, picture))
            self._arrived.notify_all()
        if isinstance(data, bytes) and self.acks and "number" in head:
            self.send("ack", number=head["number"])

    def send(self, kind: str, **content: Any) -> None:
        self.session.receive(self.client, json.dumps({"type": kind, **content}))

    def until(self, condition: Callable[[], Any], timeout: float = TIMEOUT) -> Any:
        """Waits until something is true, and returns it."""
        end = time.monotonic() + timeout
        with self._arrived:
            while not (result := condition()):
                left = end - time.monotonic()
                assert left > 0, f"it never came; messages {self.messages[-3:]}"
                self._arrived.wait(min(left, 0.2))
        return result

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        return [message for message in self.messages if message["type"] == kind]

    def next(self, kind: str, after: int | None = None) -> dict[str, Any]:
        """Waits for the next message of a type after the first `after`; returns it."""
        count = len(self.of_type(kind)) if after is None else after
        self.until(lambda: len(self.of_type(kind)) > count)
        return self.of_type(kind)[count]

    def final(self, timeout: float = TIMEOUT) -> tuple[dict[str, Any], np.ndarray]:
        """Waits for the final picture; returns its head and (h, w, 3) uint8."""
        self.until(lambda: self.pictures and self.pictures[-1][0]["final"], timeout)
        head, data = self.pictures[-1]
        return head, pixels(data)

    def moved(
        self, camera: dict[str, Any], moving: bool = False
    ) -> tuple[dict[str, Any], np.ndarray]:
        """Moves the camera and waits for the final picture from there."""
        self.send("move", camera=camera, moving=moving)
        eye = camera["eye"]
        self.until(
            lambda: self.pictures and np.allclose(self.pictures[-1][0]["camera"]["eye"], eye)
        )
        return self.final()

    @property
    def camera(self) -> dict[str, Any]:
        self.until(lambda: self.of_type("welcome"))
        return {
            n: v for n, v in self.of_type("welcome")[0]["state"]["camera"].items() if n != "kind"
        }


def split(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Returns the head of a picture's message, and the picture."""
    (size,) = struct.unpack("<I", data[:4])
    return json.loads(data[4 : 4 + size]), data[4 + size :]


def pixels(data: bytes) -> np.ndarray:
    """Returns (h, w, 3) of a JPEG or PNG."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def bright_ball(n: int = 40) -> gv.Volume:
    """Returns a ball away from the middle, so that turning it is visible."""
    z, y, x = np.mgrid[0:n, 0:n, 0:n].astype(np.float32) / n - 0.5
    ball = np.clip(1 - 4 * np.sqrt((x - 0.15) ** 2 + y**2 + (z + 0.1) ** 2), 0, 1)
    return gv.Volume((255 * ball).astype(np.uint8))


FUNCTION = gv.TransferFunction([(20, 0), (200, 0.6)], [(0, 1, 0.4, 0.1), (255, 1, 1, 1)])
BANDS = gv.TransferFunction(
    [(20, 0), (120, 0.3), (200, 0.6)], [(0, 1, 0.4, 0.1), (130, 0.2, 0.5, 1), (255, 1, 1, 1)]
)


def turned_camera(camera: dict, angle: float) -> dict:
    """Returns the camera, turned around its target about +y."""
    offset = np.subtract(camera["eye"], camera["target"])
    c, s = np.cos(angle), np.sin(angle)
    offset = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ offset
    return {**camera, "eye": (offset + camera["target"]).tolist()}


class Grown(torch.nn.Module):
    """A ball whose radius is `time`."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("time", torch.tensor(3.0))

    def forward(self, points):
        return (points.norm(dim=-1, keepdim=True) < self.time).float()
