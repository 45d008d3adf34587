"""A sphere that is computed, not stored: a formula of your own, and its picture.

65,536^3 voxels would take 1,100 TB; the picture needs a few MB of them.
"""

import torch
import tyro

import gvtorch as gv

BOX = ((-1, -1, -1), (1, 1, 1))
BANDS = torch.tensor([6.0, 28.0, 4.0])


class Bands(torch.nn.Module):
    """Density 0.4 to 1, in bands."""

    def forward(self, points):
        return 0.7 + 0.3 * (points * BANDS.to(points)).sum(-1).sin()


def main(output: str = "hello_sphere.png", device: str = "cpu", size: int = 400) -> None:
    """Renders the sphere."""
    inside = gv.Solid(gv.sdf.Sphere(0.9), colors=False)
    sphere = gv.FieldProducer(gv.mask(Bands(), inside), 65536, box=BOX, threshold=0)
    engine = gv.Engine(sphere, device=device)
    look = gv.TransferFunction.from_points(
        [(0, 0), (0.4, 0.9)], [(0.4, 0.1, 0.2, 0.7), (1, 1, 0.8, 0.4)], reference=0.06
    )
    picture = engine.render(gv.Camera.orbit(distance=2, width=size, height=size), look)
    picture.save(output)
    print(f"{output}: {picture.stats.frames} frames, {picture.stats.bricks_used} bricks")


tyro.cli(main)
