"""A sphere that is computed, not stored: your own producer, and its picture.

65,536^3 voxels would take 1,100 TB; the picture needs a few MB of them.
"""

import torch
import tyro

import gvtorch as gv

RADIUS, BANDS = 0.9, torch.tensor([6.0, 28.0, 4.0])


class Sphere(gv.Producer):
    """Bands of density 0.4 to 1 inside the radius, with a rim one voxel wide."""

    def classify(self, nodes):
        outside = nodes.center.norm(dim=1) - nodes.radius > RADIUS
        return torch.where(outside, gv.Region.EMPTY, gv.Region.DATA)

    def fill(self, nodes):
        gap = RADIUS - nodes.positions.norm(dim=-1, keepdim=True)
        inside = (0.5 + gap / nodes.voxel_size.float()[:, None, None, None, :1]).clamp(0, 1)
        bands = (nodes.positions * BANDS.to(gap)).sum(-1, keepdim=True).sin()
        return {"value": inside * (0.7 + 0.3 * bands)}


def main(output: str = "hello_sphere.png", device: str = "cpu", size: int = 400) -> None:
    """Renders the sphere."""
    engine = gv.Engine(Sphere(65536, box=((-1, -1, -1), (1, 1, 1))), device=device)
    look = gv.TransferFunction.from_points(
        [(0, 0), (0.4, 0.9)], [(0.4, 0.1, 0.2, 0.7), (1, 1, 0.8, 0.4)], reference=0.06
    )
    picture = engine.render(gv.Camera.orbit(distance=2, width=size, height=size), look)
    picture.save(output)
    print(f"{output}: {picture.stats.frames} frames, {picture.stats.bricks_used} bricks")


tyro.cli(main)
