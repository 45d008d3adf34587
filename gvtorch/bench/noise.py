"""Noise at points, compared with its twin, NumPy and noise libraries: `noise`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from ..fields import noise as gv_noise
from ..ops import noise as noise_op
from .record import Record, clock

_CHUNK = 1 << 13  # points at a time, so that NumPy's temporaries stay in the caches


def noise(record: Record) -> None:
    """Evaluates noise at random points in a cube of 100 cells a side."""
    settings = record.settings
    count = {"cpu": 1 << 20, "cuda": 1 << 25}[settings.device.type] >> (8 * settings.quick)
    points = 100 * torch.rand((count, 3), generator=torch.Generator().manual_seed(5), device="cpu")
    case = f"{count:,} points"
    if record.wants(case):
        _measure_perlin(record, case, points)
    functions: dict[str, Callable[..., Any]] = {
        **{"value": gv_noise.value, "simplex": gv_noise.simplex, "cellular": gv_noise.cellular},
        **{"6 octaves": gv_noise.fbm},
    }
    for name, function in functions.items():
        case = f"{count:,} points, {name}"
        if record.wants(case):
            _add(record, case, "op", count, partial(function, points.to(settings.device)))


def _measure_perlin(record: Record, case: str, points: torch.Tensor) -> None:
    """Measures all at the same points; peers hash differently, so values can't be compared."""
    device = record.settings.device
    on_device, in_numpy = points.to(device), points.numpy()
    _add(record, case, "op", len(points), lambda: gv_noise.perlin(on_device))
    twin = partial(noise_op, kind="perlin", backend="reference")
    deviation = float((twin(on_device) - gv_noise.perlin(on_device)).abs().max())
    _add(record, case, "twin", len(points), lambda: twin(on_device), max_difference=deviation)
    compiled = record.compiled("twin", lambda: twin(on_device), fullgraph=True)
    if compiled is not None:
        _add(record, case, "twin, compiled", len(points), compiled)
    if device.type == "cuda":
        return
    table = np.tile(np.random.default_rng(0).permutation(256), 3)

    def in_chunks() -> None:
        for begin in range(0, len(in_numpy), _CHUNK):
            perlin_numpy(in_numpy[begin : begin + _CHUNK], table)

    _add(record, case, "NumPy", len(points), in_chunks)
    for who, make in (("pyfastnoiselite", _fastnoiselite), ("pyfastnoisesimd", _fastnoisesimd)):
        if record.has_peer(who):
            _add(record, case, who, len(points), make(in_numpy))
    record.note("the pyfast... libraries are C++ without torch; they and NumPy run on one thread")


def perlin_numpy(points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Returns improved noise at (n, 3) points as in the paper, by a permutation table, 3 * 256."""
    cell = np.floor(points).astype(np.int64)
    offset = points - cell
    x, y, z = (cell & 255).T
    fades = (offset**3 * (offset * (offset * 6 - 15) + 10)).T
    values = []
    for corner in range(8):
        step = [corner >> axis & 1 for axis in range(3)]
        bits = table[table[table[x + step[0]] + y + step[1]] + z + step[2]] & 15
        dx, dy, dz = (offset - step).T
        first = np.where(bits < 8, dx, dy)
        second = np.where(bits < 4, dy, np.where((bits == 12) | (bits == 14), dx, dz))
        values.append(np.where(bits & 1, -first, first) + np.where(bits & 2, -second, second))
    for fade in fades:
        pairs = zip(values[::2], values[1::2], strict=True)
        values = [low + fade * (high - low) for low, high in pairs]
    return values[0]


def _fastnoiselite(points: np.ndarray) -> Callable[[], object]:
    from pyfastnoiselite.pyfastnoiselite import FastNoiseLite, NoiseType

    generator, coordinates = FastNoiseLite(1), np.ascontiguousarray(points.T)
    generator.noise_type, generator.frequency = NoiseType.NoiseType_Perlin, 1.0
    return lambda: generator.gen_from_coords(coordinates)


def _fastnoisesimd(points: np.ndarray) -> Callable[[], object]:
    import pyfastnoisesimd

    generator = pyfastnoisesimd.Noise(seed=1, numWorkers=1)
    generator.noiseType, generator.frequency = pyfastnoisesimd.NoiseType.Perlin, 1.0
    coordinates = pyfastnoisesimd.empty_coords(len(points))
    coordinates[:3, : len(points)] = points.T
    return lambda: generator.genFromCoords(coordinates)


def _add(
    record: Record, case: str, who: str, count: int, run: Callable[[], object], **figures: Any
) -> None:
    timing = clock(run, record.settings)
    rates = {"values_per_second": 1e3 * count / timing.median}
    record.add(case, who, timing, **rates, **record.relative_to_first(case, timing), **figures)
