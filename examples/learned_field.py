"""A small network learns a shape from samples, and is streamed as voxels: after 20, 80 and 240
steps, and the target. Any module that maps positions to values can be streamed like this."""

from copy import deepcopy
from dataclasses import replace

import torch
import tyro
from torch import nn

import gvtorch as gv

sdf = gv.sdf
BOX, SHOWN = ((-1.1, -1.1, -1.1), (1.1, 1.1, 1.1)), (20, 80, 240)
SUN = gv.DirectionalLight((0.8, -0.9, -0.7), (1.05, 0.82, 0.56), angle=8)
DAY = gv.DirectionalLight((-0.5, -1.0, 0.1), (0.07, 0.13, 0.26), angle=70)
LIGHT = gv.Lighting(lights=(SUN, DAY), ambient=(0.07, 0.09, 0.14))
GLAZE = {"lit": True, "ambient": 1, "diffuse": 1, "specular": 0.15, "shininess": 40}
LOOK = gv.StoredColor("rgba", premultiplied=True, **GLAZE)
WALL = gv.Gradient((0.012, 0.018, 0.03), (0.07, 0.08, 0.1))


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        hidden = [nn.Sequential(nn.Linear(n, 64), nn.SiLU()) for n in (33, 64, 64)]
        self.layers = nn.Sequential(*hidden, nn.Linear(64, 4))

    def surface(self, points):
        waves = [wave(points * 2**n) for n in range(5) for wave in (torch.sin, torch.cos)]
        made = self.layers(torch.cat((points, *waves), -1))
        return made[..., 0], made[..., 1:].sigmoid()


class Shown(nn.Module):
    def __init__(self, shape: nn.Module) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, points):
        distance, color = self.shape.surface(points)
        alpha = (0.5 - distance / 0.045).clamp(0, 1)[..., None]
        return {"rgba": torch.cat((color * alpha, alpha), -1)}

    def picture(self, width, height, extent, device):
        producer = gv.cache_field(self.to(device), extent, box=BOX, samples=1, threshold=0.0)
        engine = gv.Engine(producer, device=device)
        for part, mode in ((4, "converge"), (1, "interactive")):
            camera = gv.Camera.orbit(32, 24, 1.36, 34, width // part, height // part)
            options = {"background": WALL, "lighting": LIGHT, "cone_scale": 1.5 / part}
            picture = engine.render(camera, LOOK, mode, **options)
        return picture


def main(output: str = "learned_field.png", device: str = "cpu", size: int = 720) -> None:
    """Learns, and renders four pictures."""
    torch.manual_seed(1)
    aim = sdf.Sphere(0.3, color=(0.8, 0.78, 0.72)) | sdf.Torus(0.62, 0.15, color=(0.8, 0.13, 0.06))
    aim = aim | sdf.rotated(sdf.Torus(0.62, 0.15, color=(0.85, 0.55, 0.12)), (1, 0, 0), 90)
    aim = aim | sdf.rotated(sdf.Torus(0.62, 0.15, color=(0.05, 0.3, 0.42)), (0, 1, 0), 90)
    network, tiles, numbers = Network(), [], (-(-size * 8 // 9), size // 2, min(96, size), device)
    optimizer = torch.optim.Adam(network.parameters(), lr=4e-3)
    for step in range(1, SHOWN[-1] + 1):
        points = torch.rand(4 * size, 3) * 2.2 - 1.1
        (found, paint), (distance, color) = network.surface(points), aim.surface(points)
        near, apart = torch.exp(-4 * distance.abs()), (paint - color).abs().mean(-1)
        loss = (near * ((found - distance).abs() + 0.9 * apart)).mean()
        network.zero_grad()
        loss.backward()
        optimizer.step()
        if step in SHOWN:
            tiles.append(Shown(deepcopy(network)).picture(*numbers))
    tiles.append(Shown(aim).picture(*numbers))
    rows = [torch.cat([tile.color for tile in tiles[n : n + 2]], 1) for n in (0, 2)]
    replace(tiles[0], color=torch.cat(rows)).tone_map("aces").save(output)
    print(f"{output}: error {loss.item():.3f} after {SHOWN[-1]} steps")


tyro.cli(main)
