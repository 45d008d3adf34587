"""A hare's voxels as triangles at three levels of detail, which are rendered as voxels again."""

from dataclasses import dataclass
from functools import partial, reduce
from itertools import starmap
from pathlib import Path

import numpy as np
import torch
import tyro

import gvtorch as gv

sdf = gv.sdf
LIMBS = (  # of a hare: start, end and radius of each
    *(((-0.1, -0.15, 0), (0.35, -0.12, 0), 0.46), ((-0.55, 0.35, 0), (-0.68, 0.32, 0), 0.27)),
    *(((-0.52, 0.6, z), (-0.36, 1.12, 2 * z), 0.12) for z in (-0.15, 0.15)),
    *(((-0.4, -0.5, z), (-0.68, -0.53, z), 0.13) for z in (-0.22, 0.22)),
    *(((0.35, -0.45, z), (-0.02, -0.52, z), 0.17) for z in (-0.3, 0.3)),
    ((0.82, -0.02, 0), (0.86, 0.02, 0), 0.16),
)
#: Level: x position and colour of its hare.
HARES = {3: (-2.3, (0.05, 0.26, 0.34)), 2: (0.0, (0.75, 0.4, 0.08)), 0: (2.3, (0.62, 0.1, 0.05))}
FLOOR, PLATE = (0.2, 0.21, 0.23), ((9.0, 0.13, 4.0), (0, -0.735, 0))  # its size and middle
SUN = gv.DirectionalLight((0.9, -1.0, -0.75), (1.5, 1.22, 0.9), angle=8)
DAY = gv.DirectionalLight((-0.6, -1.0, 0.1), (0.1, 0.18, 0.36), angle=70)
LIGHT = gv.Lighting(lights=(SUN, DAY), ambient=(0.09, 0.12, 0.2))
WALL = gv.Gradient((0.01, 0.015, 0.025), (0.12, 0.13, 0.15))


@dataclass
class Settings:
    """Extracts three surfaces, and renders them."""

    output: Path = Path("surface.png")
    size: int = 720
    voxels: int = 96  # along the side of the hare's volume, at most
    device: str = "cpu"


def hare(voxels: int) -> gv.N3Tree:
    """Returns a tree of the fraction of each voxel that the hare fills, and of means of these."""
    shape = gv.Solid(reduce(partial(sdf.SmoothUnion, width=0.12), starmap(sdf.Capsule, LIMBS)))
    step = 2.6 / voxels
    axis = (torch.arange(voxels) + 0.5) * step - 1.3
    positions = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")[::-1], -1)
    filled = shape.filtered(positions, positions.new_tensor([2 * step] * 3))["rgba"][..., 3:]
    return gv.N3Tree.from_volume(gv.Volume(filled, (step,) * 3, (-1.3 + step / 2,) * 3))


def main(settings: Settings) -> None:
    """Puts the hares side by side."""
    tree, parts, counts = hare(min(settings.voxels, settings.size)), [], []
    for level, (x, color) in HARES.items():
        mesh = gv.extract_surface(tree, 0.5, level=level)
        parts.append((mesh.vertices[mesh.faces] + np.array((x, 0, 0)), color))
        counts.append(f"{len(mesh.faces)} triangles at level {level}")
    plate = gv.extract_surface(gv.Volume(torch.ones(1, 1, 1, 1), *PLATE), 0.5)
    parts.append((plate.vertices[plate.faces], FLOOR))
    corners = np.concatenate([part for part, _ in parts])
    colors = np.concatenate([np.full((len(part), 3, 4), (*color, 1.0)) for part, color in parts])
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = gv.Mesh(vertices=corners.reshape(-1, 3), faces=faces, color=colors)
    mesh_options = {"resolution": settings.size * 7 // 9, "channels": ("color", "normal")}
    producer = gv.MeshProducer(mesh, **mesh_options)
    paint = {"reference": 0.3 * producer.spacing[0], "premultiplied": True, "normals": "normal"}
    shader = gv.StoredColor("color", **paint, ambient=1, diffuse=1, specular=0.08, shininess=30)
    with gv.Engine(producer, device=settings.device) as engine:
        for part, mode in ((4, "converge"), (1, "interactive")):  # the small picture loads all
            size = settings.size * 16 // 9 // part, settings.size // part
            camera = gv.Camera.look_at((-1.6, 2.2, 8.5), (0, 0.12, 0), (0, 1, 0), 27, *size)
            options = {"lighting": LIGHT, "background": WALL, "cone_scale": 1.2 / part}
            picture = engine.render(camera, shader, mode, **options)
    picture.save(settings.output)
    print(f"{settings.output}: {', '.join(counts)}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
