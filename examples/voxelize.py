"""Triangles become voxels where they are looked at: a knot on a plate, or a mesh of yours."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((-0.9, -1.0, -0.25), (1.25, 1.12, 0.95), angle=5)
LIGHT = gv.Lighting(ambient=(0.5, 0.58, 0.72), occlusion=0.9, cones=4, reach=0.1, frame="box")
BACKGROUND = gv.Gradient((0.10, 0.13, 0.18), (0.42, 0.42, 0.42))
ALONG, AROUND, PLATE = 640, 48, np.array((0.42, 0.41, 0.40))


@dataclass
class Settings:
    """Renders a mesh as voxels."""

    output: Path = Path("voxelize.png")
    size: int = 720  # height of the picture
    mesh: Path | None = None  # a file in place of the knot
    texture: Path | None = None  # for that file
    resolution: int = 384
    device: str = "cpu"


def knot_on_plate() -> gv.Mesh:
    """Returns two solids: a rope along the torus knot (2, 3), red to gold to blue; a ring below."""
    t, a = (np.arange(n) * 2 * np.pi / n for n in (ALONG, AROUND))
    t, a = t[:, None, None], a[None, :, None]
    x, y, z, stretch = np.cos(2 * t), np.sin(3 * t), np.sin(2 * t), 1 + 0.42 * np.cos(3 * t)
    middle = np.concatenate((stretch * x, 0.42 * y, stretch * z), -1)
    step = np.roll(middle, -1, 0) - np.roll(middle, 1, 0)
    side = np.cross(step, np.concatenate((x * np.cos(3 * t), y, z * np.cos(3 * t)), -1))
    side, up = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (side, np.cross(side, step)))
    groove = 0.5 + 0.5 * np.cos(4 * a + 18 * t)
    radius = 0.19 + 0.06 * groove
    points = middle + radius * (np.cos(a) * up + np.sin(a) * side)
    hue = 0.05 + 0.75 * (0.5 + 0.5 * np.cos(t + np.array((0.0, 1.9, 3.6)))) ** 1.6
    rope = grid(points, hue * (0.35 + 0.65 * groove))
    radii = np.concatenate((np.linspace(0.5, 2.3, 13), np.linspace(2.3, 0.5, 13)))
    profile = np.stack((radii, np.repeat((-0.8, -0.67), 13)), 1)[None]
    turn = np.concatenate((np.cos(t), 0 * t, np.sin(t)), -1)[::4]
    ring = grid(profile[..., :1] * turn + profile[..., 1:] * np.array((0, 1, 0)), PLATE)
    corners, colors = (np.concatenate(pair) for pair in zip(rope, ring, strict=True))
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return gv.Mesh(vertices=corners.reshape(-1, 3), faces=faces, color=colors)


def grid(points: np.ndarray, paint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns corners and colours of the triangles of a grid (n, m, 3) that wraps both ways."""
    color = np.concatenate((paint + 0 * points, np.ones_like(points[..., :1])), -1)
    unrolled = []
    for array in (points, color):
        a, b = array, np.roll(array, -1, 1)
        c, d = np.roll(b, -1, 0), np.roll(a, -1, 0)
        triangles = np.stack((np.stack((a, b, c), 2), np.stack((a, c, d), 2)))
        unrolled.append(triangles.reshape(-1, 3, array.shape[-1]))
    return unrolled[0], unrolled[1]


def main(settings: Settings) -> None:
    """Renders the picture."""
    file = settings.mesh
    mesh = gv.read_mesh(file, texture=settings.texture) if file else knot_on_plate()
    producer = gv.MeshProducer(mesh, resolution=settings.resolution, channels=("color", "normal"))
    shading = {"light": SUN, "ambient": 0.75, "diffuse": 0.85, "specular": 0.12, "shininess": 40}
    paint = {"reference": 0.3 * producer.spacing[0], "premultiplied": True, "normals": "normal"}
    camera = gv.Camera.orbit(38, 24, 1.18, 34, settings.size * 16 // 9, settings.size)
    shader = gv.StoredColor("color", **paint, **shading)
    engine = gv.Engine(producer, device=settings.device)
    picture = engine.render(camera, shader, step=1.0, lighting=LIGHT, background=BACKGROUND)
    picture.save(settings.output)
    print(f"{settings.output}: {len(mesh.faces)} triangles, {picture.stats.bricks_used} bricks")


if __name__ == "__main__":
    main(tyro.cli(Settings))
