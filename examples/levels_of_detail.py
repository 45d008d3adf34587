"""Level of detail: the same scan from ever farther away, with the samples and bricks of each
picture."""

from dataclasses import dataclass
from pathlib import Path

import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
DISTANCES = [1.2, 2.4, 4.8, 9.6]


@dataclass
class Settings:
    """Renders the bundled aneurism at four distances, side by side."""

    output: Path = Path("levels_of_detail.png")
    size: int = 256
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders each camera alone for its figures, then all as a batch."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    shader = gv.TransferFunction.preset("vessels", *tree.value_range["value"])
    cameras = gv.Camera.orbit(30, 20, DISTANCES, 30, settings.size, settings.size)
    print("distance  lod      samples  bricks        ms")
    for index, distance in enumerate(DISTANCES):
        for lod in ("finest", "auto"):
            stats = gv.render(tree, cameras[index], shader, lod=lod).stats
            print(
                f"{distance:8g}  {lod:6s} {stats.samples:9d} {stats.bricks_used:7d} "
                f"{stats.milliseconds:9.1f}"
            )
    gv.render(tree, cameras, shader).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
