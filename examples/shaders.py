"""One scan, built-in shaders. First row: plain, lit, isosurface, maximum. Second: a thin
shell by the plain function at step 1, pre-integrated at step 1, plain at step 0.02; the mean.
Third: stored colours lit by stored normals, a distance field, the minimum in a slab, features.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (-230.0, -330.0, 170.0), (63.5, 63.5, 127.5), (0.0, 0.0, 1.0)
BONE = 290.0  # aorta, bones and the stent
SHELL = gv.TransferFunction.from_points(  # thinner than the change of the value in one step
    opacity=[(240, 0), (244, 0.98), (252, 0.98), (256, 0)],
    color=[(240, 0.9, 0.3, 0.15), (256, 1.0, 0.8, 0.5)],
)


@dataclass
class Settings:
    """Renders the bundled stent with each shader."""

    output: Path = Path("shaders.png")
    size: int = 240
    device: str = "cpu"


def channels(scan: gv.Volume, transfer: gv.TransferFunction) -> dict[str, gv.Volume]:
    """The scan; its voxels' colours and normals; the distance to a ring in voxels."""
    value = scan.data[..., 0].float()
    normal = torch.nn.functional.normalize(-torch.stack(torch.gradient(value)[::-1], -1), dim=-1)
    z, y, x = torch.meshgrid(*(torch.arange(float(n)) for n in value.shape), indexing="ij")
    ring = torch.hypot(torch.hypot(x - 63.5, z - 127.5) - 42, y - 63.5) - 14
    parts = {
        "rgba": torch.from_numpy(transfer(value.numpy())).half(),
        "normal": (127 * normal).round().to(torch.int8),
        "ring": ring[..., None].half(),
    }
    return {"value": scan} | {n: gv.Volume(d, scan.spacing, scan.origin) for n, d in parts.items()}


def main(settings: Settings) -> None:
    """Renders the grid."""
    scan = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    transfer = gv.TransferFunction.from_json(DATA / "stent.json")
    tree = gv.N3Tree.from_volume(channels(scan, transfer), device=settings.device)
    white, soft = (gv.TransferFunction.preset("gray", *ends) for ends in ((100, 1000), (40, 300)))
    sun = gv.DirectionalLight((0.6, 1.0, -0.7))
    camera = gv.Camera.look_at(EYE, TARGET, UP, fov=28, width=settings.size, height=settings.size)
    ring = gv.DistanceField((0.3, 0.6, 0.9), light=sun)
    ring.channel = "ring"
    slab = gv.Clip(planes=[(0.6, 0.8, 0, -86), (-0.6, -0.8, 0, 96)])
    looks = (
        (transfer, {}),
        (gv.Lit(transfer, light=sun, ambient=0.3), {}),
        (gv.Isosurface(BONE, (0.9, 0.8, 0.65), light=sun), {}),
        (gv.Projection("maximum", white), {}),
        (SHELL, {"step": 1.0}),
        (gv.PreIntegrated(SHELL), {"step": 1.0}),
        (SHELL, {"step": 0.02}),
        (gv.Projection("mean", soft), {}),
        (gv.StoredColor("rgba", normals="normal", light=sun, ambient=0.3), {}),
        (ring, {}),
        (gv.Projection("minimum", soft), {"clip": slab}),
        (gv.Features(transfer, "normal"), {}),
    )
    made = [gv.render(tree, camera, look, lod="finest", **options) for look, options in looks]
    images, last = [picture.color for picture in made], made[-1]
    images[-1] = 0.5 * (last.features / 127 + last.alpha)  # -127 to 127 become 0 to 1
    rows = [torch.cat(images[first : first + 4], dim=1) for first in range(0, len(images), 4)]
    replace(last, color=torch.cat(rows)).save(settings.output)
    print(f"{settings.output}: {len(images)} pictures")


if __name__ == "__main__":
    main(tyro.cli(Settings))
