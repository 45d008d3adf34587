"""`Hypertexture`: noise around the surface of a shape, made where rays ask for it.

Sources: Perlin, Hoffert, "Hypertexture", SIGGRAPH 1989 (density functions around a soft surface);
    the GigaVoxels presentation at AFIG 2012 (the formula, and stopping at the octave after which
    nothing can change). The filtering of voxels is ours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..base import check
from ..base.check import extent_in
from ..fields import Distance, noise
from ..fields.noise.fractal import EvaluationCounter, Octave, octaves_of
from ..pool import Channel
from .field import distances_of, group_alike, interval_of, moving_nodes, position_dtype
from .producer import Layout, Nodes, Producer, Region, Regions, by_depth, check_points

_MAX_CELLS = 1.5  # cells along a voxel; beyond, a voxel's mean is computed without the octave
_ROUNDING = 1e-4  # most that rounding may add to a sum of octaves, in units of the amplitude


class LevelOctaves(NamedTuple):
    """Parameters from which the voxels of a level are made."""

    octaves: list[Octave]  # with the amplitudes that are left in the means over voxels
    remaining: list[float]  # [i]: upper bound of what octave i and all after it can add
    half_width: float  # half the width of the step from 0 to 1
    side: float  # of a voxel, world units


class Hypertexture(EvaluationCounter, Producer):
    """Density around a shape's surface:

        density = smoothstep(1/2 - softness, 1/2 + softness)(s),
        s = -distance / thickness + amplitude * noise(frequency * position),

    where noise is a sum of octaves. In each brick, summation ends as soon as density is 0 or 1 in
    all voxels whatever the remaining octaves add; this changes no bit. Regions where the distance
    alone proves density 0, or 1 without a channel "distance", are never made.

    A voxel is about the mean over its cube. Each octave is weighted by the share of it that is left
    in this mean. The variance that averaging removes, of noise and of the distance, widens the step
    from 0 to 1: the smoothstep used has the total variance.

    Channels are "density", and "distance" if asked for: that of the shape, in world units, which
    can be coloured by a transfer function (`Isosurface(0.5, colors, color_channel="distance")`).

    Attributes:
        plain_evaluations: Evaluations, octaves times voxels, that a plain sum would have needed so
            far.
        evaluations: Evaluations that were actually made.
        skip: Whether octaves are left out; may be changed at any time.
    """

    on_host = True

    def __init__(
        self,
        shape: Distance,
        extent: int | Sequence[int] = 1024,
        *,
        thickness: float,
        amplitude: float = 1.0,
        frequency: float = 1.0,
        octaves: int = 6,
        lacunarity: float = 2.0,
        gain: float = 0.5,
        softness: float = 0.1,
        seed: int = 0,
        distances: bool = False,
        skip: bool = True,
        box: Sequence[Sequence[float]] | None = None,
        dtype: torch.dtype = torch.float16,
        branching: int = 2,
    ) -> None:
        """Sets the shape, and the noise around it.

        Args:
            shape: Any distance field; one that changes by more than 1 per unit must declare it.
            extent: Voxels of the finest level, (x, y, z), or along the longest side of the box.
            thickness: World units by which the surface moves where s changes by 1.
            amplitude: Of the first octave, in s.
            frequency: Cells of the first octave per world unit.
            octaves, lacunarity, gain, seed: As in `noise.fbm`.
            softness: Half the width of the step from 0 to 1, in s.
            distances: Whether there is a channel "distance".
            skip: Whether octaves that can't matter are left out.
            box: World corners; left out: around the shape and the most that noise adds to it.
            dtype: Of the channels: float16, bfloat16 or float32.
            branching: N.

        Raises:
            ValueError: A number is out of range, the dtype is another, or the box is unknown.
        """
        context = type(self).__name__
        check.instance(context, "shape", shape, Distance)
        thickness = check.number(context, "thickness", thickness, low=0, open_low=True)
        amplitude = check.number(context, "amplitude", amplitude, low=0)
        softness = check.number(context, "softness", softness, low=0, open_low=True)
        series = octaves_of(context, octaves, lacunarity, gain, seed, frequency)
        peak = amplitude * sum(o.amplitude for o in series) * noise.bounds(noise.perlin).high
        max_offset = thickness * max(peak + softness - 0.5, 0.0)
        if box is None:
            around = shape.level_box(max_offset)
            if around is None or not bool(around.isfinite().all()):
                raise ValueError(
                    f"{context}: box must be given: the shape does not say where it ends"
                )
            box = around.tolist()
        extent = extent_in(context, extent, box)
        check.float_dtype(context, dtype)
        channels = {"density": Channel(dtype)}
        if distances:
            channels["distance"] = Channel(dtype)
        super().__init__(
            extent,
            channels=channels,
            box=box,
            branching=branching,
            value_range={"density": (0.0, 1.0)},
        )
        self.shape, self.skip, self.thickness, self.softness = shape, skip, thickness, softness
        self.octaves = [o._replace(amplitude=amplitude * o.amplitude) for o in series]
        self.dtype = position_dtype(box, self.spacing)
        self._levels: list[LevelOctaves] = []
        self._margins = torch.empty(0, device="cpu")

    @property
    def saved(self) -> float:
        """The share of octaves that were not evaluated, 0 to 1."""
        return 1 - self.evaluations / max(self.plain_evaluations, 1)

    def prepare(self, layout: Layout) -> None:
        """Computes the parameters of each level."""
        sides = [max(layout.spacing) * layout.branching**n for n in range(layout.depth, -1, -1)]
        self._levels = [self._level(side) for side in sides]
        margins = [level.remaining[0] + level.half_width for level in self._levels]
        # A node's region must also be true of all finer nodes below it.
        margins_below = [max(margins[depth:]) for depth in range(len(margins))]
        self._margins = torch.tensor(margins_below, dtype=torch.float64, device=layout.device)

    def level_of(self, depth: int) -> LevelOctaves:
        """Returns the parameters of the voxels of a depth; known once an engine uses this."""
        return self._levels[depth]

    def _level(self, side: float) -> LevelOctaves:
        """Returns the parameters of voxels with a side in world units."""
        weighted, variance = [], self.softness**2 / 5 + (side / self.thickness) ** 2 / 12
        for octave in self.octaves:
            cells = side * octave.frequency
            weight = math.exp(-noise.MEAN_DECAY * cells * cells) if cells <= _MAX_CELLS else 0.0
            variance += octave.amplitude**2 * noise.VARIANCE * (1 - weight * weight)
            if weight:
                weighted.append(octave._replace(amplitude=octave.amplitude * weight))
        high = noise.bounds(noise.perlin).high
        amplitudes = [octave.amplitude for octave in weighted]
        remaining = [high * sum(amplitudes[n:]) for n in range(len(amplitudes) + 1)]
        margin = _ROUNDING * max(1.0, *remaining)
        remaining = [bound + margin for bound in remaining]
        return LevelOctaves(weighted, remaining, math.sqrt(5 * variance), side)

    def at(self, points: Tensor) -> dict[str, Tensor]:
        """Returns the channels (..., 1) at points (..., 3), of the points' dtype, not filtered."""
        check_points(f"{type(self).__name__}.at", points, floats=True)
        if points.dim() == 1:  # () values would be promoted to the dtype of the field's numbers
            return {name: values[0] for name, values in self.at(points[None]).items()}
        distance = distances_of(type(self).__name__, self.shape, points)
        total = distance * (-1 / self.thickness)
        for octave in self.octaves:
            octave_noise = noise.perlin(points * octave.frequency, seed=octave.seed)
            total = total + octave.amplitude * octave_noise
        return self._channels(total, distance, self.softness)

    def classify(self, nodes: Nodes) -> Regions:
        """Returns EMPTY where density is proven 0 for any noise, CONSTANT where it is proven 1 and
        there is no channel "distance", else DATA.
        """
        ends = self.shape.bounds(nodes.center, nodes.half_extent(0))
        low, high = (end[:, 0] for end in interval_of(self.shape, "value", ends, len(nodes), 1))
        margin = self._margins.to(low.device)[nodes.depth]
        kind = torch.full_like(nodes.depth, Region.DATA)
        if "distance" not in self.channels:
            full = -high / self.thickness - margin >= 0.5
            kind = torch.where(full, Region.CONSTANT, kind)
        kind = torch.where(-low / self.thickness + margin <= 0.5, Region.EMPTY, kind)
        is_full = (kind == Region.CONSTANT)[:, None].to(self.channels["density"].dtype)
        return Regions(kind=kind, constants={"density": is_full})

    def differs(self, nodes: Nodes, before: float, after: float) -> Tensor:
        """Returns the nodes in which a part of the shape with a time matters at either time."""
        return moving_nodes(self, self.shape, nodes, 0, (before, after))

    def fill(self, nodes: Nodes) -> dict[str, Tensor]:
        """Makes the bricks, level by level, batched by which parts of the shape matter in them."""
        side = nodes.layout.side
        shape = (len(nodes), side, side, side, 1)
        device = nodes.loc.device
        data = {
            name: torch.empty(shape, dtype=channel.dtype, device=device)
            for name, channel in self.channels.items()
        }
        for depth, level_rows in by_depth(nodes.loc):
            for rows, reduced in group_alike(self.shape, nodes[level_rows], 0):
                channels = self._evaluate(nodes[level_rows[rows]], self.level_of(depth), reduced)
                for name, values in channels.items():
                    channel = self.channels[name]
                    stored = values.clamp(*channel.limits).to(channel.dtype)
                    data[name][level_rows[rows]] = stored
        return data

    def _evaluate(self, nodes: Nodes, level: LevelOctaves, shape: nn.Module) -> dict[str, Tensor]:
        """Returns channels (k, z, y, x, 1) of nodes of a level; `shape` may be a reduced one."""
        points = nodes.points(self.dtype)
        distance = distances_of(type(self).__name__, shape, points)
        total = distance * (-1 / self.thickness)
        active = torch.arange(len(nodes), device=total.device)
        values = total.clone()
        self._count(plain_evaluations=total.numel() * len(level.octaves))
        for index, octave in enumerate(level.octaves):
            if self.skip:
                edge_distance = (values - 0.5).abs().flatten(1).amin(1)
                needed = (edge_distance < level.half_width + level.remaining[index]).nonzero()[:, 0]
                if len(needed) < len(active):
                    total[active] = values
                    active, values, points = active[needed], values[needed], points[needed]
            if not len(active):
                break
            self._count(evaluations=values.numel())
            octave_noise = noise.perlin(points * octave.frequency, seed=octave.seed)
            values = values + octave.amplitude * octave_noise
        total[active] = values
        return self._channels(total, distance, level.half_width)

    def _channels(self, total: Tensor, distance: Tensor, half_width: float) -> dict[str, Tensor]:
        """Returns the channels (..., 1), computed from s and distances (...)."""
        t = ((total - (0.5 - half_width)) / (2 * half_width)).clamp(0, 1)
        channels = {"density": t * t * (3 - 2 * t), "distance": distance}
        return {name: channels[name][..., None] for name in self.channels}
