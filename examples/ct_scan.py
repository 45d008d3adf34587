"""A CT scan from file to picture: read it, build the tree, render."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (-150.0, -200.0, 215.0), (58.0, 60.0, 150.0), (0.0, 0.0, 1.0)  # z: along the body
SKY = gv.Gradient((0.035, 0.05, 0.085), (0.006, 0.007, 0.011))


@dataclass
class Settings:
    """Renders the bundled stent."""

    output: Path = Path("ct_scan.png")
    size: int = 720
    samples: int = 4
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders one picture, with `samples` rays per pixel."""
    volume = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    tree = gv.N3Tree.from_volume(volume, brick_size=8, device=settings.device)
    print(tree)
    camera = gv.Camera.look_at(EYE, TARGET, UP, 25, settings.size * 16 // 9, settings.size)
    shader = gv.Lit(gv.TransferFunction.from_json(DATA / "stent.json"), ambient=0.3)
    render = partial(gv.render, tree, shader=shader, background=SKY)
    picture = gv.Progressive(render).refine(camera, settings.samples)
    picture.save(settings.output)
    stats = picture.stats
    print(f"{settings.output}: {stats.milliseconds:.0f} ms, {stats.samples} samples")


if __name__ == "__main__":
    main(tyro.cli(Settings))
