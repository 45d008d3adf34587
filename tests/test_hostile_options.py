"""Options as numbers of any kind: they mean the same, or are refused in one line. Objects that are
copied, closed twice or fail to be made again are still right.
"""

from __future__ import annotations

import copy
import io
import math
import pickle
import warnings
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY, assert_same_picture
from helpers.producers import SIZE

import gvtorch as gv
from gvtorch.engine.setup import brick_bytes

VIEW = gv.Camera.orbit(width=12, height=10)
PLANES = [(1, 0, 0, -5)]
SUN = gv.DirectionalLight((0, 0.3, -1), angle=5)


def lit(**lighting):
    return {"lighting": gv.Lighting(lights=[SUN], cones=2, **lighting)}


#: By name: options with a number, and a value of it that every kind of number holds exactly.
NUMBERS = {
    "step": (lambda v: {"step": v}, 0.5),
    "stop_alpha": (lambda v: {"stop_alpha": v}, 0.5),
    "depth_alpha": (lambda v: {"depth_alpha": v}, 0.25),
    "cone_scale": (lambda v: {"cone_scale": v}, 2.0),
    "aperture": (lambda v: {"lens": gv.ThinLens(aperture=v, focus=16)}, 2.0),
    "focus": (lambda v: {"lens": gv.ThinLens(aperture=2, focus=v)}, 16.0),
    "shadows": (lambda v: lit(shadows=v), 0.5),
    "occlusion": (lambda v: lit(occlusion=v), 0.5),
    "indirect": (lambda v: lit(indirect=v), 0.5),
    "reach": (lambda v: lit(occlusion=1, reach=v), 4.0),
    "cap_opacity": (lambda v: {"clip": gv.Clip(planes=PLANES, caps=True, cap_opacity=v)}, 0.5),
    "cap_light": (lambda v: {"clip": gv.Clip(planes=PLANES, caps=True, cap_light=v)}, 0.25),
}
KINDS = (np.float32, np.array, torch.tensor, Fraction, Decimal, lambda v: torch.tensor([v]))


@pytest.fixture(scope="module")
def volume() -> gv.Volume:
    noise = torch.rand((12, 10, 14, 1), generator=torch.Generator().manual_seed(0))
    return gv.Volume((noise * 255).to(torch.uint8))


@pytest.fixture(scope="module")
def tree(volume) -> gv.N3Tree:
    return gv.N3Tree.from_volume(volume, 4)


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_of_any_kind_gives_the_same_picture(tree, name):
    options, value = NUMBERS[name]
    shader = gv.Lit(gv.TransferFunction.preset("gray", 0, 255))
    expected = gv.render(tree, VIEW, shader, **options(value))
    for kind in KINDS:
        given = options(kind(value))
        assert_same_picture(gv.render(tree, VIEW, shader, **given), expected)
        assert repr(gv.RenderOptions(**given)) == repr(gv.RenderOptions(**options(value)))
    for wrong in (math.nan, math.inf, -1.0, "0.5", b"1 2", [1, 2], {}, 10**400):
        with pytest.raises(ValueError, match=name):
            gv.render(tree, VIEW, shader, **options(wrong))


@pytest.mark.parametrize("name", ["step", "stop_alpha", "depth_alpha", "cone_scale"])
def test_a_tracer_takes_the_same_numbers(tree, name):
    _, value = NUMBERS[name]
    shader = gv.TransferFunction.preset("gray", 0, 255)
    expected = gv.TreeTracer(tree, shader, **{name: value})
    for kind in KINDS:
        tracer = gv.TreeTracer(tree, shader, **{name: kind(value)})
        for a, b in zip(tracer(*tracer.rays(VIEW)), expected(*tracer.rays(VIEW)), strict=True):
            assert torch.equal(a, b)
    with pytest.raises(ValueError, match="TreeTracer: tree must be a N3Tree, got dict"):
        gv.TreeTracer({"a": tree}, shader)


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int16, np.int64, torch.tensor])
def test_sizes_may_be_small_integers(kind):
    volume = gv.Volume(torch.arange(300, dtype=torch.float32).view(1, 1, 300, 1))
    shader = gv.TransferFunction.preset("gray", 0, 300)
    sizes = {"brick_size": kind(100), "border": kind(15)}
    tree = gv.N3Tree.from_volume(volume, **sizes, branching=kind(3))
    assert tree.depth == 1 and tree.nodes.nodes_per_tile == 27
    assert gv.NodePool(kind(100), branching=kind(7)).child_tn.shape == (100, 343)
    budgets = dict.fromkeys(("load_budget", "subdivide_budget", "scout_rounds"), kind(100))
    with gv.Engine(gv.VolumeProducer(volume, branching=3), **sizes, **budgets) as engine:
        assert_same_picture(engine.render(VIEW, shader), gv.render(tree, VIEW, shader))


@pytest.mark.parametrize("name", ["patience", "time_budget", "coarse_share"])
def test_an_engine_takes_the_same_numbers(volume, name):
    for kind in KINDS:
        with gv.Engine(gv.VolumeProducer(volume), **SIZE, **{name: kind(0.5)}) as engine:
            assert engine.render(VIEW, GRAY).stats.converged
            assert getattr(engine.options, name) == 0.5 and repr(engine.scheduler)


def test_a_clip_takes_arrays(tree):
    box = [[2, 2, 2], [9, 9, 9]]
    expected = gv.render(tree, VIEW, GRAY, clip=gv.Clip(planes=PLANES, boxes=[box]))
    for kind in (np.array, torch.tensor):
        clip = gv.Clip(planes=kind(PLANES), boxes=kind([box]))
        assert_same_picture(gv.render(tree, VIEW, GRAY, clip=clip), expected)


def test_flags_lists_and_names_are_checked(tree, volume):
    engine, loc_t4 = gv.Engine(gv.VolumeProducer(volume), **SIZE), tree.nodes.loc_t4
    node = torch.zeros(1, dtype=torch.int64)
    for make, message in (
        (lambda: gv.Clip(caps="no"), "Clip: caps must be a bool, got str"),
        (lambda: gv.Clip(planes=torch.tensor(1.0)), "Clip: planes must be a list, got Tensor"),
        (lambda: gv.Clip(boxes=[np.array(1.0)]), r"boxes\[0\] must be two corners or a \(4, 4\)"),
        (lambda: gv.Channel(coarse="no"), "Channel: coarse must be a bool, got str"),
        (lambda: gv.N3Tree.from_volume({1: volume}), "name of a channel must be a str, got int"),
        (lambda: gv.render(tree, VIEW, GRAY, backend=["cpp"]), "backend must be a str, got list"),
        (lambda: gv.ops.locate(loc_t4, node, 2, 8, backend=["cpp"]), "backend must be auto, ref"),
        (lambda: gv.render(tree, VIEW, GRAY, progress=None), "render: progress must be a function"),
        (lambda: gv.cost(tree, VIEW, GRAY, progress=1), "cost: progress must be a function, got"),
        (lambda: gv.cost(tree, VIEW, GRAY).picture("lod", colormap=[]), r"unknown colormap \[\]"),
        (lambda: gv.N3Tree.from_volume(volume, progress=None), "from_volume: progress must be"),
        (lambda: engine.frame(VIEW, GRAY, progress=None), "frame: progress must be a function"),
        (lambda: engine.render(VIEW, GRAY, progress="x"), "render: progress must be a function"),
        (lambda: gv.BrickTable(np.zeros((1, 4, 4, 4, 1))), r"must be contiguous .*, got ndarray"),
        (lambda: gv.cost(tree, VIEW, GRAY).picture("lod", low=math.nan), "Cost: low must be"),
        (lambda: gv.cost(tree, VIEW, GRAY).picture("lod", high="a"), "Cost: high must be"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    table = gv.BrickTable(torch.zeros(2, 4, 4, 4, 1))
    for row in (0, [0], torch.tensor(0), torch.tensor([0.5]), torch.tensor([True, False])):
        with pytest.raises(ValueError, match=r"BrickTable: rows must be \(k,\) integers"):
            table[row]


def test_the_columns_of_rays_have_a_row_for_each(tree):
    rays = VIEW.placed(tree.box).rays()
    for shader in (GRAY, gv.ModuleShader(gv.TransferModule(GRAY, 1.0))):
        for column, message in (
            ({"transmittance": torch.ones(7)}, r"rays.transmittance must be \(120,\) float32"),
            ({"transmittance": torch.ones(120, 1)}, "rays.transmittance must be"),
            ({"sample": torch.zeros(120)}, r"rays.sample must be \(120,\) int64"),
        ):
            with pytest.raises(ValueError, match=f"trace: {message}"):
                gv.trace(tree, replace(rays, **column), shader)


def test_rays_through_trees_that_overlap_are_lit_as_in_a_picture(volume, tree):
    other = gv.N3Tree.from_volume(gv.Volume(volume.data.flip(0), origin=(6, 3, 2)))
    trees, shader = {"a": tree, "b": other}, gv.Lit(gv.TransferFunction.preset("gray", 0, 255))
    view = VIEW.placed(torch.stack((tree.box[0], other.box[1])))
    options = {"background": None, "lighting": gv.Lighting(occlusion=1, cones=3)}
    picture = gv.render(trees, view, shader, **options)
    hits = gv.trace(trees, view.rays(), shader, **options)
    assert torch.equal(picture.color.flatten(0, 1), hits.color)


def saved(tree):
    file = io.BytesIO()
    torch.save(tree, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda tree: pickle.loads(pickle.dumps(tree)), saved]
)
def test_a_copy_of_a_tree_knows_what_was_edited(volume, duplicate):
    """A copy's voxels lie elsewhere in memory, which is no edit."""
    tree = gv.N3Tree.from_volume(volume, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        other = duplicate(tree)
        gv.render(other, VIEW, GRAY)
    tree.bricks["value"][0] = 7
    for edited in (duplicate(tree), tree):
        with pytest.warns(UserWarning, match="bricks of value were edited"):
            gv.render(edited, VIEW, GRAY)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            gv.render(edited, VIEW, GRAY)  # each edit is reported once
            gv.render(duplicate(edited), VIEW, GRAY)


def test_a_failed_write_of_the_engine_is_no_edit(volume):
    tree = gv.N3Tree.from_volume(volume, 4)
    with pytest.raises(KeyError), tree.bricks.writing():
        tree.bricks["value"][0] = 7
        raise KeyError
    assert not tree.bricks.edited()


def test_closing_twice_leaves_a_producer_to_its_next_engine(volume):
    producer = gv.VolumeProducer(volume)
    first = gv.Engine(producer, **SIZE)
    first.close()
    with gv.Engine(producer, **SIZE) as second:
        first.close()
        assert producer.layout is not None
        assert second.render(VIEW, GRAY).stats.converged
    assert producer.layout is None
    with pytest.raises(ValueError, match="serves another engine, or another tree of this one"):
        gv.Engine({"a": producer, "b": producer}, **SIZE)
    assert producer.layout is None


def test_all_bricks_may_hold_coarse_channels(volume):
    """The finest level keeps a slot, however the pool's bytes divide."""
    shader = gv.Filtered(gv.TransferFunction.preset("gray", 0, 255))
    producer = gv.VolumeProducer(volume, filtered=shader)
    size = brick_bytes(producer.channels, gv.EngineOptions(brick_size=4))
    for share in (0.5, 1.0):
        options = {"brick_pool": 100 * size, "brick_size": 4, "coarse_share": share}
        with gv.Engine(producer, node_pool="1 MB", **options) as engine:
            assert engine.cache.bricks.capacity > engine.cache.bricks.coarse
            assert engine.frame(VIEW, shader)[1].failed == 0


class Moody(gv.Producer):
    """A ball that can't be made while `bad`."""

    def __init__(self):
        super().__init__(32, box=((-1, -1, -1), (1, 1, 1)))
        self.bad = False

    def fill(self, nodes):
        if self.bad:
            raise ZeroDivisionError("first line\nsecond line")
        return {"value": (1 - nodes.positions.norm(dim=-1)).clamp(min=0)}


def test_a_root_that_fails_to_be_made_again_is_told_by_tree():
    producer, shader = Moody(), gv.TransferFunction.preset("gray", 0, 1)
    with gv.Engine({"ball": producer}, **SIZE) as engine:
        expected = engine.render(VIEW, shader)
        producer.bad = True
        producer.changed()
        message = "the root of tree 'ball' can't be made: ZeroDivisionError: first line second"
        for _ in range(2):
            with pytest.raises(gv.ProductionError, match=message):
                engine.frame(VIEW, shader)
        producer.bad = False
        assert_same_picture(engine.render(VIEW, shader), expected)
        engine.validate()


def test_a_report_stays_as_it_was(volume):
    with gv.Engine(gv.VolumeProducer(volume), **SIZE) as engine:
        engine.frame(VIEW, GRAY)
        report = engine.report()
        engine.frame(VIEW, GRAY)
        assert report.as_dict()["frames"] == 1 and repr(report) == "Report(1 frames)"
