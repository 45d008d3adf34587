"""Cost pictures: their counts equal the kernel's, and closed forms."""

from __future__ import annotations

import pytest
import torch
from helpers import DEVICES
from helpers.traces import SHADER, arguments
from helpers.trees import copy_to

import gvtorch as gv
from gvtorch.ops import RayArguments, trace_segments

CAMERA = gv.Camera.orbit(30, 20, 1.3, width=24, height=24)


@pytest.mark.parametrize("lod", ["auto", "finest"])
def test_samples_are_those_of_the_picture(blobs, compiled, lod):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    soft = gv.TransferFunction.from_points([(0, 0), (0.2, 0), (1, 0.6)])
    drawn, counted = gv.render(tree, CAMERA, soft, lod=lod), gv.cost(tree, CAMERA, soft, lod=lod)
    different = drawn.samples != counted.samples
    assert different.sum() <= 0.01 * different.numel(), "rounding may move an end"
    assert counted.samples.max() > 10 and counted.stats.samples == counted.samples.sum()


HALF = torch.full((24, 24, 1), torch.inf)
HALF[:, 12:] = 30.0  # before the volume's middle
AROUND = {
    "clip": {"clip": gv.Clip(planes=[(1, 0, 0, -0.1)], frame="box")},
    "pieces": {
        "clip": gv.Clip(boxes=[((-1, -1, -1), (0, 1, 1)), ((0.2, -1, -1), (1, 1, 1))], frame="box")
    },
    "caps": {"clip": gv.Clip(planes=[(1, 0, 0, -0.1)], caps=True, frame="box")},
    "lens": {"lens": gv.ThinLens(aperture=0.8, focus=1.1, frame="box")},
    "layer": {"layer": gv.Layer(torch.zeros(24, 24, 3), HALF)},
    "translucent": {"layer": gv.Layer(torch.zeros(24, 24, 3), HALF, torch.full_like(HALF, 0.4))},
}


@pytest.mark.parametrize("name", [*AROUND, "lens, clip and layer"])
def test_what_is_put_around_rays_is_counted(blobs, compiled, name):
    """The samples are the picture's. Where a clip cuts, fewer nodes are visited; through a
    translucent layer the same matter is seen.
    """
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    soft = gv.TransferFunction.from_points([(0, 0), (0.2, 0), (1, 0.6)])
    every = AROUND["lens"] | AROUND["clip"] | AROUND["layer"]
    options = AROUND.get(name, every)
    extra = {} if name in AROUND else AROUND["lens"]
    drawn, counted = (f(tree, CAMERA, soft, **options) for f in (gv.render, gv.cost))
    whole = gv.cost(tree, CAMERA, soft, **extra)
    assert (drawn.samples != counted.samples).sum() <= 0.01 * 24 * 24, "rounding may move an end"
    assert torch.equal(counted.lod.isnan(), counted.lod.isnan() | (drawn.alpha == 0))
    nodes, levels = ([f(cost) for cost in (counted, whole)] for f in (_nodes, _level))
    if name == "translucent":
        torch.testing.assert_close(counted.lod, whole.lod, rtol=0, atol=0.02, equal_nan=True)
        assert nodes[0] >= nodes[1]
    elif name == "lens":
        assert levels[0] < levels[1] - 0.3, "what is blurred is coarser"
    else:
        assert 0.05 * nodes[1] < nodes[0] < 0.95 * nodes[1]


def _nodes(counted: gv.Cost) -> int:
    return int(counted.nodes.sum())


def _level(counted: gv.Cost) -> float:
    return float(counted.lod[~counted.lod.isnan()].mean())


def test_nodes_are_counted_up_to_where_a_ray_ends(blobs, compiled):
    """A haze ends no ray: all nodes of the walk count. A wall ends rays sooner."""
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    haze = gv.TransferFunction.from_points([(0, 0.001), (1, 0.002)])
    wall = gv.TransferFunction.from_points([(0, 1), (1, 1)])
    nodes = gv.cost(tree, CAMERA, haze, lod="finest").nodes
    rays = CAMERA.placed(tree.box).rays().to(tree.device)
    _, args = arguments(copy_to(tree, DEVICES[compiled]), 1, SHADER)
    hides_none = torch.arange(1, len(args.opaque_m) + 1, dtype=torch.int32, device=tree.device)
    args = args._replace(opaque_m=hides_none, table_lm4=args.table_lm4[:1], cone_scale=0.0)
    segments = trace_segments(RayArguments.of(rays), args)
    assert torch.equal(nodes.reshape(-1), segments.counts[:, 2]) and nodes.max() > 8
    first = gv.cost(tree, CAMERA, wall, lod="finest").nodes
    assert (first <= nodes).all() and first.max() == 1


def test_nothing_is_marked(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    before = {n: f.clone() for n, f in (tree.nodes.fields | tree.bricks.fields).items()}
    frame = tree.frame
    gv.cost(tree, CAMERA, SHADER, backend=backend)
    after = tree.nodes.fields | tree.bricks.fields
    assert tree.frame == frame and all(torch.equal(after[n], before[n]) for n in before)


def test_lod_is_the_depth_that_the_cone_wants(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    finest = gv.cost(tree, CAMERA, SHADER, lod="finest").lod
    assert abs(float(finest[~finest.isnan()].max()) - tree.depth) < 1e-5
    means = []
    for distance in (1.3, 5.0, 20.0):
        camera = gv.Camera.orbit(30, 20, distance, 30 / distance, 24, 24)
        lod = gv.cost(tree, camera, SHADER).lod
        means.append(float(lod[~lod.isnan()].mean()))
        wide = gv.Camera.orbit(30, 20, distance, width=24, height=24)
        assert gv.cost(tree, wide, SHADER).lod.nan_to_num().max() < tree.depth + 1e-5
    assert max(means) - min(means) < 0.5, "the same picture wants the same levels"
    far = gv.cost(tree, gv.Camera.orbit(30, 20, 60, 3, 24, 24), SHADER).lod
    assert (~far.isnan()).any() and far.nan_to_num().max() < min(means) - 1


@torch.no_grad()
def test_age_counts_frames_since_a_brick_was_written(blobs, compiled):
    with gv.Engine(
        gv.VolumeProducer(blobs), brick_size=4, node_pool="1 MB", brick_pool="4 MB",
        device=DEVICES[compiled],
    ) as engine:  # fmt: skip
        tree = next(iter(engine.trees.values())).tree
        engine.frame(CAMERA, SHADER)
        born = tree.bricks.born_b[tree.bricks.owner_b >= 0]
        assert (born <= 1).all(), "before the first frame only the root was written"
        while not engine.frame(CAMERA, SHADER)[1].converged:
            pass
        for _ in range(5):
            engine.frame(CAMERA, SHADER)
        age = gv.cost(tree, CAMERA, SHADER).age
        seen = age[~age.isnan()]
        assert seen.min() > 5 - 1e-4 and seen.max() < engine.frames
        other = gv.Camera.orbit(-150, 20, 1.3, width=24, height=24)
        assert sum(engine.frame(other, SHADER)[1].produced.values()) == 0
        for _ in range(4):  # the host may be ahead of the previous frame's counts
            _, stats = engine.frame(other, SHADER)
            if stats.produced["bricks"]:
                break
        assert stats.produced["bricks"] > 0
        fresh = gv.cost(tree, other, SHADER).age
        assert fresh[~fresh.isnan()].min() < 3 < seen.min()


def test_fill_is_the_share_of_voxels_that_show(compiled):
    """A slab through half of one brick."""
    data = torch.zeros(8, 8, 8)
    data[:4] = 1.0
    tree = gv.N3Tree.from_volume(gv.Volume(data), 8, device=DEVICES[compiled])
    shader = gv.TransferFunction.from_points([(0.4, 0), (0.6, 0.9)])
    counted = gv.cost(tree, CAMERA, shader)
    seen = ~counted.fill.isnan()
    assert seen.any() and (counted.fill[seen] - 0.5).abs().max() < 1e-5
    assert (counted.lod[seen] == 0).all()


@pytest.mark.backend("cpp")
def test_pictures_in_false_colours(blobs, tmp_path):
    tree = gv.N3Tree.from_volume(blobs, 4)
    counted = gv.cost(tree, CAMERA, SHADER)
    for name in ("samples", "nodes", "lod", "age", "fill"):
        picture = counted.picture(name)
        assert picture.color.shape == (24, 24, 3) and picture.to_srgb8().max() > 50
        valid = ~getattr(counted, name).float().isnan()
        assert (picture.color[~valid[..., 0]] == 0).all()
    picture.save(tmp_path / "cost.png")
    low, high = (counted.picture("samples", low=a, high=b) for a, b in ((0, 1e9), (-1e9, -1e8)))
    assert len(low.color.flatten(0, 1).unique(dim=0)) == 1
    assert not torch.equal(low.color, high.color), "the first and the last colour"
    both = gv.cost(tree, gv.Camera.orbit(30, 20, [1.3, 2.6], 30, 24, 24), SHADER)
    assert both.samples.shape == (2, 24, 24, 1)
    assert torch.equal(both.samples[0], counted.samples)


@pytest.mark.backend("cpp")
def test_mistakes_have_one_clear_message(blobs):
    tree = gv.N3Tree.from_volume(blobs, 8)
    counted = gv.cost(tree, CAMERA, SHADER)
    for call, message in (
        (lambda: gv.cost(blobs, CAMERA, SHADER), "cost: tree must be a N3Tree, got Volume"),
        (lambda: gv.cost(tree, CAMERA, 3), "cost: shader must be a TransferFunction, got int"),
        (lambda: gv.cost(tree, CAMERA, SHADER, colour=1), "cost: unknown option 'colour'"),
        (
            lambda: gv.cost(tree, CAMERA, SHADER, lighting=gv.Lighting()),
            "lighting needs normals",
        ),
        (
            lambda: counted.picture("heat"),
            "image must be 'samples', 'nodes', 'lod', 'age' or 'fill'",
        ),
        (lambda: counted.picture("lod", colormap="mud"), "unknown colormap 'mud'"),
    ):
        with pytest.raises(ValueError) as caught:
            call()
        assert message in str(caught.value) and "\n" not in str(caught.value)
