"""Mountains in the evening sun: octaves of noise, damped where the ground is steep."""

from dataclasses import replace

import torch
import tyro
from torch.nn.functional import pad

import gvtorch as gv

noise, tensor, normalize = gv.noise, torch.tensor, torch.nn.functional.normalize
BOX, EXTENT = ((-4.0, 0.0, -8.0), (4.0, 1.6, 2.0)), (1229, 246, 1536)  # y up
EYE, TARGET = (0.0, 1.05, 2.6), (0.1, 0.7, -1.6)
SUN = gv.DirectionalLight((0.86, -0.3, 0.42), (4.0, 2.1, 0.95), angle=2)
DAY = gv.DirectionalLight((-0.3, -1.0, -0.2), (0.2, 0.36, 0.8), angle=60)  # the whole blue sky
LIGHT = gv.Lighting(lights=(SUN, DAY), ambient=(0.07, 0.1, 0.18))
SNOW, ROCK, GRASS = tensor([(0.9, 0.92, 0.95), (0.23, 0.2, 0.19), (0.17, 0.16, 0.09)])
OFFSETS = tensor([(0.0, 0.0), (0.01, 0.0), (0.0, 0.01)])
HAZE, GLOW, ZENITH = tensor([(0.2, 0.26, 0.4), (2.2, 0.85, 0.25), (0.02, 0.06, 0.2)])


def height(x, z):
    total = slope = 0
    for n in range(11):
        p = 0.8 * 2**n * torch.stack((0.6 * x - 0.8 * z, 0.8 * x + 0.6 * z), -1)
        here, *ahead = (noise.perlin(p + offset, seed=n + 3) for offset in OFFSETS)
        slope = 0.8 * slope + 100 * torch.stack([value - here for value in ahead])
        total = total + here / 2**n / (1 + 0.6 * slope.square().sum(0))
    return 0.42 + 0.83 * total


def fade(start, end, value):
    return 0.5 - 0.5 * (torch.pi * ((value - start) / (end - start)).clamp(0, 1)).cos()


class Ground(gv.Producer):
    def classify(self, nodes):  # no slope is steeper than 4
        (low, high), share = nodes.box.float().unbind(1), torch.linspace(0, 1, 9)
        x, z = (low[:, n, None] + (high - low)[:, n, None] * share for n in (0, 2))
        ground, gap = height(x[:, None, :], z[:, :, None]).flatten(1), (high - low)[:, 0] / 2
        return torch.where(ground.amax(1) + gap < low[:, 1], gv.Region.EMPTY, gv.Region.DATA)

    def fill(self, nodes):
        p = nodes.wider(1).positions[:, :, 1].float()  # (k, z, x, 3): heights do not depend on y
        ground, side = height(p[..., 0], p[..., 2]), nodes.voxel_size[:, 0, None, None].float()
        slope = torch.stack(torch.gradient(ground, dim=(2, 1)), -1)[:, 1:-1, 1:-1] / side[..., None]
        normal = normalize(pad(-slope, (1, 0), value=1)[..., [1, 0, 2]], dim=-1)
        level, flatness = ground[:, 1:-1, 1:-1, None], normal[..., 1:2]
        roughness = noise.fbm(9 * p[:, 1:-1, 1:-1, ::2], octaves=4)[..., None]
        color = ROCK.lerp(GRASS, fade(0.62, 0.8, flatness + 0.05 * roughness))
        snow = fade(0.62, 0.78, level + 0.12 * roughness) * fade(0.5, 0.66, flatness)
        gap = (nodes.positions[..., 1:2].float() - level[:, :, None]) * flatness[:, :, None]
        alpha = (0.5 - gap / side[..., None, None]).clamp(0, 1)
        rgba = pad(color.lerp(SNOW, snow), (0, 1), value=1)[:, :, None] * alpha
        packed_normal = (127 * normal[:, :, None]).round().char().expand(*alpha.shape[:4], 3)
        return {"rgba": rgba.half(), "normal": packed_normal}


def main(output: str = "terrain.png", device: str = "cpu", size: int = 720) -> None:
    channels = {"rgba": gv.Channel(torch.float16, 4), "normal": gv.Channel(torch.int8, 3)}
    camera = gv.Camera.look_at(EYE, TARGET, (0, 1, 0), 40, size * 16 // 9, size)
    ground = Ground(EXTENT, channels=channels, box=BOX)
    engine = gv.Engine(ground, device=device, brick_pool="512 MB")
    shading = {"normals": "normal", "ambient": 1, "diffuse": 1, "specular": 0}
    shader = gv.StoredColor("rgba", premultiplied=True, **shading)
    picture = engine.render(camera, shader, lighting=LIGHT, background=None, cone_scale=1.2)
    ray = camera.rays().direction.float().reshape(*picture.color.shape)
    sun, up = (ray * -normalize(tensor(SUN.direction), dim=0)).sum(-1, True), ray[..., 1:2].clamp(0)
    haze, plane = HAZE.lerp(GLOW, (0.5 + 0.5 * sun) ** 3), ray[..., ::2] / (up + 0.08)
    streaks = noise.fbm(noise.warp(plane * tensor([0.5, 1.3]), amplitude=0.5), octaves=6, seed=2)
    cirrus = fade(-0.1, 0.7, streaks)[..., None] * fade(0.0, 0.12, up)
    sky = haze.lerp(ZENITH, 1 - (-4 * up).exp()).lerp(1.5 * haze + 0.1, 0.45 * cirrus)
    depth, alpha = picture.depth.cpu().clamp(max=30), picture.alpha.cpu()
    mist = 0.035 + 0.22 * (-7 * (EYE[1] + ray[..., 1:2] * depth).clamp(0, 2)).exp()
    color = haze.lerp(picture.color.cpu(), (-depth * mist).exp()) * alpha + sky * (1 - alpha)
    replace(picture, color=color, alpha=torch.ones_like(alpha)).tone_map("aces").save(output)
    print(f"{output}: {engine}")


tyro.cli(main)
