"""Shapes and fractals with NumPy references; boxes, points in them, and all nodes of a level."""

from __future__ import annotations

import numpy as np
import torch

import gvtorch as gv
from gvtorch.producers import Layout

sdf = gv.sdf
RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.3, 0.8)


def np_sphere(p, radius=0.7):
    return np.sqrt((p**2).sum(-1)) - radius


def np_box(p, size=(1.0, 0.6, 0.8), round=0.1):
    """Inside, by the nearest face; outside, by the nearest point of the inner box."""
    half_side = np.array(size) / 2 - round
    nearest = np.clip(p, -half_side, half_side)
    outside = np.sqrt(((p - nearest) ** 2).sum(-1))
    inside = (np.abs(p) - half_side).max(-1)
    return np.where(outside > 0, outside, inside) - round


def np_smooth(a, b, width):
    """Quilez' polynomial in its other form: max(width - |a - b|, 0)^2 / (4 width) below the min."""
    return np.minimum(a, b) - np.maximum(width - np.abs(a - b), 0) ** 2 / (4 * width)


def ball():
    return sdf.Sphere(0.7, color=RED)


def block():
    return sdf.Box((1.0, 0.6, 0.8), round=0.1, color=BLUE)


def np_torus(p, radius=0.6, tube=0.2):
    """By the nearest point of the ring's centre line, which is at the same angle."""
    angle = np.arctan2(p[:, 1], p[:, 0])
    ring = radius * np.stack((np.cos(angle), np.sin(angle), 0 * angle), 1)
    return np.linalg.norm(p - ring, axis=1) - tube


def np_capsule(p, a=(-0.3, 0.1, 0.2), b=(0.4, -0.2, 0.5), radius=0.25):
    along = np.array(b) - a
    share = np.clip((p - a) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - (np.array(a) + share[:, None] * along), axis=1) - radius


def np_gyroid(p, period=1.3):
    x, y, z = 2 * np.pi / period * p.T
    waves = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    return waves * period / (2 * np.pi * 3**0.5)


def np_cylinder(p, radius=0.4, half=0.5):
    """By the nearest point of the solid, or from within the nearest wall."""
    rho = np.hypot(p[:, 0], p[:, 1])
    outside = np.hypot(np.maximum(rho - radius, 0), np.maximum(np.abs(p[:, 2]) - half, 0))
    return np.where(outside > 0, outside, np.maximum(rho - radius, np.abs(p[:, 2]) - half))


def np_square_ring(p, radius=0.6):
    flat = np.stack((np.hypot(p[:, 0], p[:, 1]) - radius, p[:, 2], 0 * p[:, 0]), 1)
    return np_box(flat, (0.4, 0.3, 0.5), 0.05)


def np_repeated(p, counts=(4, 1, 0)):
    """By the nearest of all copies."""
    distance = np.full(len(p), np.inf)
    for x in range(-counts[0], counts[0] + 1):
        for y in range(-counts[1], counts[1] + 1):
            distance = np.minimum(distance, np_capsule(p - np.array((1.5 * x, 1.1 * y, 0))))
    return distance


def np_twisted(p, rate=1.5):
    angle = -rate * p[:, 2]
    x = np.cos(angle) * p[:, 0] - np.sin(angle) * p[:, 1]
    y = np.sin(angle) * p[:, 0] + np.cos(angle) * p[:, 1]
    return np_box(np.stack((x, y, p[:, 2]), 1))


def np_sponge(p, levels=3):
    """The maximum of a cube and of negated bars along all axes, of all sizes."""
    distance = np_box(p, (1, 1, 1), 0)
    for cell in 3.0 ** -np.arange(levels):
        x, y, z = np.abs((p + cell / 2) % cell - cell / 2).T
        for a, b in ((x, y), (y, z), (z, x)):
            distance = np.maximum(distance, cell / 6 - np.maximum(a, b))
    return distance


def np_turned(p, degrees=40):
    """About (1, 1, 1), by SciPy's convention: the angle of a rotation vector."""
    k, a = np.ones(3) / 3**0.5, np.deg2rad(-degrees)
    cross = np.cross(k, p)
    q = p * np.cos(a) + cross * np.sin(a) + k * (p @ k)[:, None] * (1 - np.cos(a))
    return np_box(q)


STRETCH = ((1.2, 0.3, 0.0), (0.0, 0.7, 0.0), (0.1, 0.0, 1.0))


def np_stretched(p):
    least = np.linalg.svd(np.array(STRETCH))[1].min()
    q = np.linalg.solve(np.array(STRETCH), (p - np.array((0.1, 0.2, -0.1))).T).T
    return least * np_box(q)


def capsule():
    return sdf.Capsule((-0.3, 0.1, 0.2), (0.4, -0.2, 0.5), 0.25, color=BLUE)


#: Name: the shape, and its value by NumPy.
SHAPES = {
    "sphere": (ball, np_sphere),
    "box": (block, np_box),
    "union": (lambda: ball() | block(), lambda p: np.minimum(np_sphere(p), np_box(p))),
    "intersection": (lambda: ball() & block(), lambda p: np.maximum(np_sphere(p), np_box(p))),
    "difference": (lambda: ball() - block(), lambda p: np.maximum(np_sphere(p), -np_box(p))),
    "smooth union": (
        lambda: sdf.SmoothUnion(ball(), block(), 0.3),
        lambda p: np_smooth(np_sphere(p), np_box(p), 0.3),
    ),
    "smooth intersection": (
        lambda: sdf.SmoothIntersection(ball(), block(), 0.3),
        lambda p: -np_smooth(-np_sphere(p), -np_box(p), 0.3),
    ),
    "smooth difference": (
        lambda: sdf.SmoothDifference(ball(), block(), 0.3),
        lambda p: -np_smooth(-np_sphere(p), np_box(p), 0.3),
    ),
    "torus": (lambda: sdf.Torus(0.6, 0.2), np_torus),
    "capsule": (capsule, np_capsule),
    "plane": (lambda: sdf.Plane((1, 2, -2), 0.3), lambda p: p @ [1 / 3, 2 / 3, -2 / 3] - 0.3),
    "gyroid": (lambda: sdf.Gyroid(1.3), np_gyroid),
    "gyroid shell": (
        lambda: sdf.Shell(sdf.Gyroid(1.3), 0.1) & ball(),
        lambda p: np.maximum(np.abs(np_gyroid(p)) - 0.05, np_sphere(p)),
    ),
    "sponge": (lambda: sdf.Menger(3), np_sponge),
    "extrusion": (lambda: sdf.Extrusion(sdf.Sphere(0.4), 1.0), np_cylinder),
    "revolution": (
        lambda: sdf.Revolution(sdf.Box((0.4, 0.3, 0.5), round=0.05), 0.6),
        np_square_ring,
    ),
    "offset": (lambda: sdf.Offset(block(), 0.1), lambda p: np_box(p) - 0.1),
    "shell": (lambda: sdf.Shell(block(), 0.1), lambda p: np.abs(np_box(p)) - 0.05),
    "moved": (
        lambda: sdf.moved(capsule(), 0.1, 0.2, -0.3),
        lambda p: np_capsule(p - [0.1, 0.2, -0.3]),
    ),
    "rotated": (lambda: sdf.rotated(block(), (1, 1, 1), 40), np_turned),
    "scaled": (lambda: sdf.scaled(block(), 0.5), lambda p: 0.5 * np_box(p / 0.5)),
    "stretched": (lambda: sdf.Transform(block(), STRETCH, (0.1, 0.2, -0.1)), np_stretched),
    "twist": (lambda: sdf.Twist(block(), 1.5), np_twisted),
    "repeated": (lambda: sdf.Repeat(capsule(), (1.5, 1.1, 0), (9, 3, 1)), np_repeated),
    "repeated for ever": (
        lambda: sdf.Repeat(capsule(), (1.5, 1.1, 0)),
        lambda p: np_repeated(p, (4, 4, 0)),
    ),
}


def np_escape(p, step, constant, iterations, bailout, estimate):
    """Iterates one point at a time; -1 where it does not escape."""
    values = np.full(len(p), -1.0)
    for row, point in enumerate(p):
        z, slope, c = point, 1.0, point if constant is None else np.array(constant)
        for iteration in range(iterations + 1):
            if np.linalg.norm(z) > bailout:
                values[row] = estimate(np.linalg.norm(z), slope)
                break
            if iteration < iterations:
                z, growth = step(z)
                z, slope = z + c, growth * slope + (constant is None)
    return values


def np_power(z, n):
    """White and Nylander's formula, with the angle from the z axis."""
    r, polar, azimuth = (
        np.linalg.norm(z),
        np.arctan2(np.hypot(z[0], z[1]), z[2]),
        np.arctan2(z[1], z[0]),
    )
    turned = np.sin(n * polar) * np.cos(n * azimuth), np.sin(n * polar) * np.sin(n * azimuth)
    return r**n * np.array((*turned, np.cos(n * polar))), n * r ** (n - 1)


def np_fold(z, scale):
    z = np.array([2 - v if v > 1 else -2 - v if v < -1 else v for v in z])
    r = np.linalg.norm(z)
    growth = 4.0 if r < 0.5 else 1 / r**2 if r < 1 else 1.0
    return scale * growth * z, abs(scale) * growth


def np_log(r, slope):
    return r * np.log(r) / (2 * slope)


#: Name: the fractal, and its value by NumPy.
FRACTALS = {
    "bulb": (
        lambda: gv.Mandelbulb(8, iterations=6),
        lambda p: np_escape(p, lambda z: np_power(z, 8), None, 6, 2.0, np_log),
    ),
    "bulb of 3": (
        lambda: gv.Mandelbulb(3, iterations=7),
        lambda p: np_escape(p, lambda z: np_power(z, 3), None, 7, 2.0, np_log),
    ),
    "julia": (
        lambda: gv.Julia((-0.2, 0.5, 0.3), 2, iterations=9),
        lambda p: np_escape(p, lambda z: np_power(z, 2), (-0.2, 0.5, 0.3), 9, 2.0, np_log),
    ),
    "mandelbox": (
        lambda: gv.Mandelbox(2.0, iterations=12),
        lambda p: np_escape(p, lambda z: np_fold(z, 2.0), None, 12, 10.8, np.divide),
    ),
}
ALL = {**SHAPES, **FRACTALS}


def random_points(count, side=4.0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return side * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)


#: Number of boxes in which bounds are tested.
BOXES = 50_000


def random_boxes(count, seed=1):
    """Returns centres and half sides, from large to tiny, most of them near the origin."""
    generator = torch.Generator().manual_seed(seed)
    half = 10 ** (-3 * torch.rand(count, 1, generator=generator, dtype=torch.float64))
    shape = 0.2 + torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return random_points(count, 3.0, seed + 1), half * shape


def points_inside(center, half, count, seed=3):
    """Returns (k, count, 3) points of boxes: their corners, and random ones."""
    corners = torch.cartesian_prod(*(torch.tensor([-1.0, 1.0], dtype=torch.float64),) * 3)
    generator = torch.Generator().manual_seed(seed)
    others = 2 * torch.rand(len(center), count - 8, 3, generator=generator).double() - 1
    offsets = torch.cat((corners.expand(len(center), 8, 3), others), 1)
    return center[:, None] + half[:, None] * offsets


def nodes_of(producer, depth, brick_size=4, border=1):
    """Returns all nodes of a level."""
    layout = Layout.of(producer, brick_size, border, torch.device("cpu"))
    axis = torch.arange(producer.branching**depth)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    loc = torch.stack((x, y, z, torch.full_like(x, depth)), -1).flatten(0, 2)
    return gv.Nodes(loc, layout)
