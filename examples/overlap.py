"""Two volumes in the same space: a CT scan, and a coarse map of uptake as from a PET scanner, which
has voxels of another size at another place. They are composited by sample, so that each is seen
through the other.

The uptake is made up here: what is full of contrast agent, blurred.
"""

import argparse
from pathlib import Path

import torch
from torch.nn.functional import avg_pool3d

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
COARSE = 4  # CT voxels along a side of one of the uptake's
BONE = gv.TransferFunction(
    opacity=[(150, 0), (260, 0.012), (420, 0.1), (1000, 0.7)],
    color=[(150, 0.45, 0.24, 0.18), (330, 0.8, 0.68, 0.55), (800, 1, 0.98, 0.92)],
)
UPTAKE = gv.TransferFunction(
    opacity=[(0.1, 0), (0.22, 0.03), (0.5, 0.16), (1, 0.4)],
    color=[(0.1, 0.4, 0.0, 0.3), (0.35, 0.9, 0.08, 0.05), (0.6, 1, 0.5, 0), (1, 1, 0.95, 0.5)],
    reference=1.0,
)


def uptake_of(scan: gv.Volume) -> gv.Volume:
    """Returns the uptake on a coarse grid, which begins half a coarse voxel farther in."""
    value = scan.data[..., 0].float()
    agent = ((value > 170) & (value < 330)).float()[None, None]
    blurred = avg_pool3d(avg_pool3d(agent, 9, 1, 4), 5, 1, 2)
    coarse = avg_pool3d(blurred, COARSE)[0, 0]
    middle = (COARSE - 1) / 2
    return gv.Volume(coarse / coarse.max(), (COARSE,) * 3, (middle,) * 3, name="uptake")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("-o", "--output", type=Path, default=Path("overlap.png"))
    args = parser.parse_args()

    scan = gv.read_volume(SCAN)
    trees = {
        "ct": gv.N3Tree.from_volume(scan, device=args.device),
        "uptake": gv.N3Tree.from_volume(uptake_of(scan), device=args.device),
    }
    sun = gv.DirectionalLight((1, 1.2, -0.8))
    shaders = {"ct": gv.Lit(BONE, light=sun), "uptake": UPTAKE}
    height = args.width * 9 // 16
    camera = gv.Camera.look_at(
        (-330, -250, 150), (64, 62, 128), (0, 0, 1), 30, args.width, height
    )
    picture = gv.render(
        trees, camera, shaders, background=gv.Gradient((0.05, 0.06, 0.08), (0.005, 0.005, 0.01))
    )
    picture.save(args.output)
    print(f"{args.output}: {picture.stats.samples / 1e6:.1f} M samples")


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
