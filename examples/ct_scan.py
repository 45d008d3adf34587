"""A CT scan from file to picture: read it, build the tree, render."""

from dataclasses import dataclass
from pathlib import Path

import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (
    (-260.0, -340.0, 190.0),
    (63.5, 63.5, 127.5),
    (0.0, 0.0, 1.0),
)  # z is along the body
BACKGROUND = (0.02, 0.02, 0.03)


@dataclass
class Settings:
    """Renders the bundled stent."""

    output: Path = Path("ct_scan.png")
    size: int = 512
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders one picture."""
    volume = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    tree = gv.N3Tree.from_volume(volume, brick_size=8, device=settings.device)
    print(tree)
    camera = gv.Camera.look_at(EYE, TARGET, UP, fov=30, width=settings.size, height=settings.size)
    shader = gv.TransferFunction.from_json(DATA / "stent.json")
    picture = gv.render(tree, camera, shader, background=BACKGROUND)
    picture.save(settings.output)
    print(
        f"{settings.output}: {picture.stats.milliseconds:.0f} ms, {picture.stats.samples} samples"
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
