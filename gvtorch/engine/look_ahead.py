"""`LookAhead`: rays of the pictures to come, which ask for what these would miss.

Their number is a sixteenth of the picture's, one for 4 x 4 pixels: a brick is wider than that on
the screen. Their camera is the picture's, moved on as it moved since the frame before. What they
use counts as used, so that it stays; what they ask for is served behind what the picture asks for.
On a GPU they take as long as their longest ray, not a sixteenth of the picture's time, so they go
every few frames only, the more rarely the farther they look.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ..base.records import Hits
from ..cameras import Camera
from ..tracing.pixels import View

_STRIDE = 4  # pixels from ray to ray
_RAREST = 4  # most frames from one look ahead to the next
_LOOKS = 4  # until a place that they saw is there: a tree deepens by a level for each


class LookAhead:
    """The rays ahead of a camera whose numbers lie in one place, `View.numbers`.

    Attributes:
        due: Whether they go in this frame: the camera moves, and it is their turn.
    """

    def __init__(self, view: View, frames: float) -> None:
        """Looks some `frames` ahead of a picture's view."""
        self._now, self._camera, self._frames = view.numbers, view.camera, frames
        self._before, self._last = self._now.clone(), view.camera
        self._every = max(1, min(_RAREST, int(frames / _LOOKS)))
        self._moves, self.due = 0, False
        options = replace(view.options, layer=None)
        thinned = view.camera.thinned(_STRIDE)
        self._view = replace(view, camera=thinned, numbers=self._numbers(), options=options)

    def follow(self, camera: Camera, numbers: Tensor, stale: bool) -> None:
        """Takes the camera of the next picture, in the world, and its numbers, before these are put
        where the picture reads them. `stale`: other frames were rendered since the last one.
        """
        self._before.copy_(numbers if stale else self._now)
        moves = not (stale or camera.same(self._last))
        self.due, self._last = moves and self._moves % self._every == 0, camera
        self._moves += moves

    def hits(self) -> Hits:
        """Traces; only what the rays used and asked for matters."""
        self._view.numbers.copy_(self._numbers())
        return self._view.hits()

    def _numbers(self) -> Tensor:
        return self._camera.numbers_ahead(self._now, self._before, self._frames, _STRIDE)
