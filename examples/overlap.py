"""Two volumes in the same space: a CT scan, and a coarse map of uptake as from a PET scanner, which
has voxels of another size at another place. They are composited by sample, so that each is seen
through the other.

The uptake is made up here: what is full of contrast agent, blurred.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from torch.nn.functional import avg_pool3d

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
COARSE = 4  # CT voxels along a side of one of the uptake's
BONE = gv.TransferFunction(
    opacity=[(150, 0), (260, 0.03), (420, 0.2), (1000, 0.8)],
    color=[(150, 0.45, 0.24, 0.18), (330, 0.8, 0.68, 0.55), (800, 1, 0.98, 0.92)],
)
UPTAKE = gv.TransferFunction(
    opacity=[(0.12, 0), (0.3, 0.03), (0.55, 0.16), (1, 0.4)],
    color=[(0.1, 0.4, 0.0, 0.3), (0.35, 0.9, 0.08, 0.05), (0.6, 1, 0.5, 0), (1, 1, 0.95, 0.5)],
    reference=1.0,
)


@dataclass
class Settings:
    """Renders the bundled scan and an uptake in it."""

    output: Path = Path("overlap.png")
    size: int = 1280
    device: str = "cpu"


def uptake_of(scan: gv.Volume) -> gv.Volume:
    """Returns the uptake on a coarse grid, which begins half a coarse voxel farther in."""
    value = scan.data[..., 0].float()
    blurred = ((value > 170) & (value < 330)).float()[None, None]
    for size in (9, 5):
        for axis in range(3):
            kernel = [size if axis == other else 1 for other in range(3)]
            blurred = avg_pool3d(blurred, kernel, 1, [side // 2 for side in kernel])
    coarse = avg_pool3d(blurred, COARSE)[0, 0]
    middle = (COARSE - 1) / 2
    return gv.Volume(coarse / coarse.max(), (COARSE,) * 3, (middle,) * 3, name="uptake")


def main(settings: Settings) -> None:
    """Renders both."""
    scan = gv.read_volume(SCAN)
    trees = {
        "ct": gv.N3Tree.from_volume(scan, device=settings.device),
        "uptake": gv.N3Tree.from_volume(uptake_of(scan), device=settings.device),
    }
    sun = gv.DirectionalLight((1, 1.2, -0.8))
    shaders = {"ct": gv.Lit(BONE, light=sun), "uptake": UPTAKE}
    size = (settings.size, max(9, settings.size * 9 // 16))
    camera = gv.Camera.look_at((-270, -250, 150), (64, 62, 128), (0, 0, 1), 36, *size)
    sky = gv.Gradient((0.05, 0.06, 0.08), (0.005, 0.005, 0.01))
    picture = gv.render(trees, camera, shaders, background=sky)
    picture.save(settings.output)
    print(f"{settings.output}: {picture.stats.samples / 1e6:.1f} M samples")


if __name__ == "__main__":
    main(tyro.cli(Settings))
