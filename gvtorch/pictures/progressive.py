"""`Progressive`: pictures of a camera at rest that get better from frame to frame.

The first frame samples the centres of the pixels, each later one another place in every pixel: a
point of Roberts' R2 sequence and, in the next frame, its mirror image through the centre. So
samples cover a pixel evenly after any number of frames, and what varies linearly across it cancels
out (antithetic sampling). The mean of the frames converges to the picture under a box filter.

Source: Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.records import Rays
from ..base.stage import Progress, no_progress
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from .picture import Picture

_OF_CENTRES = ("depth", "nearest", "normal", "features")  # the first frame's are kept
_PLASTIC = 1.32471795724474602596  # the real root of x^3 = x + 1


def jitter(index: int) -> tuple[float, float]:
    """Returns the place (x, y) of a sample in its pixel, [-1/2, 1/2] from the centre."""
    pair, side = (index + 1) // 2, 1 if index % 2 else -1
    x, y = (side * ((0.5 + pair / _PLASTIC**power) % 1 - 0.5) for power in (1, 2))
    return x, y


class Progressive:
    """The running mean of jittered frames; does not wait for the device.

    A pixel's mean begins with its first frame without a miss, and leaves out later frames with one.
    Until then the pixel shows the newest frame.

    Attributes:
        count: Frames since the camera moved.
    """

    def __init__(self, render: Callable[[Camera], Any]) -> None:
        """Takes a function from a camera to a `Picture`, or to one and its statistics, such as
        `partial(gv.render, tree, shader=shader)`, `partial(engine.frame, shader=shader)` or the
        `replay` of a graph.
        """
        if not callable(render):
            raise ValueError(f"Progressive: render must be callable, got {type(render).__name__}")
        self._render = render
        self.reset()

    def __repr__(self) -> str:
        """Tells camera and frames."""
        return f"Progressive({self._camera}, {self.count} frames)"

    def reset(self) -> None:
        """Starts a new mean; to be called when the scene or its shader changed."""
        self.count = 0
        self._given: Camera | Rays | None = None
        self._camera: Camera | None = None

    def frame(self, camera: Camera | Rays) -> Picture:
        """Renders one more frame, the first of a new mean if the camera moved.

        Returns:
            The mean of colour and alpha so far, summed up in float64; depth, nearest, normal and
            features are those of the pixels' centres where nothing was missing, `samples` and
            `stats` those of this frame, and `missed` tells which pixels have seen no frame without
            a miss. The first is the plain picture to the last bit.
        """
        if self._camera is None or camera is not self._given:
            own = as_camera("Progressive", camera)
            if self._camera is None or not own.same(self._camera):
                self.reset()
            self._given, self._camera = camera, own
        view = self._camera
        made = self._render(view.shifted(*jitter(self.count)) if self.count else view)
        picture: Picture = made[0] if isinstance(made, tuple) else made
        light = torch.cat((picture.color, picture.alpha), -1).double()
        missed = picture.missed
        whole = torch.ones_like(picture.alpha, dtype=torch.bool) if missed is None else ~missed
        named = {name: getattr(picture, name) for name in _OF_CENTRES}
        still = {name: image for name, image in named.items() if image is not None}
        if not self.count:
            self._sum, self._frames = light, whole.double()
            self._still = {name: image.clone() for name, image in still.items()}
        else:
            seen = self._frames > 0
            # A pixel without a whole frame yet shows the newest one; others add whole frames only.
            self._sum = torch.where(seen, torch.where(whole, self._sum + light, self._sum), light)
            for name, image in still.items():
                self._still[name] = torch.where(seen, self._still[name], image)
            self._frames = self._frames + whole
        self.count += 1
        color, alpha = self._mean(picture.color.dtype)
        missed = self._frames == 0
        return replace(picture, color=color, alpha=alpha, missed=missed, **self._still)

    def refine(
        self, camera: Camera | Rays, samples: int, progress: Progress = no_progress
    ) -> Picture:
        """Returns the mean of `samples` frames, of which those that were rendered of this camera
        before count.

        Raises:
            ValueError: `samples` is no whole number >= 1.
        """
        most = check.whole("Progressive", "samples", samples, low=1)
        camera = as_camera("Progressive", camera)
        while True:
            picture = self.frame(camera)
            progress("samples", self.count, most)
            if self.count >= most:
                return picture

    def _mean(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        mean = (self._sum / self._frames.clamp(min=1)).to(dtype)
        return mean[..., :3], mean[..., 3:]
