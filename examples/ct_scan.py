"""A CT scan from disk to picture: read, build the tree, look at it."""

from dataclasses import dataclass
from pathlib import Path

import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"

# The stent's metal is above 1,600 of these units, bone and contrast agent above 1,250, soft tissue
# below.
OPACITY = [(1100, 0), (1250, 0.05), (1500, 0.3), (1700, 0.95)]
COLOR = [
    (1100, 0.35, 0.04, 0.02),
    (1350, 0.85, 0.35, 0.16),
    (1600, 0.95, 0.85, 0.6),
    (1700, 0.6, 0.8, 1.0),
]


@dataclass
class Settings:
    """Renders the bundled stent."""

    output: Path = Path("ct_scan.png")
    size: int = 512
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders one picture."""
    volume = gv.read_volume(SCAN)
    tree = gv.N3Tree.from_volume(volume, brick_size=8, device=settings.device)
    print(tree)
    camera = gv.Camera.orbit(
        azimuth=30, elevation=20, distance=2.4, fov=30, width=settings.size, height=settings.size
    )
    picture = gv.render(tree, camera, gv.TransferFunction.from_points(OPACITY, COLOR))
    picture.save(settings.output)
    print(
        f"{settings.output}: {picture.stats.milliseconds:.0f} ms, {picture.stats.samples} samples"
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
