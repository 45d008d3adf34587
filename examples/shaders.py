"""One scan, built-in shaders. Above: plain, lit, isosurface, maximum; a thin shell at step 1, plain
and pre-integrated. Below: the shell, plain, at step 0.02; mean, stored colours lit by stored
normals, a distance field, the minimum in a slab, features."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (-230.0, -330.0, 170.0), (66.0, 63.5, 130.0), (0.0, 0.0, 1.0)
SHELL = gv.TransferFunction.from_points(  # thinner than the change of the value in one step
    [(240, 0), (244, 0.98), (252, 0.98), (256, 0)], [(240, 0.9, 0.3, 0.15), (256, 1.0, 0.8, 0.5)]
)


@dataclass
class Settings:
    """Renders the bundled stent with each shader."""

    output: Path = Path("shaders.png")
    size: int = 720
    samples: int = 3
    device: str = "cpu"


def channels(scan: gv.Volume, transfer: gv.TransferFunction) -> dict[str, gv.Volume]:
    """Returns the scan, its voxels' colours and normals, and the distance to a helix."""
    value = scan.data[..., 0].float()
    normal = torch.nn.functional.normalize(-torch.stack(torch.gradient(value)[::-1], -1), dim=-1)
    z, y, x = torch.meshgrid(*(torch.arange(float(n)) for n in value.shape), indexing="ij")
    offsets = [(r * (z / 22).cos(), r * (z / 22).sin()) for r in (-38, 38)]
    strands = [torch.hypot(x - 64 - u, y - 64 - v) for u, v in offsets]
    helix = torch.minimum(0.5 * torch.minimum(*strands) - 5, torch.hypot(x - 64, y - 64) - 9)
    parts = {
        "rgba": torch.from_numpy(transfer(value.numpy())).half(),
        "normal": (127 * normal).round().to(torch.int8),
        "helix": helix[..., None].half(),
    }
    return {"value": scan} | {n: gv.Volume(d, scan.spacing, scan.origin) for n, d in parts.items()}


def main(settings: Settings) -> None:
    """Renders the grid."""
    scan = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    transfer = gv.TransferFunction.from_json(DATA / "stent.json")
    tree = gv.N3Tree.from_volume(channels(scan, transfer), device=settings.device)
    wide, soft = (gv.TransferFunction.preset("magma", *ends) for ends in ((60, 900), (40, 220)))
    light = {"light": gv.DirectionalLight((0.6, 1.0, -0.7)), "ambient": 0.3}
    surface = gv.Isosurface(290, (0.9, 0.8, 0.65), **light)
    features = gv.Features(transfer, "normal")
    width, height = -(-settings.size * 8 // 27), settings.size // 2  # a sixth and a half of 16:9
    camera = gv.Camera.look_at(EYE, TARGET, UP, 31, width, height)
    helix = gv.DistanceField((0.3, 0.6, 0.9), **light)
    helix.channel = "helix"
    slab = {"clip": gv.Clip(planes=[(0.6, 0.8, 0, -86), (-0.6, -0.8, 0, 96)])}
    stored = gv.StoredColor("rgba", normals="normal", **light)
    cases = (
        *((transfer, {}), (gv.Lit(transfer, **light), {}), (surface, {})),
        *((gv.Projection("maximum", wide), {}), (SHELL, {"step": 1.0})),
        *((gv.PreIntegrated(SHELL), {"step": 1.0}), (SHELL, {"step": 0.02})),
        *((gv.Projection("mean", soft), {}), (stored, {}), (helix, {})),
        *((gv.Projection("minimum", soft), slab), (features, {})),
    )
    render = partial(gv.render, tree, lod="finest")
    means = [gv.Progressive(partial(render, shader=shader, **options)) for shader, options in cases]
    images = [mean.refine(camera, settings.samples) for mean in means]
    tiles = [image.color for image in images]
    tiles[-1] = 0.5 * (images[-1].features / 127 + images[-1].alpha)  # -127 to 127 become 0 to 1
    rows = [torch.cat(tiles[first : first + 6], dim=1) for first in (0, 6)]
    replace(images[0], color=torch.cat(rows)).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
