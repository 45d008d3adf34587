"""From scene light to the display: a picture with a bright sky, clipped, with Reinhard's curve
and with a filmic one; and a transparent PNG. All with 8 rays a pixel.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
SUN = gv.DirectionalLight((-0.6, -0.4, 0.45), (1.6, 1.2, 0.8))
RAYS = 8


@dataclass
class Settings:
    """Renders the bundled aneurism under an environment map brighter than a display."""

    output: Path = Path("tone.png")
    size: int = 720
    device: str = "cpu"


def sky(height: int = 768) -> torch.Tensor:
    """Returns an equirectangular map: dusk, a sun twelve times as bright as white, clouds, sea."""
    up = torch.linspace(1, -1, height)[:, None, None]
    across = torch.linspace(-1, 1, 2 * height)[None, :, None]
    above = up.abs()  # the sea mirrors the sky
    light = torch.tensor([1.1, 0.4, 0.12]) * (-7 * above).exp()
    light = light + torch.tensor([0.06, 0.14, 0.4]) * above.sqrt()
    r2 = (across + 0.01) ** 2 + (0.5 * (above - 0.12)) ** 2
    glow = 12 * (-4000 * r2).exp() + 1.5 * (-250 * r2).exp()
    points = torch.cat(torch.broadcast_tensors(14 * across, 60 * above, 0 * up), -1)
    cloud = (1.4 * gv.noise.fbm(points, octaves=6) + 0.15).clamp(0, 1)[..., None]
    lit = light * 0.35 + (0.35 * glow + 0.25 * (-6 * r2).exp()) * torch.tensor([1.0, 0.4, 0.2])
    light = (light + glow * torch.tensor([1.0, 0.85, 0.6])).lerp(lit, cloud)
    ripples = 0.35 + 0.3 * gv.noise.fbm(points * torch.tensor([2.0, 9.0, 1.0]), octaves=4)
    return torch.where(up > 0, light, light * ripples[..., None].clamp(min=0))


def main(settings: Settings) -> None:
    """Renders once and tone-maps three times; then renders without a background."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    shader = gv.TransferFunction.preset("vessels", *tree.value_range["value"])
    shader = gv.Lit(shader, light=SUN, ambient=0.16, specular=0.3)
    width = -(-settings.size * 16 // 27)  # a third of 16:9
    camera = gv.Camera.orbit(10, 3, 1.5, 52, width, settings.size)
    render = partial(gv.render, tree, shader=shader)
    background = gv.Environment(sky())
    picture = gv.Progressive(partial(render, background=background)).refine(camera, RAYS)
    curves = [picture.tone_map(curve) for curve in ("none", "reinhard", "aces")]
    color = torch.cat([toned.color for toned in curves], dim=1)
    replace(picture, color=color).save(settings.output)
    transparent = settings.output.with_name(f"{settings.output.stem}_transparent.png")
    gv.Progressive(partial(render, background=None)).refine(camera, RAYS).save(transparent, bits=16)
    print(f"{settings.output} and {transparent}: {RAYS} rays a pixel")


if __name__ == "__main__":
    main(tyro.cli(Settings))
