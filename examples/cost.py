"""What a picture costs, as images: samples and nodes of each ray, and level, age and fill of the
bricks that it read, after a camera has turned around a streamed scan."""

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
FRAMES, DEGREES = 10, 9.0
IMAGES = ("samples", "nodes", "lod", "age", "fill")


@dataclass
class Settings:
    """Renders the bundled aneurism: the picture, samples and nodes; level, age and fill."""

    output: Path = Path("cost.png")
    size: int = 720
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Turns the camera, then draws the cost of the last frame."""
    volume = gv.read_volume(SCAN)
    size = -(-settings.size * 16 // 27), settings.size // 2  # a third and a half of 16:9
    shader = gv.TransferFunction.preset("vessels", *volume.value_range)
    options = {"brick_pool": "32 MB", "load_budget": 400, "device": settings.device}
    with gv.Engine(gv.VolumeProducer(volume), **options) as engine:
        for frame in range(FRAMES):
            azimuth = 30 + DEGREES * frame
            camera = gv.Camera.orbit(azimuth, 20, 1.15, 36, *size)
            engine.frame(camera, shader)
        tree = engine.trees["scene"].tree
        cost = gv.cost(tree, camera, shader)
        picture = gv.Progressive(partial(gv.render, tree, shader=shader)).refine(camera, 4)
    for name in IMAGES:
        image = getattr(cost, name).float()
        valid = image[~image.isnan()]
        print(f"{name:8s} mean {float(valid.mean()):7.2f}  max {float(valid.max()):7.2f}")
    panels = [picture.color.cpu(), *(cost.picture(name).color for name in IMAGES)]
    rows = [torch.cat(panels[first : first + 3], 1) for first in (0, 3)]
    dataclasses.replace(picture, color=torch.cat(rows, 0)).save(settings.output)
    print(f"{settings.output}: {cost.stats.milliseconds:.0f} ms")


if __name__ == "__main__":
    main(tyro.cli(Settings))
