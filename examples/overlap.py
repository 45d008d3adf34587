"""Two volumes in the same space: a CT scan, and a coarse map of uptake as from a PET scanner, whose
grid differs in voxel size, position and orientation. They are composited sample by sample, so that
each is seen through the other. The uptake is made up: regions with contrast agent, blurred.
"""

import math
from pathlib import Path

import torch
import tyro
from torch.nn.functional import avg_pool3d, grid_sample

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
COARSE = 4  # side of an uptake voxel, in CT voxels
TILT = 20  # degrees by which the uptake's axes are turned about x
BONE = gv.TransferFunction(
    opacity=[(150, 0), (260, 0.03), (420, 0.2), (1000, 0.8)],
    color=[(150, 0.45, 0.24, 0.18), (330, 0.8, 0.68, 0.55), (800, 1, 0.98, 0.92)],
)
UPTAKE = gv.TransferFunction(
    opacity=[(0.12, 0), (0.3, 0.03), (0.55, 0.16), (1, 0.4)],
    color=[(0.1, 0.4, 0.0, 0.3), (0.35, 0.9, 0.08, 0.05), (0.6, 1, 0.5, 0), (1, 1, 0.95, 0.5)],
    reference=1.0,
)


def pose_about(center: torch.Tensor) -> torch.Tensor:
    """Returns the pose (4, 4) from the uptake's axes to the world: a turn about `center`."""
    cos, sin = math.cos(math.radians(TILT)), math.sin(math.radians(TILT))
    pose = torch.eye(4, dtype=torch.float64)
    pose[1:3, 1:3] = torch.tensor([[cos, -sin], [sin, cos]])
    pose[:3, 3] = center - pose[:3, :3] @ center
    return pose


def uptake_of(scan: gv.Volume) -> tuple[gv.Volume, torch.Tensor]:
    """Returns the uptake on a coarse grid around the scan, and the pose (4, 4) of this grid."""
    value = scan.data[..., 0].float()
    blurred = ((value > 170) & (value < 330)).float()[None, None]
    for size in (9, 5):
        for axis in range(3):
            kernel = [size if axis == other else 1 for other in range(3)]
            blurred = avg_pool3d(blurred, kernel, 1, [side // 2 for side in kernel])
    extent = torch.tensor(scan.extent, dtype=torch.float64)
    center = (extent - 1) / 2
    pose, count = pose_about(center), (1.3 * extent / COARSE).long()  # wider, because it is turned
    origin = center - (count - 1) / 2 * COARSE
    axes = [o + COARSE * torch.arange(int(n)) for o, n in zip(origin, count, strict=True)]
    points = torch.stack(torch.meshgrid(*axes[::-1], indexing="ij")[::-1], -1)  # x, y, z
    world = points @ pose[:3, :3].T + pose[:3, 3]
    coordinates = (world - center) / (extent / 2)  # -1 to 1 from face to face
    coarse = grid_sample(blurred, coordinates[None].float(), align_corners=False)[0, 0]
    spacing, first = (float(COARSE),) * 3, tuple(origin.tolist())
    return gv.Volume(coarse / coarse.max(), spacing, first, name="uptake"), pose


def main(output: Path = Path("overlap.png"), size: int = 1280, device: str = "cpu") -> None:
    """Renders both volumes into one picture."""
    scan = gv.read_volume(SCAN)
    uptake, pose = uptake_of(scan)
    trees = {
        "ct": gv.N3Tree.from_volume(scan, device=device),
        "uptake": gv.N3Tree.from_volume(uptake, device=device),
    }
    sun = gv.DirectionalLight((1, 1.2, -0.8))
    shaders = {"ct": gv.Lit(BONE, light=sun), "uptake": UPTAKE}
    camera = gv.Camera.look_at(
        (-270, -250, 150), (64, 62, 128), (0, 0, 1), 36, size, size * 9 // 16
    )
    sky = gv.Gradient((0.05, 0.06, 0.08), (0.005, 0.005, 0.01))
    poses = {"uptake": pose}
    picture = gv.render(trees, camera, shaders, background=sky, pose=poses)
    picture.save(output)
    print(f"{output}: {picture.stats.samples / 1e6:.1f} M samples")


if __name__ == "__main__":
    tyro.cli(main)
