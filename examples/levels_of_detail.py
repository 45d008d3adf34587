"""Level of detail: the same scan from ever farther away, with the samples and bricks of each
picture; and one picture of many copies of it, in an avenue that goes into the distance."""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
DISTANCES = [1.2, 2.4, 4.8, 9.6]
ROWS, SPACING = 10, 305.0  # voxels
EYE, TARGET = (0.0, 175.0, 560.0), (0.0, 110.0, -300.0)
SKY = gv.Gradient((0.004, 0.005, 0.01), (0.02, 0.028, 0.05))


@dataclass
class Settings:
    """Renders the bundled aneurism at four distances, and an avenue of it."""

    output: Path = Path("levels_of_detail.png")
    size: int = 720
    samples: int = 2
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders each distance to print its statistics, then the avenue."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    shader = gv.TransferFunction.preset("vessels", *tree.value_range["value"])
    side = settings.size * 16 // 45
    cameras = gv.Camera.orbit(30, 20, DISTANCES, 30, side, side)
    print("distance  lod      samples  bricks        ms")
    for index, distance in enumerate(DISTANCES):
        for lod in ("finest", "auto"):
            stats = gv.render(tree, cameras[index], shader, lod=lod).stats
            print(
                f"{distance:8g}  {lod:6s} {stats.samples:9d} {stats.bricks_used:7d} "
                f"{stats.milliseconds:9.1f}"
            )

    def avenue(camera: gv.Camera) -> gv.Picture:
        behind = SKY
        for number in range(2 * ROWS)[::-1]:  # the farthest first: the next is drawn over it
            row, column = number // 2, number % 2
            pose = torch.eye(4, dtype=torch.float64)
            pose[0, 3], pose[2, 3] = SPACING * (column - 1) + 25, -SPACING * row
            picture = gv.render(tree, camera, shader, pose=pose, background=behind)
            behind = picture.color
        return picture

    size = {"width": settings.size * 16 // 9, "height": settings.size}
    camera = gv.Camera.look_at(EYE, TARGET, fov=36, **size)
    gv.Progressive(avenue).refine(camera, settings.samples).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
