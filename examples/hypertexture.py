"""Hypertexture: a weathered rock, its distance and normals perturbed by noise, and coloured by a
transfer function of the distance; and fur, which a transfer function alone makes from noise. Both
are computed where rays request voxels, around any shape: that of --mesh, or that of --volume.
"""

from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import starmap
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((-0.7, -0.75, -0.65), (1.5, 1.3, 1.05), angle=3)
SKY = gv.Gradient((0.16, 0.22, 0.31), (0.68, 0.72, 0.72))
STONE = [(-0.1, 0.06, 0.04, 0.03), (-0.05, 0.28, 0.2, 0.13), (0.03, 0.55, 0.49, 0.41)]
LIMBS = (  # of a hare: start, end and radius of each
    *(((-0.1, -0.15, 0), (0.35, -0.12, 0), 0.46), ((-0.55, 0.35, 0), (-0.68, 0.32, 0), 0.27)),
    *(((-0.52, 0.6, z), (-0.36, 1.12, 2 * z), 0.1) for z in (-0.15, 0.15)),
    *(((-0.4, -0.5, z), (-0.68, -0.53, z), 0.12) for z in (-0.22, 0.22)),
    *(((0.35, -0.45, z), (-0.02, -0.52, z), 0.16) for z in (-0.3, 0.3)),
    ((0.82, -0.02, 0), (0.86, 0.02, 0), 0.15),
)
HAIR = [(0, 0.02, 0.008, 0.004), (0.4, 0.3, 0.12, 0.04), (0.75, 0.85, 0.52, 0.25), (1, 1, 0.9, 0.7)]


@dataclass
class Settings:
    """Renders a rock and its fur."""

    output: Path = Path("hypertexture.png")
    size: int = 720
    extent: int = 384
    mesh: Path | None = None  # closed, y up; its largest side is scaled to 2
    volume: Path | None = None  # of signed distances
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders both side by side."""
    shape = reduce(partial(gv.sdf.SmoothUnion, width=0.12), starmap(gv.sdf.Capsule, LIMBS))
    if settings.mesh is not None:
        mesh = gv.read_mesh(settings.mesh)
        low, high = mesh.bounds
        vertices = (mesh.vertices - (low + high) / 2) * (2 / (high - low).max())
        shape = gv.SampledDistance.of_mesh(replace(mesh, vertices=vertices), reach=0.1)
    elif settings.volume is not None:
        shape = gv.SampledDistance(gv.read_volume(settings.volume))
    noise = {"thickness": 0.075, "frequency": 6, "gain": 0.55, "softness": 0.12}
    # Grown by the depth at which density 1/2 lies below the surface.
    grown = gv.sdf.Offset(shape, 0.03)
    rock = gv.Hypertexture(grown, settings.extent, octaves=6, distances=True, **noise)
    fur = gv.Fur(shape, length=0.11, frequency=36, fall=(-0.12, -0.5, -0.05))
    stone = gv.TransferFunction.from_points([(-1, 1), (1, 1)], STONE)
    hair = gv.TransferFunction.from_points([(0.02, 0), (0.1, 0.5), (1, 0.6)], HAIR)
    shading = {"light": SUN, "ambient": 0.35, "diffuse": 0.85, "specular": 0.05, "shininess": 12}
    shaders = {
        rock: gv.Isosurface(0.5, stone, color_channel="distance", **shading),
        gv.FieldProducer(fur, settings.extent): hair,
    }
    lighting = gv.Lighting(
        ambient=(0.75, 0.88, 1.1), occlusion=0.9, reach=0.08, cones=8, frame="box"
    )
    camera = gv.Camera.orbit(-30, 16, 1.55, 36, settings.size * 8 // 9, settings.size)
    pictures = []
    for producer, shader in shaders.items():
        engine = gv.Engine(producer, device=settings.device, brick_pool="256 MB")
        options = {"lighting": lighting} if producer is rock else {}
        pictures.append(engine.render(camera, shader, background=SKY, **options))
    color = torch.cat([picture.color for picture in pictures], dim=1)
    replace(pictures[0], color=color).save(settings.output)
    print(f"{settings.output}: {rock.saved:.0%} of the rock's octaves were not evaluated")


if __name__ == "__main__":
    main(tyro.cli(Settings))
