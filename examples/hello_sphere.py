"""A planet that is computed, not stored: a formula of your own, and its picture.

65,536^3 voxels would take 1,100 TB; the picture needs some 100 MB of them.
"""

import torch
import tyro

import gvtorch as gv

BOX = ((-1, -1, -1), (1, 1, 1))
SUN = gv.DirectionalLight((-0.9, -0.4, -0.8), (1.25, 1.15, 1.0))
PAINT = {"premultiplied": True, "normals": "normal", "ambient": 0.003, "diffuse": 1, "specular": 0}
EARTH, SAND, CREAM = torch.tensor([(0.3, 0.08, 0.03), (0.85, 0.5, 0.24), (0.95, 0.9, 0.8)])
NIGHT = gv.Gradient((0.001, 0.001, 0.002), (0.003, 0.005, 0.012))


class Bands(torch.nn.Module):
    """Linear red, green and blue of bands that are bent by noise."""

    def forward(self, points):
        bend = gv.noise.fbm(gv.noise.warp(points * points.new_tensor([1.4, 4.2, 1.4])))
        y = (points[..., 1] + 0.06 * bend)[..., None]
        dark, light = 0.5 + 0.5 * (34 * y + 1).sin(), 0.5 + 0.5 * (11 * y + 1).cos()
        return SAND.to(y).lerp(EARTH.to(y), dark**2).lerp(CREAM.to(y), light**2)


def main(output: str = "hello_sphere.png", device: str = "cpu", size: int = 720) -> None:
    """Renders the planet, with three rays a pixel."""
    planet = gv.Painted(gv.sdf.Sphere(0.99), Bands())
    producer = gv.FieldProducer(gv.Solid(planet), 65536, box=BOX)
    engine = gv.Engine(producer, device=device, load_budget=4096)
    shader = gv.StoredColor("rgba", light=SUN, **PAINT)
    camera = gv.Camera.look_at((0, 0.5, 3.2), (0.1, 0, 0), (-0.4, 1, 0), 38, size * 16 // 9, size)
    mean = gv.Progressive(lambda view: engine.render(view, shader, cone_scale=2, background=NIGHT))
    mean.refine(camera, 3).save(output)
    print(f"{output}: {engine}")


tyro.cli(main)
