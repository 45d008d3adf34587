"""From scene light to the display: a picture before a bright sky, clipped, with Reinhard's curve
and with a filmic one; and a transparent PNG. All with 16 rays a pixel.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
RAYS = 16


@dataclass
class Settings:
    """Renders the bundled aneurism under an environment map brighter than a display."""

    output: Path = Path("tone.png")
    size: int = 300
    device: str = "cpu"


def sky(height: int = 512) -> torch.Tensor:
    """An equirectangular map: dusk, a sun twelve times as bright as white, and dark ground."""
    up = torch.linspace(1, -1, height)[:, None, None]
    across = torch.linspace(-1, 1, 2 * height)[None, :, None]
    dusk = torch.tensor([0.9, 0.35, 0.12]) * (-9 * up.abs()).exp()
    dusk = dusk + torch.tensor([0.05, 0.12, 0.35]) * up.clamp(min=0).sqrt()
    away = (across + 0.01) ** 2 + (0.5 * (up - 0.12)) ** 2
    glow = 12 * (-4000 * away).exp() + 1.2 * (-300 * away).exp()
    ground = torch.tensor([0.06, 0.05, 0.04])
    return torch.where(up > 0, dusk + glow * torch.tensor([1.0, 0.85, 0.6]), ground)


def main(settings: Settings) -> None:
    """Renders once and tone-maps three times; then renders without a background."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    shader = gv.TransferFunction.preset("vessels", *tree.value_range["value"])
    camera = gv.Camera.orbit(10, 3, 2.0, 40, settings.size, settings.size)
    render = partial(gv.render, tree, shader=shader)
    behind = gv.Environment(sky())
    picture = gv.Progressive(partial(render, background=behind)).refine(camera, RAYS)
    curves = [picture.tone_map(curve) for curve in ("none", "reinhard", "aces")]
    color = torch.stack([one.color for one in curves])
    layers = {
        name: getattr(picture, name).expand(3, -1, -1, -1) for name in ("alpha", "depth", "samples")
    }
    replace(picture, color=color, **layers).save(settings.output)
    cut = settings.output.with_name(f"{settings.output.stem}_transparent.png")
    gv.Progressive(partial(render, background=None)).refine(camera, RAYS).save(cut, bits=16)
    print(f"{settings.output} and {cut}: {RAYS} rays a pixel")


if __name__ == "__main__":
    main(tyro.cli(Settings))
