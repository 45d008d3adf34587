"""`EngineOptions`: how an engine keeps its scene, checked once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypedDict

import torch

from ..base import check


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """How the engine keeps its scene."""

    node_pool: int | str = "8 MB"  # bytes of node words, constants and ranges
    brick_pool: int | str = "256 MB"  # bytes of voxels
    device: torch.device | str = "cpu"
    brick_size: int = 8  # voxels along a side, without the border
    border: int = 1  # voxels around a brick; from 1 on no seam shows
    loading: Literal["straight", "levels"] = "straight"  # to the wanted level, or one by one
    order: Literal["coarse", "fine"] = "coarse"  # which levels are served first
    load_budget: int = 4096  # most bricks a frame
    subdivide_budget: int = 4096  # most node tiles a frame
    time_budget: float | None = None  # most milliseconds of production a frame
    scout_rounds: int = 2  # rounds of a sixteenth of the rays before a frame that missed something
    patience: float = 120.0  # seconds until an answer that does not come is given up
    strict: bool = False  # raise when something can't be produced
    monitor: bool = True  # time the stages and remember the last frames, for `report`

    def __post_init__(self) -> None:
        """Checks what the pools do not check themselves."""
        if self.loading not in ("straight", "levels"):
            raise ValueError(
                f"Engine: loading must be 'straight' or 'levels', got {self.loading!r}"
            )
        if self.order not in ("coarse", "fine"):
            raise ValueError(f"Engine: order must be 'coarse' or 'fine', got {self.order!r}")
        check.number("Engine", "patience", self.patience, low=0, open_low=True)
        if self.time_budget is not None:
            check.number("Engine", "time_budget", self.time_budget, low=0, open_low=True)
        for name in ("load_budget", "subdivide_budget"):
            check.whole("Engine", name, getattr(self, name), low=1)
        check.whole("Engine", "scout_rounds", self.scout_rounds, low=0)
        for name in ("strict", "monitor"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"Engine: {name} must be bool, got {getattr(self, name)!r}")


class EngineSettings(TypedDict, total=False):
    """The fields of `EngineOptions` as keyword arguments of `Engine`, for editors."""

    node_pool: int | str
    brick_pool: int | str
    device: torch.device | str
    brick_size: int
    border: int
    loading: Literal["straight", "levels"]
    order: Literal["coarse", "fine"]
    load_budget: int
    subdivide_budget: int
    time_budget: float | None
    scout_rounds: int
    patience: float
    strict: bool
    monitor: bool
