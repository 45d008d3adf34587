"""`Hypertexture` against its formula in NumPy, with and without the octaves that can't matter."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import meshes, numpy_noise

import gvtorch as gv
from gvtorch.producers import Layout

sdf = gv.sdf
ROUGH = {"thickness": 0.3, "amplitude": 1.0, "frequency": 2.5, "octaves": 6, "softness": 0.05}
SIZES = {"gain": 0.55, "lacunarity": 2.1, "seed": 4}


def rough(extent=256, shape=None, **options):
    """Returns a rough ball, prepared to make bricks of 8^3 and a border of 1."""
    options = {"dtype": torch.float32, **ROUGH, **options}
    producer = gv.Hypertexture(shape or sdf.Sphere(1.0), extent, **options)
    producer.prepare(Layout.of(producer, 8, 1, torch.device("cpu")))
    return producer


def some_nodes(producer, depth, count, seed=0):
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    random = torch.Generator().manual_seed(seed)
    loc = torch.randint(0, 2**depth, (count, 3), generator=random)
    return gv.Nodes(torch.cat((loc, torch.full((count, 1), depth)), 1), layout)


def with_data(producer, depth, count):
    """Returns random nodes of a depth that are neither empty nor full."""
    nodes = some_nodes(producer, depth, 40 * count)
    data = producer.classify(nodes).kind == int(gv.Region.DATA)
    return nodes[data.nonzero()[:, 0][:count]]


def by_formula(point, side, radius=1.0):
    """Returns the density of a voxel by plain numbers, see the class."""
    options = {**ROUGH, **SIZES}
    total = -(math.dist(point, (0, 0, 0)) - radius) / options["thickness"]
    variance = options["softness"] ** 2 / 5 + (side / options["thickness"]) ** 2 / 12
    for octave in range(options["octaves"]):
        frequency = options["frequency"] * options["lacunarity"] ** octave
        amplitude = options["amplitude"] * options["gain"] ** octave
        share = math.exp(-0.82 * (side * frequency) ** 2) if side * frequency <= 1.5 else 0.0
        variance += amplitude**2 * 0.0728 * (1 - share**2)
        scaled = [c * frequency for c in point]
        noise = numpy_noise.perlin(scaled, options["seed"] + octave * 0x10001) if share else 0.0
        total += amplitude * share * noise
    soft = math.sqrt(5 * variance)
    t = min(max((total - 0.5 + soft) / (2 * soft), 0.0), 1.0)
    return t * t * (3 - 2 * t)


@pytest.mark.parametrize("depth", [1, 3, 5])
def test_voxels_are_those_of_the_formula(depth):
    producer = rough(**SIZES)
    nodes = with_data(producer, depth, 30)
    density = producer.fill(nodes)["density"]
    random = np.random.default_rng(depth)
    partly = ((density > 0) & (density < 1)).nonzero().numpy()
    assert len(partly) > 300
    for k, z, y, x, _ in random.permutation(partly)[:60]:
        side = float(nodes.voxel_size[k, 0])
        mid = nodes.center[k] + nodes.local_positions[k, z, y, x]
        assert float(density[k, z, y, x]) == pytest.approx(by_formula(mid.tolist(), side), abs=2e-4)


def test_values_at_points_are_those_of_the_formula():
    random = torch.Generator().manual_seed(2)
    points = (torch.rand((100, 3), generator=random, dtype=torch.float64) - 0.5) * 2.6
    values = rough(**SIZES, distances=True).at(points)
    expected = [by_formula(point, 0.0) for point in points.tolist()]
    assert values["density"][:, 0].tolist() == pytest.approx(expected, abs=1e-9)
    torch.testing.assert_close(values["distance"][:, 0], points.norm(dim=1) - 1)


@pytest.mark.parametrize("softness", [0.05, 0.3])
def test_voxels_are_means(softness):
    """Means of 512 values in their cubes: the error is below 0.6 of that of the middle's value."""
    producer = rough(softness=softness)
    random = torch.Generator().manual_seed(1)
    for depth in range(1, 6):
        nodes = with_data(producer, depth, 100)
        density = producer.fill(nodes)["density"]
        rows = ((density > 0.003) & (density < 0.997)).nonzero()
        rows = rows[torch.randperm(len(rows), generator=random)[:400]]
        positions = nodes.positions[tuple(rows[:, :4].T)].double()
        spread = torch.rand((len(rows), 512, 3), generator=random, dtype=torch.float64) - 0.5
        sides = nodes.voxel_size[rows[:, 0]][:, None]
        mean = producer.at(positions[:, None] + spread * sides)["density"].mean(1)[:, 0]
        error = density[tuple(rows.T)] - mean
        assert error.abs().mean() < 0.07 and abs(error.mean()) < 0.025
        middle = producer.at(positions)["density"][:, 0] - mean
        assert error.abs().mean() < 0.6 * middle.abs().mean()


@pytest.mark.parametrize("depth", range(6))
def test_octaves_that_cannot_matter_change_no_bit(depth):
    producer = rough(shape=sdf.Sphere(0.8) - sdf.Box((0.5, 0.5, 3.0)))
    nodes = with_data(producer, depth, 300 if depth > 1 else 1)
    skipped = producer.fill(nodes)["density"]
    evaluations = producer.evaluations
    assert (
        evaluations
        <= producer.plain_evaluations
        == 1000 * len(nodes) * len(producer.level_of(depth).octaves)
    )
    producer.skip = False
    assert torch.equal(producer.fill(nodes)["density"], skipped)
    assert producer.evaluations - evaluations == producer.plain_evaluations / 2
    if depth > 3:
        assert evaluations < 0.5 * producer.plain_evaluations / 2


def test_pictures_have_the_same_bits_with_and_without_them():
    shader = gv.Isosurface(0.5)
    camera = gv.Camera.orbit(30, 20, 1.2, width=64, height=48)
    pictures, saved = [], []
    for skip in (True, False):
        producer = gv.Hypertexture(sdf.Sphere(1.0), 128, skip=skip, **ROUGH)
        pictures.append(gv.Engine(producer).render(camera, shader))
        saved.append(producer.saved)
    assert torch.equal(pictures[0].color, pictures[1].color) and pictures[0].color.std() > 0.05
    assert saved[0] > 0.3 and saved[1] == 0


@pytest.mark.parametrize("softness", [0.05, 0.6])
def test_what_is_called_empty_or_full_is_so_at_all_levels(softness):
    producer = rough(softness=softness, thickness=0.08)
    random, counts = torch.Generator().manual_seed(5), {0: 0, 1: 0}
    for depth in range(1, 6):
        nodes = some_nodes(producer, depth, 3000)
        kind = producer.classify(nodes).kind
        for region, value in ((gv.Region.EMPTY, 0.0), (gv.Region.CONSTANT, 1.0)):
            proven = nodes[(kind == int(region)).nonzero()[:, 0]]
            counts[int(region)] += len(proven)
            for below in range(depth, 6):  # itself and a random one below it at every level
                down = 2 ** (below - depth)
                inner = torch.randint(0, down, (len(proven), 3), generator=random)
                loc = torch.cat((proven.loc[:, :3] * down + inner, 0 * inner[:, :1] + below), 1)
                filled = producer.fill(gv.Nodes(loc[:200], proven.layout))["density"]
                assert bool((filled == value).all())
    assert min(counts.values()) > 50


def test_nothing_reaches_beyond_the_box():
    producer = rough(octaves=3)
    half = float(torch.tensor(producer.spacing).mul(torch.tensor(producer.extent)).max()) / 2
    away = torch.randn((100_000, 3), generator=torch.Generator().manual_seed(0))
    away = away / away.abs().amax(1, keepdim=True) * half  # on the faces
    assert producer.at(away)["density"].max() == 0


def test_channels_and_places():
    producer = rough(distances=True, box=((-2, -2, -1), (2, 2, 1)), extent=64)
    assert producer.extent == (64, 64, 32) and list(producer.channels) == ["density", "distance"]
    nodes = with_data(producer, 2, 8)
    values = producer.fill(nodes)
    right = nodes.positions.norm(dim=-1, keepdim=True) - 1
    torch.testing.assert_close(values["distance"], right)


def test_distances_beyond_halves_are_the_largest_half():
    shape = gv.sdf.Sphere(3e5)
    options = {"thickness": 1e5, "frequency": 1e-5, "dtype": torch.float16}
    producer = rough(64, shape, distances=True, **options)
    distances = producer.fill(with_data(producer, 0, 8))["distance"]
    assert distances.isfinite().all() and distances.aminmax() == (-65504, 65504)


def test_a_volume_of_distances_stands_for_the_shape():
    axis = torch.linspace(-1.5, 1.5, 61)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    ball = torch.stack((x, y, z), -1).norm(dim=-1) - 1
    volume = gv.Volume(ball, spacing=(0.05,) * 3, origin=(-1.5,) * 3)
    shape = gv.SampledDistance(volume)
    random = torch.Generator().manual_seed(0)
    points = (torch.rand((5000, 3), generator=random, dtype=torch.float64) - 0.5) * 6
    inside = (points.abs() < 1.5).all(1)
    away = (shape(points) - (points.norm(dim=1) - 1)).abs()
    assert away[inside & (points.norm(dim=1) > 0.3)].max() < 2e-3
    nearest = points.clamp(-1.5, 1.5)
    beyond = (points - nearest).norm(dim=1) + nearest.norm(dim=1) - 1
    torch.testing.assert_close(shape(points)[~inside], beyond[~inside], atol=1e-3, rtol=0)
    assert 1 <= shape.steepest <= 3**0.5 and 1 <= shape.apart <= 1.14
    half = torch.rand((5000, 3), generator=random, dtype=torch.float64) * 0.5
    low, high = shape.bounds(points, half)
    for _ in range(20):
        spread = torch.rand((5000, 3), generator=random, dtype=torch.float64) * 2 - 1
        values = shape(points + spread * half)
        assert bool(((low <= values) & (values <= high)).all())
    producer = rough(shape=shape, box=((-1.5,) * 3, (1.5,) * 3))
    nodes = with_data(producer, 4, 40)
    plain = rough(box=((-1.5,) * 3, (1.5,) * 3))
    error = (producer.fill(nodes)["density"] - plain.fill(nodes)["density"]).abs()
    assert error.max() < 0.05 and error.mean() < 1e-3


@pytest.mark.parametrize("name", ["ball", "torus"])
def test_distances_to_a_mesh(name):
    """Against closed forms: exact near the surface, propagated further away."""
    mesh, distance = {
        "ball": (meshes.sphere(4), lambda p: p.norm(dim=1) - 1),
        "torus": (
            meshes.torus(),
            lambda p: torch.hypot(torch.hypot(p[:, 0], p[:, 1]) - 1, p[:, 2]) - 0.4,
        ),
    }[name]
    shape = gv.SampledDistance.of_mesh(mesh, resolution=32, reach=0.3)
    random = torch.Generator().manual_seed(0)
    points = 4 * torch.rand((50_000, 3), generator=random, dtype=torch.float64) - 2
    low, high = shape.box()
    points = points[((points >= low) & (points <= high)).all(1)]
    right = distance(points) / shape.spacing[0]
    error = (shape(points) / shape.spacing[0] - right).abs()  # in voxels
    assert error[right.abs() < 2].max() < 0.15 and error.mean() < 0.1 and error.max() < 0.8
    assert bool(((shape(points) < 0) == (right < 0))[right.abs() > 0.1].all())
    assert right.max() > 8, "the volume goes on around the mesh"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: gv.SampledDistance.of_mesh(meshes.sphere(1), reach=-1),
            "SampledDistance: reach must be finite and >= 0 and <= 4, got -1",
        ),
        (lambda: rough(thickness=0), "Hypertexture: thickness must be finite and > 0, got 0"),
        (lambda: rough(softness=math.nan), "Hypertexture: softness must be finite and > 0, got na"),
        (
            lambda: rough(dtype=torch.uint8),
            "Hypertexture: dtype must be one of floats, got torch.u",
        ),
        (lambda: rough(octaves=0), "Hypertexture: octaves must be an int >= 1 and <= 64, got 0"),
        (lambda: rough(shape=torch.nn.ReLU()), "Hypertexture: shape must be a Distance, got ReLU"),
        (lambda: rough(shape=gv.sdf.Negative(sdf.Sphere())), "Hypertexture: box must be given"),
        (
            lambda: gv.SampledDistance(gv.Volume(torch.zeros(3, 3, 1))),
            "SampledDistance: volume must have 1 number a voxel and at least 2 voxels along each",
        ),
    ],
)
def test_bad_input_gives_one_clear_line(call, message):
    with pytest.raises(ValueError, match="must") as error:
        call()
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_places_are_exact_in_deep_trees():
    """2^36 voxels a side: float32 would resolve positions only to 1000 of them."""
    producer = rough(extent=2**36, octaves=3, distances=True)
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    side = producer.spacing[0]
    for direction in ((1.0, 0.0, 0.0), (0.6, -0.48, 0.64)):
        unit = torch.tensor(direction, dtype=torch.float64)
        low, high = 0.5, 1.5  # where density passes 1/2 on this ray
        for _ in range(60):
            middle = (low + high) / 2
            inside = producer.at(unit * middle)["density"] > 0.5
            low, high = (middle, high) if inside else (low, middle)
        voxel = ((unit * low - torch.tensor(producer.origin).double()) / side).long()
        loc = torch.cat((voxel // 8, torch.tensor([layout.depth])))[None]
        nodes = gv.Nodes(loc, layout)
        assert producer.classify(nodes).kind.item() == int(gv.Region.DATA)
        values = producer.fill(nodes)
        points = nodes.center[:, None, None, None] + nodes.local_positions
        right = producer.at(points)
        torch.testing.assert_close(values["density"].double(), right["density"], atol=1e-6, rtol=0)
        assert abs(float(values["density"].mean()) - 0.5) < 1e-4
