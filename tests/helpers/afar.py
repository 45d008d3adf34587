"""Volumes to be seen from afar, and their pictures, to compare with many fine rays a pixel."""

from __future__ import annotations

import math

import torch

import gvtorch as gv
from helpers.rays import camera_rays
from helpers.traces import assert_equal
from helpers.trees import with_holes


def matter(spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> gv.Volume:
    """Returns a volume of rough and smooth values, with a region of zeros and a constant one."""
    generator = torch.Generator().manual_seed(4)
    coarse = torch.rand((1, 1, 12, 12, 12), generator=generator)
    value = torch.nn.functional.interpolate(coarse, size=(37, 33, 41), mode="trilinear")[0, 0]
    value = value + 0.2 * torch.rand(value.shape, generator=generator)
    value[:14], value[:, 24:, :20] = 0.0, 0.35
    return gv.Volume(value, spacing)


def filtered(
    shader: gv.TransferFunction | gv.Lit, branching: int = 2, **options
) -> tuple[gv.N3Tree, gv.Filtered]:
    """Returns `matter` as a tree, and its `Filtered` shader; takes the options of both."""
    volume = matter(**{name: options.pop(name) for name in ("spacing",) if name in options})
    tree = gv.N3Tree.from_volume(volume, 4, branching=branching, threshold=0.0)
    return tree, gv.Filtered.of(tree, volume, shader, **options)


def assert_same_bits(
    tree: gv.N3Tree, backend: str, distance: float, shader: gv.Shader, **options
) -> dict[str, torch.Tensor]:
    """Asserts that a backend's hits from a distance equal the twin's, in the tree and in a copy
    with holes; in float32 on the CPU in every bit. Returns the twin's hits of the copy.
    """
    rays = camera_rays(tree, 14, distance=distance)
    for traced_tree in (tree, with_holes(tree, 0.3, 5)):
        expected, _, actual = assert_equal(traced_tree, backend, rays, shader, **options)
        if backend == "cpp" and options["dtype"] == torch.float32:
            for field in {"color", "alpha", "depth", "normal"} & {*expected}:
                assert torch.equal(actual[field], expected[field]), field
    return expected


def walls() -> gv.Volume:
    """Returns walls 1.5 voxels thick, upright and slanted, a thread, and a ball of noise."""
    n = 96
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32),) * 3, indexing="ij")
    inside = (x > 15) & (x < 60) & (y > 15) & (y < 80) & (z > 15) & (z < 80)
    value = (1.25 - (0.6 * x + 0.2 * y + 0.7746 * z - 50).abs()).clamp(0, 1) * inside
    wall = (1.25 - (x - 72.6).abs()).clamp(0, 1) * ((z > 20) & (z < 75) & (y > 50) & (y < 85))
    thread = (1.6 - torch.hypot(x - 65 + 0.2 * (z - 48), y - 25)).clamp(0, 1) * ((z > 8) & (z < 85))
    noise = torch.rand(x.shape, generator=torch.Generator().manual_seed(1))
    ball = noise * ((x - 30) ** 2 + (y - 66) ** 2 + (z - 70) ** 2 < 18**2)
    return gv.Volume(torch.stack((value, wall, thread, ball)).amax(0))


def rays(origin: torch.Tensor, direction: torch.Tensor, cone: torch.Tensor) -> gv.Rays:
    """Returns rays with a range of [0, 1e9]."""
    limits = torch.tensor([[0.0, 1e9]], dtype=torch.float64).expand(len(origin), 2)
    fields = (column.contiguous() for column in (origin, direction, cone, limits))
    return gv.Rays(**dict(zip(("origin", "direction", "cone", "range"), fields, strict=True)))


def parallel(
    tree: gv.N3Tree, direction: tuple[float, float, float], pixel: float, parts: int
) -> gv.Rays:
    """Returns orthographic rays through a whole tree: parts^2 a pixel, each as wide as a part."""
    forward = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).double(), forward), dim=0
    )
    up = torch.linalg.cross(forward, right)
    reach = float((tree.box[1] - tree.box[0]).norm()) / 2
    count = math.ceil(2 * reach / pixel)
    offsets = ((torch.arange(count * parts, dtype=torch.float64) + 0.5) / parts - count / 2) * pixel
    y, x = torch.meshgrid(offsets + 0.37, offsets + 0.61, indexing="ij")
    origin = tree.box.mean(0) + x.reshape(-1, 1) * right + y.reshape(-1, 1) * up
    origin = origin - 2 * reach * forward
    cone = torch.tensor([pixel / parts, 0.0], dtype=torch.float64).repeat(len(origin), 1)
    return rays(origin, forward.expand(len(origin), 3), cone)


def picture(
    tree: gv.N3Tree,
    shader: gv.Shader,
    direction: tuple[float, float, float],
    pixel: float,
    parts: int = 1,
    lod: str = "auto",
) -> torch.Tensor:
    """Returns (h, w, 4): the means over the parts^2 rays of each pixel."""
    batch = parallel(tree, direction, pixel, parts)
    hits = gv.trace(tree, batch, shader, lod=lod)
    side = math.isqrt(len(batch.origin)) // parts
    colors = torch.cat((hits.color, hits.alpha), 1).double()
    return colors.reshape(side, parts, side, parts, 4).mean((1, 3))


def compare(actual: torch.Tensor, truth: torch.Tensor) -> tuple[float, float]:
    """Returns light relative to the truth's, and PSNR over pixels that show something."""
    visible = (truth[..., 3] > 1e-3) | (actual[..., 3] > 1e-3)
    error = float((actual - truth)[..., :3][visible].square().mean())
    return float(actual[..., :3].mean() / truth[..., :3].mean()), -10 * math.log10(error)
