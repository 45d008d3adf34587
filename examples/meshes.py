"""Files of triangles as voxels: a castle and trees (KayKit, CC0), a cow (Keenan Crane)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import gvtorch as gv

FOLDER = Path(__file__).parent / "data" / "meshes"
SUN = gv.DirectionalLight((-0.8, -1.0, -0.55), (1.35, 1.2, 0.98), angle=4)
LIGHT = gv.Lighting(ambient=(0.5, 0.58, 0.72), occlusion=0.9, cones=6, reach=0.12, frame="box")
SCENE = {"lighting": LIGHT, "background": gv.Gradient((0.13, 0.23, 0.40), (0.52, 0.55, 0.55))}
VIEW, GRASS = ((0.5, 1.15, 3.3), (0, 0.45, 0), (0, 1, 0), 30), (0.2, 0.34, 0.09, 1)
#: File, texture, height, degrees around y, position x and z.
PARTS = (
    ("building_castle_blue.gltf", None, 1.25, 20, -0.05, -0.25),
    ("trees_B_large.gltf", None, 0.50, 0, -0.85, 0.0),
    ("trees_B_large.gltf", None, 0.42, 130, 0.62, -0.72),
    ("spot_triangulated.obj.gz", "spot_texture.png", 0.46, 205, 0.62, 0.55),
)


@dataclass
class Settings:
    """Renders meshes as voxels."""

    output: Path = Path("meshes.png")
    size: int = 720  # height of the picture
    resolution: int = 384
    device: str = "cpu"


def load(file: str, texture: str | None, height: float, turn: float, x: float, z: float) -> gv.Mesh:
    """Reads a mesh, scales it to a height, turns it by degrees, and puts it at (x, 0, z)."""
    mesh = gv.read_mesh(FOLDER / file, texture=texture and FOLDER / texture)
    low, high = mesh.bounds
    foot = np.array(((low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2))
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    matrix = np.array(((c, 0, -s), (0, 1, 0), (s, 0, c))) * (height / (high[1] - low[1]))
    return gv.Mesh(**{**vars(mesh), "vertices": (mesh.vertices - foot) @ matrix + (x, 0, z)})


def meadow(radius: float, count: int = 96) -> gv.Mesh:
    """Returns a round plate from y = -0.05 to a little above 0."""
    angles = np.arange(count) * 2 * np.pi / count
    ring = radius * np.stack((np.cos(angles), 0 * angles, np.sin(angles)), 1)
    top, low, a = (0, 0.004, 0), (0, -0.05, 0), np.arange(count)
    vertices = np.concatenate((ring + top, ring + low, [top, low]))
    b, c, d = np.roll(a, -1), a + count, np.roll(a, -1) + count
    sides = (b, a, a * 0 + 2 * count), (c, d, a * 0 + 2 * count + 1), (a, b, d), (a, d, c)
    faces = np.concatenate([np.stack(side, 1) for side in sides])
    attributes = {"uv": np.zeros((4 * count, 3, 2)), "materials": (gv.Material(color=GRASS),)}
    return gv.Mesh(vertices=vertices, faces=faces, **attributes)


def joined(meshes: list[gv.Mesh]) -> gv.Mesh:
    """Joins meshes of one material each into one."""
    corners, uv = (np.concatenate([getattr(m, n) for m in meshes]) for n in ("corners", "uv"))
    material = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    faces, looks = np.arange(len(corners) * 3).reshape(-1, 3), (*(m.materials[0] for m in meshes),)
    attributes = {"uv": uv, "material": material, "materials": looks}
    return gv.Mesh(vertices=corners.reshape(-1, 3), faces=faces, **attributes)


def main(settings: Settings) -> None:
    """Renders the picture."""
    mesh = joined([meadow(1.3), *(load(*part) for part in PARTS)])
    producer = gv.MeshProducer(mesh, resolution=settings.resolution, channels=("color", "normal"))
    paint = {"reference": 0.3 * producer.spacing[0], "premultiplied": True, "normals": "normal"}
    shader = gv.StoredColor("color", **paint, light=SUN, ambient=0.75, diffuse=0.85, specular=0.05)
    camera = gv.Camera.look_at(*VIEW, settings.size * 16 // 9, settings.size)
    engine = gv.Engine(producer, device=settings.device)
    engine.render(camera, shader, **SCENE).save(settings.output)
    print(f"{settings.output}: {len(mesh.faces)} triangles")


if __name__ == "__main__":
    main(tyro.cli(Settings))
