"""A small network learns a shape from samples, and is streamed as voxels: after 20, 80 and 240
steps, and the target. Any module that maps positions to values can be streamed like this."""

from copy import deepcopy
from dataclasses import replace

import torch
import tyro
from torch import nn

import gvtorch as gv

sdf = gv.sdf
BOX, PICTURE_STEPS = ((-1.1, -1.1, -1.1), (1.1, 1.1, 1.1)), (20, 80, 240)
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
        outputs = self.layers(torch.cat((points, *waves), -1))
        return outputs[..., 0], outputs[..., 1:].sigmoid()


class ColorField(nn.Module):
    def __init__(self, shape: nn.Module) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, points):
        distance, color = self.shape.surface(points)
        alpha = (0.5 - distance / 0.045).clamp(0, 1)[..., None]
        return {"rgba": torch.cat((color * alpha, alpha), -1)}

    def picture(self, width, height, extent, device):
        producer = gv.FieldProducer(self.to(device), extent, box=BOX, samples=1, threshold=0.0)
        engine = gv.Engine(producer, device=device)
        for divisor, mode in ((4, "converge"), (1, "interactive")):
            camera = gv.Camera.orbit(32, 24, 1.36, 34, width // divisor, height // divisor)
            options = {"background": WALL, "lighting": LIGHT, "cone_scale": 1.5 / divisor}
            picture = engine.render(camera, LOOK, mode, **options)
        return picture


def main(output: str = "learned_field.png", device: str = "cpu", size: int = 720) -> None:
    """Learns, and renders four pictures."""
    torch.manual_seed(1)
    goal = sdf.Sphere(0.3, color=(0.8, 0.78, 0.72)) | sdf.Torus(0.62, 0.15, color=(0.8, 0.13, 0.06))
    goal = goal | sdf.rotated(sdf.Torus(0.62, 0.15, color=(0.85, 0.55, 0.12)), (1, 0, 0), 90)
    goal = goal | sdf.rotated(sdf.Torus(0.62, 0.15, color=(0.05, 0.3, 0.42)), (0, 1, 0), 90)
    network, tiles, arguments = Network(), [], (-(-size * 8 // 9), size // 2, min(96, size), device)
    optimizer = torch.optim.Adam(network.parameters(), lr=4e-3)
    for step in range(1, PICTURE_STEPS[-1] + 1):
        points = torch.rand(4 * size, 3) * 2.2 - 1.1
        (guess, guess_color), (distance, color) = network.surface(points), goal.surface(points)
        weight, color_error = torch.exp(-4 * distance.abs()), (guess_color - color).abs().mean(-1)
        loss = (weight * ((guess - distance).abs() + 0.9 * color_error)).mean()
        network.zero_grad()
        loss.backward()
        optimizer.step()
        if step in PICTURE_STEPS:
            tiles.append(ColorField(deepcopy(network)).picture(*arguments))
    tiles.append(ColorField(goal).picture(*arguments))
    rows = [torch.cat([tile.color for tile in tiles[n : n + 2]], 1) for n in (0, 2)]
    replace(tiles[0], color=torch.cat(rows)).tone_map("aces").save(output)
    print(f"{output}: error {loss.item():.3f} after {PICTURE_STEPS[-1]} steps")


tyro.cli(main)
