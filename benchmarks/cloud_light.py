"""How close `octaves` of scattering come to the ground truth: pictures of clouds are compared with
those of a path tracer in NumPy, which follows light through every scattering event.

The path tracer finds collisions by delta tracking, and estimates the sunlight at each of them by
ratio tracking (both unbiased); directions are drawn from Henyey and Greenstein's phase function.
Sources: Woodcock et al., ANL-7050, 1965; Novak, Selle, Jarosz, "Residual ratio tracking", SIGGRAPH
Asia 2014; Henyey, Greenstein, "Diffuse radiation in the galaxy", ApJ 93, 1941.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
import torch
import tyro
from tyro.conf import Positional

import gvtorch as gv


@dataclass
class Cloud:
    """A medium in a grid of voxels; lengths are voxels, the centre of voxel 0 lies at 0."""

    density: np.ndarray  # (x, y, z) extinction per voxel, zero at its faces
    albedo: float = 1.0
    g: float = 0.0  # mean cosine of scattering
    to_sun: np.ndarray = field(default_factory=lambda: np.array((0.0, 0.0, 1.0)))

    def at(self, points: np.ndarray) -> np.ndarray:
        """Returns (k,) extinction at places (k, 3): trilinear, 0 outside."""
        size = np.array(self.density.shape)
        inside = ((points > 0) & (points < size - 1)).all(1)
        p = np.clip(points, 0, size - 1.001)
        low = p.astype(np.int64)
        f = (p - low).astype(np.float32)
        x, y, z = low.T
        row = (x * size[1] + y) * size[2] + z
        flat, up, right = self.density.ravel(), size[2], size[1] * size[2]
        fx, fy, fz = f.T

        def line(begin: np.ndarray) -> np.ndarray:
            first = flat[begin]
            return first + fz * (flat[begin + 1] - first)

        near = line(row) + fy * (line(row + up) - line(row))
        far = line(row + right) + fy * (line(row + right + up) - line(row + right))
        return np.where(inside, near + fx * (far - near), 0)

    def exits(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Returns (k,) distances from places to where rays along `directions` leave the box."""
        size = np.array(self.density.shape) - 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.maximum((0 - points) / directions, (size - points) / directions)
        return np.nanmin(np.where(directions == 0, np.inf, ends), 1)

    def enters(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Returns (k,) distances to where rays enter the box; beyond `exits` if they miss it."""
        size = np.array(self.density.shape) - 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            begins = np.minimum((0 - points) / directions, (size - points) / directions)
        return np.maximum(np.where(directions == 0, -np.inf, begins).max(1), 0)


def phase(g: float, cosine: np.ndarray) -> np.ndarray:
    """Returns Henyey and Greenstein's function, scaled to mean 1 over all directions."""
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


def scatter(directions: np.ndarray, g: float, rng: np.random.Generator) -> np.ndarray:
    """Returns random directions (k, 3) after a scattering event."""
    u, angle = rng.random(len(directions)), 2 * np.pi * rng.random(len(directions))
    if abs(g) < 1e-3:
        cosine = 2 * u - 1
    else:
        cosine = (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * u)) ** 2) / (2 * g)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    x, y, z = directions.T
    sign = np.where(z >= 0, 1.0, -1.0)  # an orthonormal frame, without branches
    a = -1 / (sign + z)
    b = x * y * a
    u_axis = np.stack((1 + sign * x * x * a, sign * b, -sign * x), 1)
    v_axis = np.stack((b, sign + y * y * a, -y), 1)
    perpendicular = u_axis * np.cos(angle)[:, None] + v_axis * np.sin(angle)[:, None]
    return perpendicular * sine[:, None] + directions * cosine[:, None]


def track(
    cloud: Cloud, points: np.ndarray, directions: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (k,) distances to the next collision, and whether there is one inside the box."""
    peak = float(cloud.density.max())
    ends, t = cloud.exits(points, directions), np.zeros(len(points))
    hit = np.zeros(len(points), bool)
    live = np.arange(len(points))
    while len(live):
        t[live] -= np.log1p(-rng.random(len(live))) / peak
        live = live[t[live] < ends[live]]
        density = cloud.at(points[live] + t[live, None] * directions[live])
        real = rng.random(len(live)) * peak < density
        hit[live[real]] = True
        live = live[~real]
    return t, hit


def clearness(cloud: Cloud, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns (k,) estimates of the share of sunlight that reaches places, by ratio tracking."""
    peak = float(cloud.density.max())
    directions = np.broadcast_to(cloud.to_sun, points.shape)
    ends, t, clear = cloud.exits(points, directions), np.zeros(len(points)), np.ones(len(points))
    live = np.arange(len(points))
    while len(live):
        t[live] -= np.log1p(-rng.random(len(live))) / peak
        live = live[t[live] < ends[live]]
        clear[live] *= 1 - cloud.at(points[live] + t[live, None] * directions[live]) / peak
        kept = clear[live] > rng.random(len(live)) * 0.1  # roulette below a tenth
        clear[live] = np.where(clear[live] < 0.1, 0.1, clear[live])
        clear[live[~kept]] = 0
        live = live[kept]
    return clear


def path_trace(
    cloud: Cloud, eyes: np.ndarray, directions: np.ndarray, samples: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates the light that comes along rays (r, 3) from a sun of irradiance 4 pi.

    Returns:
        (r,) radiance, and (r,) its standard error.
    """
    rng = np.random.default_rng(seed)
    total, square = np.zeros(len(eyes)), np.zeros(len(eyes))
    for _ in range(samples):
        radiance = _paths(cloud, eyes, directions, rng)
        total, square = total + radiance, square + radiance**2
    mean = total / samples
    return mean, np.sqrt(np.maximum(square / samples - mean**2, 0) / max(samples - 1, 1))


def _paths(
    cloud: Cloud, eyes: np.ndarray, directions: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Returns (r,) radiance, estimated by one path of each ray."""
    light, begin = np.zeros(len(eyes)), cloud.enters(eyes, directions)
    alive = np.flatnonzero(begin < cloud.exits(eyes, directions))
    point, direction = eyes[alive] + begin[alive, None] * directions[alive], directions[alive]
    weight = 1.0
    while len(alive) and weight > 1e-3:
        t, hit = track(cloud, point, direction, rng)
        alive, point, direction = alive[hit], (point + t[:, None] * direction)[hit], direction[hit]
        weight *= cloud.albedo
        cosine = direction @ cloud.to_sun
        # `direction` is opposite to the light's: a ray on to the sun scatters forwards
        light[alive] += weight * phase(cloud.g, cosine) * clearness(cloud, point, rng)
        direction = scatter(direction, cloud.g, rng)
    return light


# --- comparison of pictures


def noisy(side: int = 48, seed: int = 7) -> np.ndarray:
    """Returns the density (x, y, z) of a round cloud of noise, 0 to 1, zero at the faces."""
    axis = (torch.arange(side) - (side - 1) / 2) / (side / 2)
    positions = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    noise = gv.noise.fbm(3 * positions, octaves=4, seed=seed)
    distance = (positions * torch.tensor([1.0, 1.3, 1.0])).norm(dim=-1)
    density = (3 * (0.7 - distance + 0.45 * noise)).clamp(0, 1).numpy()
    density[[0, -1]] = density[:, [0, -1]] = density[:, :, [0, -1]] = 0
    return density


def from_file(path: Path, side: int = 64) -> np.ndarray:
    """Returns a volume's density (x, y, z), 0 to 1, averaged to at most `side`, with a border."""
    volume = gv.read_volume(path).data[..., 0].permute(2, 1, 0).float()[None, None]
    step = -(-max(volume.shape) // side)
    size = [-(-n // step) * step for n in volume.shape[2:]]
    (a, b, c), (x, y, z) = size, volume.shape[2:]
    volume = torch.nn.functional.pad(volume, (0, c - z, 0, b - y, 0, a - x))
    coarse = torch.nn.functional.avg_pool3d(volume, step)
    coarse = torch.nn.functional.pad(coarse, (1,) * 6)[0, 0]
    return (coarse / coarse.max()).numpy()


def shader(cloud: Cloud, octaves: int) -> gv.Lit:
    """Returns the shader of a tree whose voxels hold the cloud's extinction."""
    peak = float(cloud.density.max())
    values = [peak * n / 256 for n in range(257)]
    albedo = (cloud.albedo,) * 3
    transfer = gv.TransferFunction(
        [(value, 1 - math.exp(-value)) for value in values], [(0.0, *albedo)], 1.0
    )
    sun = gv.DirectionalLight(tuple((-cloud.to_sun).tolist()))
    shading = {"ambient": 0.0, "diffuse": 1.0, "specular": 0.0, "anisotropy": cloud.g}
    return gv.Lit(transfer, light=sun, octaves=octaves, **shading)


def compare(cloud: Cloud, pixels: int, samples: int, octaves: list[int]) -> dict[int, list[float]]:
    """Returns by number of octaves: mean light, and rms difference without the path tracer's noise,
    both relative to the path tracer's mean light; of pixels with alpha > 0.05. 0: the noise.
    """
    tree = gv.N3Tree.from_volume(gv.Volume(cloud.density.transpose(2, 1, 0).copy()))
    camera = gv.Camera.orbit(30, 10, 1.3, fov=40, width=pixels * 4 // 3, height=pixels)
    rays = camera.placed(tree.box).rays()
    truth, error = path_trace(cloud, rays.origin.numpy(), rays.direction.numpy(), samples)
    results = {}
    for count in octaves:
        hits = gv.trace(tree, rays, shader(cloud, count), lod="finest", step=0.5, stop_alpha=0.999)
        visible = hits.alpha[:, 0].numpy() > 0.05
        light, expected = hits.color[:, 0].double().numpy()[visible], truth[visible]
        mse = ((light - expected) ** 2 - error[visible] ** 2).mean()
        results[count] = [light.mean() / expected.mean(), math.sqrt(max(mse, 0)) / expected.mean()]
    results[0] = [1.0, math.sqrt((error[visible] ** 2).mean()) / expected.mean()]
    return results


#: Directions to the sun: right, up, away from the camera.
SUNS = {"behind the eye": (0.5, 0.4, -0.8), "above": (0.2, 0.95, -0.1), "ahead": (-0.4, 0.3, 0.85)}


@dataclass
class Settings:
    """Prints Markdown: mean light and rms difference of a single scattering and of octaves."""

    files: Positional[tuple[Path, ...]] = ()
    """clouds to read, beside one of noise"""
    pixels: int = 24
    """height of a picture"""
    samples: int = 128
    """paths a pixel"""
    octaves: tuple[int, ...] = (1, 3, 5)
    optical: tuple[float, ...] = (0.3, 1.0)
    """largest extinction per voxel"""
    albedo: tuple[float, ...] = (1.0, 0.8)
    g: tuple[float, ...] = (0.0, 0.5, 0.85)
    """mean cosine of scattering"""


def main(settings: Settings) -> None:
    """Compares all clouds, and prints the table."""
    shapes = {"noise": noisy()} | {path.stem: from_file(path) for path in settings.files}
    titles = [f"octaves {n}" for n in settings.octaves]
    print("| cloud | extinction | albedo | g | sun | paths' noise |", " | ".join(titles), "|")
    print("|---" * (6 + len(titles)) + "|")
    errors: dict[int, list[float]] = {n: [] for n in settings.octaves}
    for name, shape in shapes.items():
        for max_extinction, albedo, g in product(settings.optical, settings.albedo, settings.g):
            for sun, direction in SUNS.items():
                to_sun = eye_to_world(np.array(direction))
                cloud = Cloud(max_extinction * shape, albedo, g, to_sun)
                results = compare(cloud, settings.pixels, settings.samples, list(settings.octaves))
                cells = [f"{results[n][0]:.2f} / {results[n][1]:.2f}" for n in settings.octaves]
                for n in settings.octaves:
                    errors[n].append(results[n][1])
                columns = (name, max_extinction, albedo, g, sun, f"{results[0][1]:.2f}")
                print("|", " | ".join(map(str, columns)), "|", " | ".join(cells), "|", flush=True)
    rms = [f"{math.sqrt(np.mean(np.square(errors[n]))):.2f}" for n in settings.octaves]
    print("| all | | | | | |", " | ".join(rms), "|")


def eye_to_world(direction: np.ndarray) -> np.ndarray:
    """Returns a unit vector (3,) in the world, from (right, up, away from the camera)."""
    camera = gv.Camera.orbit(30, 10, 1.3, width=3, height=3).placed(
        torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=torch.float64)
    )
    ahead = camera.rays().direction[4].numpy()
    right = np.cross(ahead, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    vector = direction[0] * right + direction[1] * np.cross(right, ahead) + direction[2] * ahead
    return vector / np.linalg.norm(vector)


if __name__ == "__main__":
    main(tyro.cli(Settings))
