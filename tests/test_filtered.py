"""`Filtered`: transfer functions seen from afar. Every backend gives the twin's bits, and pictures
equal those of 256 rays a pixel.
"""

from __future__ import annotations

import functools
import math

import pytest
import torch
from helpers.afar import assert_same_bits, compare, filtered, matter, picture, rays, walls
from helpers.packets import INSTRUCTIONS, result, start
from helpers.rays import camera_rays
from helpers.traces import SHADER, trace

import gvtorch as gv
from gvtorch.shaders import coarse_colors

MISTY = gv.TransferFunction(
    [(0.2, 0), (0.5, 0.02), (0.9, 0.08)], [(0.2, 1, 0.3, 0.1), (1, 1, 1, 1)]
)


@pytest.mark.parametrize(
    ("directions", "branching", "dtype"),
    [  # any two of the options meet in every way
        *((True, 2, torch.float32), (True, 3, torch.float64)),
        *((False, 2, torch.float64), (False, 3, torch.float32)),
    ],
)
def test_compiled_equals_reference(compiled, directions, branching, dtype):
    tree, shader = filtered(SHADER, directions=directions, branching=branching)
    for distance, step in ((0.3, 0.5), (1.3, 0.4), (5.0, 2.3)):
        hits = assert_same_bits(tree, compiled, distance, shader, dtype=dtype, step=step)
        if distance == 1.3:
            assert hits["alpha"].max() > 0.3, "the test must see something"


def all_shaded() -> list[torch.Tensor]:
    return shaded("cpp")


def shaded(backend: str) -> list[torch.Tensor]:
    """Returns all that traces of a plain and a lit function write."""
    results, lamp = [], gv.PointLight((0.0, 40.0, 60.0), (1.0, 0.9, 0.8))
    for base_shader in (SHADER, gv.Lit(SHADER, light=lamp)):
        for directions in (True, False):
            tree, shader = filtered(base_shader, directions=directions)
            for size, distance in ((21, 1.5), (9, 1.5), (13, 4.0)):
                rays = camera_rays(tree, size, distance=distance)
                result, marks = trace(tree, backend, rays, shader)
                results += [*result.values(), *marks.values()]
    return results


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_every_bit_is_the_same_for_all_instruction_sets(tmp_path):
    expected = shaded("reference")
    runs = [start(all_shaded, tmp_path, name) for name in INSTRUCTIONS]
    for actual in map(result, runs):
        for a, b in zip(actual, expected, strict=True):
            assert torch.equal(a.nan_to_num(7), b.nan_to_num(7))


@pytest.mark.backend("cpp")
def test_close_by_it_is_the_transfer_function():
    tree, shader = filtered(SHADER)
    rays = camera_rays(tree, 17)
    near, plain = (gv.trace(tree, rays, s, lod="finest") for s in (shader, SHADER))
    for field in ("color", "alpha", "depth", "samples"):
        assert torch.equal(getattr(near, field), getattr(plain, field)), field


@functools.cache
def seen_from_afar(kind: str) -> tuple[gv.N3Tree, gv.TransferFunction, gv.Filtered]:
    """Returns `walls` as a tree, a function that shows it as matter of a kind, and its shader."""
    transfer = MISTY if kind == "misty" else gv.TransferFunction([(0.4, 0), (0.5, 0.95)])
    tree = gv.N3Tree.from_volume(walls(), 8)
    return tree, transfer, gv.Filtered.of(tree, walls(), transfer)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("pixel", [4.0, 16.0])
@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.37, 0.23, 1.0)])
@pytest.mark.parametrize("kind", ["misty", "opaque"])
def test_from_afar_it_shows_what_many_fine_rays_show(kind, direction, pixel):
    tree, transfer, shader = seen_from_afar(kind)
    assert tree.bricks.channels["filtered"].width == (4 if kind == "misty" else 24)
    truth = picture(tree, transfer, direction, pixel, 16, "finest")
    light, psnr = compare(picture(tree, shader, direction, pixel), truth)
    means, before = compare(picture(tree, transfer, direction, pixel), truth)
    print(kind, direction, pixel, f"{light:.3f} {psnr:.1f} dB, means {means:.3f} {before:.1f} dB")
    assert psnr > before + 5
    _, still = compare(picture(tree, shader, direction, pixel, 4), truth)
    assert still > psnr


def test_a_row_of_voxels_lets_through_what_its_columns_do_together():
    """For translucent matter, along each axis. In opaque matter, columns count by the voxel before;
    treated as independent of what is further away, a row would hide too much.
    """
    generator = torch.Generator().manual_seed(5)
    plane = torch.rand((16, 16), generator=generator)  # columns along z, some denser than others
    values = (plane + 0.2 * torch.rand((32, 16, 16), generator=generator)).clamp(0, 1)
    shader = gv.Filtered(MISTY)
    volume = gv.Volume(values)
    field = coarse_colors.FinestVoxels.of(volume, 0)
    through = {}
    for directions in (False, True):
        shader._directions = directions
        out = [torch.empty((32 >> n, 16 >> n, 16 >> n, 30), dtype=torch.float16) for n in (1, 2, 3)]
        shader.write(field, (1.0, 1.0, 1.0), 2, out, torch.device("cpu"))
        rows = [row.unflatten(-1, (6, 5))[..., 3].float() for row in out]
        through[directions] = [
            torch.stack([(1 - row[..., k]).prod(2 - k // 2).mean() for k in range(6)])
            for row in rows
        ]
    finest = through[False][0]
    assert not torch.allclose(finest[:2], finest[4:], rtol=0.05)  # axes differ
    for all_light, before in zip(through[False][1:], through[True][1:], strict=True):
        torch.testing.assert_close(all_light, finest, rtol=0.02, atol=0)
        assert (before[4:] < 0.97 * finest[4:]).all()


@functools.cache
def solid_ball(radius: float) -> tuple[gv.N3Tree, gv.Filtered]:
    axis = torch.arange(96) - 47.5
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    inside = radius - (x * x + y * y + z * z).sqrt()
    volume = gv.Volume((0.5 + inside / 2).clamp(0, 1))
    tree = gv.N3Tree.from_volume(volume, 8)
    transfer = gv.TransferFunction([(0.49, 0), (0.51, 0.999)])
    return tree, gv.Filtered.of(tree, volume, transfer)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("direction", "growths"),
    [
        ((0.0, 0.0, 1.0), (0.02, 0.05, 0.07)),
        ((0.37, 0.23, 1.0), (0.05, 0.07, 0.06)),
        ((1.0, 1.0, 1.0), (0.10, 0.14, 0.16)),  # each axis' colours count a third
    ],
)
def test_a_solid_ball_covers_a_disc_from_afar(direction, growths):
    """Its rim hardly grows, because hidden voxels hold the colours of visible neighbours."""
    radius = 36.0
    tree, shader = solid_ball(radius)
    for pixel, grown in zip((4.0, 8.0, 16.0), growths, strict=True):
        covered = picture(tree, shader, direction, pixel)[..., 3].sum()
        assert abs(float(covered) / (math.pi * (radius / pixel) ** 2) - 1) < grown, pixel


@pytest.mark.long
@pytest.mark.parametrize(("directions", "counts"), [(True, [40]), (False, [1, 300])])
def test_colours_are_the_same_whatever_is_worked_out_at_a_time(monkeypatch, directions, counts):
    def colors() -> torch.Tensor:
        tree, shader = filtered(SHADER, directions=directions)
        return tree.bricks.bricks[shader.other]

    whole = colors()
    for voxels in counts:
        monkeypatch.setitem(coarse_colors._TILE_VOXELS, "cpu", voxels)
        torch.testing.assert_close(colors(), whole, rtol=0, atol=1e-3)
    assert whole.unique().numel() > 1000, "the test must see something"


@pytest.mark.backend("cpp")
def test_soft_shadows_are_as_dark_as_those_of_many_fine_rays():
    tree, transfer, filtered = seen_from_afar("opaque")
    camera = gv.Camera.orbit(30, 20, 1.7, 16.0, 60, 60)
    sun = gv.DirectionalLight((-1.0, -1.2, -0.6), angle=25.0)

    def picture(cones: int, in_the_way: gv.Shader | None, **options) -> torch.Tensor:
        shader = gv.Lit(transfer, in_the_way=in_the_way, ambient=0.0, diffuse=1.0, specular=0.0)
        lighting = gv.Lighting(lights=[sun], shadow_cones=cones)
        return gv.render(tree, camera, shader, lighting=lighting, **options).color

    truth = picture(100, None, lod="finest")
    for cones in (1, 4, 16):
        means, ours = (
            float((picture(cones, s) - truth).square().mean().sqrt()) for s in (None, filtered)
        )
        print(cones, f"means {means:.4f} filtered {ours:.4f}")
        assert ours < 0.7 * means
    with pytest.raises(ValueError, match="in_the_way must be a Shader"):
        gv.Lit(transfer, in_the_way=3)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("directions", [True, False])
def test_homogeneous_matter_stays_as_dense_at_every_level(directions):
    volume = gv.Volume(torch.full((32, 32, 32), 0.5), (1.0, 1.0, 2.0))
    volume.data[0, 0, 0] = 0.4999  # else there would be no bricks
    tree = gv.N3Tree.from_volume(volume, 4)
    transfer = gv.TransferFunction([(0, 0.02)], [(0, 0.3, 0.6, 0.9)])
    shader = gv.Filtered.of(tree, volume, transfer, directions=directions)
    for direction, length in (((0.0, 0.0, 1.0), 64.0), ((1.0, 0.0, 0.0), 32.0)):
        forward = torch.tensor([direction], dtype=torch.float64)
        for width in (0.1, 2.0, 9.0):
            cone = torch.tensor([[width, 0.0]], dtype=torch.float64)
            ray = rays(tree.box.mean(0) - 100 * forward, forward, cone)
            hits = gv.trace(tree, ray, shader, stop_alpha=1.0)
            alpha = 1 - 0.98**length
            assert float(hits.alpha) == pytest.approx(alpha, rel=2e-3)
            expected = alpha * torch.tensor([[0.3, 0.6, 0.9]])
            torch.testing.assert_close(hits.color, expected, rtol=3e-3, atol=0)


@pytest.mark.backend("cpp")
def test_a_tree_tracer_draws_it():
    tree, shader = filtered(SHADER)
    rays = camera_rays(tree, 12, distance=3.0)
    expected = gv.trace(tree, rays, shader)
    tracer = torch.jit.script(gv.TreeTracer(tree, shader))
    color, alpha, _, _ = tracer(rays.origin, rays.direction, rays.cone, rays.range)
    assert torch.equal(color, expected.color) and torch.equal(alpha, expected.alpha)


@pytest.mark.backend("cpp")
def test_a_tree_of_one_brick_has_no_colours():
    volume = gv.Volume(torch.rand(4, 4, 4, generator=torch.Generator().manual_seed(1)))
    tree = gv.N3Tree.from_volume(volume, 4)
    shader = gv.Filtered.of(tree, volume, SHADER)
    assert tree.depth == 0 and len(tree.bricks.bricks["filtered"]) == 0
    rays = camera_rays(tree, 9, distance=5.0)
    actual, plain = (gv.trace(tree, rays, s) for s in (shader, SHADER))
    assert torch.equal(actual.color, plain.color) and plain.alpha.max() > 0
    for hold in ("voxels", "bricks", "mapped"):
        streamed = gv.Filtered(SHADER)
        producer = gv.VolumeProducer(volume, hold=hold, filtered=streamed)
        with gv.Engine(producer, brick_size=4) as engine:
            view = gv.Camera.orbit(width=9, height=9)
            assert torch.equal(
                engine.render(view, streamed).color, gv.render(tree, view, SHADER).color
            ), hold


@functools.cache
def resident(directions: bool, device: str) -> tuple[gv.N3Tree, gv.Filtered]:
    """Returns `matter` as a tree, and its shader."""
    tree = gv.N3Tree.from_volume(matter(), 4, device=device)
    return tree, gv.Filtered.of(tree, matter(), SHADER, directions=directions)


@pytest.mark.parametrize(
    ("hold", "directions", "size", "share"),  # each pair of values
    [
        ("voxels", True, 4_000_000, 0.5),
        ("voxels", False, 150_000, 0.25),
        ("bricks", True, 150_000, 0.25),
        ("bricks", False, 4_000_000, 0.5),
        ("mapped", True, 4_000_000, 0.5),
        ("mapped", False, 150_000, 0.25),
    ],
)
def test_streamed_equals_resident(compiled, hold, directions, size, share):
    """In pools that hold all bricks, and in pools that hold a part."""
    device = "cuda" if compiled == "cuda" else "cpu"
    volume, (tree, whole) = matter(), resident(directions, device)
    shader = gv.Filtered(SHADER, directions=directions)
    producer = gv.VolumeProducer(volume, hold=hold, filtered=shader)
    pools = {"brick_size": 4, "brick_pool": size, "coarse_share": share, "device": device}
    with gv.Engine(producer, **pools) as engine:
        bricks, crowded = engine.cache.bricks, False
        assert size - 12_000 < engine.memory()["brick_pool"] <= size
        assert bricks.coarse == pytest.approx(share * bricks.capacity, rel=0.3)
        for distance in (1.5, 4.0, 10.0, 0.7):
            camera = gv.Camera.orbit(width=40, height=30, distance=distance)
            actual = engine.render(camera, shader)
            expected = gv.render(tree, camera, whole)
            assert actual.stats.converged
            crowded |= actual.stats.capacity_exceeded
            for field in ("color", "alpha", "depth"):
                assert torch.equal(getattr(actual, field), getattr(expected, field)), field
            engine.validate()
            depth = engine.trees["scene"].tree.loc(bricks.owner_b.clamp(min=0).long())[:, 3]
            coarse = depth[: bricks.coarse][bricks.owner_b[: bricks.coarse] >= 0]
            fine = depth[bricks.coarse :][bricks.owner_b[bricks.coarse :] >= 0]
            assert (coarse < tree.depth).all() and (fine == tree.depth).all()
        assert crowded == (size < 4_000_000)


@pytest.mark.backend("cpp")
def test_two_trees_share_coarse_slots():
    """Of trees with filtered colours, with a single brick, and without such colours."""
    volume, small = matter(), gv.Volume(torch.rand(4, 4, 4), (9.0, 9.0, 9.0))
    shader, other = gv.Filtered(SHADER), gv.Filtered(SHADER)
    scene = {
        "far": gv.VolumeProducer(volume, filtered=shader),
        "small": gv.VolumeProducer(small, filtered=other),
        "plain": gv.VolumeProducer(volume),
    }
    shaders = {"far": shader, "small": other, "plain": SHADER}
    tree = gv.N3Tree.from_volume(volume, 4)
    with gv.Engine(scene, brick_size=4) as engine:
        for name, view in (("far", 5.0), ("small", 3.0), ("plain", 5.0)):
            alone = {
                n: s if n == name else gv.TransferFunction([(0, 0)]) for n, s in shaders.items()
            }
            camera = gv.Camera.orbit(width=30, height=30, distance=view)
            actual = engine.render(camera, alone)
            assert actual.stats.converged and actual.alpha.max() > 0.5
            engine.validate()
            if name != "small":
                placed = camera.placed(engine.box)
                expected = gv.Filtered.of(tree, volume, SHADER) if name == "far" else SHADER
                assert torch.equal(actual.color, gv.render(tree, placed, expected).color)


def test_a_streamed_function_may_not_be_edited_nor_another_number_drawn():
    volume = gv.Volume(torch.rand(20, 20, 20, 2, generator=torch.Generator().manual_seed(1)))
    transfer = gv.TransferFunction([(0, 0), (1, 0.5)])
    shader, camera = gv.Filtered(transfer), gv.Camera.orbit(width=9, height=9)
    other = gv.Volume(volume.data.flip(0))
    producer = gv.VolumeProducer({"a": volume, "b": other}, filtered=shader)
    tree = gv.N3Tree.from_volume(volume, 8)
    expected = gv.render(tree, camera, gv.Filtered.of(tree, volume, transfer)).color
    with gv.Engine(producer) as engine:
        assert torch.equal(engine.render(camera, shader, component=1).color, expected)
        with pytest.raises(ValueError, match="'filtered' was made of 'a', not of 'b'"):
            engine.render(camera, shader, channel="b")
        transfer.opacity[1, 1] = 0.6
        with pytest.raises(ValueError, match="another function or component, or it was edited"):
            engine.render(camera, shader)
    mist = gv.TransferFunction([(0, 0), (1, 0.1)])
    producer = gv.VolumeProducer(volume, filtered=gv.Filtered(mist, component=1))
    mist.opacity[1, 1] = 0.9  # beyond the alpha that would need directions
    with gv.Engine(producer) as engine:
        assert engine.render(camera, gv.Filtered(mist, component=1)).stats.converged


def test_mistakes_of_a_producer_with_coarse_channels_are_told():
    volume = matter()
    with pytest.raises(ValueError, match="filtered must be a Filtered, got TransferFunction"):
        gv.VolumeProducer(volume, filtered=SHADER)
    with pytest.raises(ValueError, match="component of filtered must be"):
        gv.VolumeProducer(volume, filtered=gv.Filtered(SHADER, component=5))

    class AllCoarse(gv.Producer):
        pass

    with pytest.raises(ValueError, match="must have a channel that is not coarse"):
        gv.Engine(AllCoarse(9, channels={"a": gv.Channel(coarse=True)}))
    with pytest.raises(ValueError, match="'value' is a volume's"):
        gv.VolumeProducer(volume, filtered=gv.Filtered(SHADER, "value"))
    with pytest.raises(ValueError, match="brick_pool of 50000 bytes holds"):
        pool = {"brick_pool": 50_000, "brick_size": 8}
        gv.Engine(gv.VolumeProducer(volume, filtered=gv.Filtered(SHADER)), **pool)
    with pytest.raises(ValueError, match="coarse_share must be"):
        gv.Engine(gv.VolumeProducer(volume), coarse_share=0.0)

    class Wrong(gv.VolumeProducer):
        def fill(self, nodes):
            data = dict(super().fill(nodes).data)
            if not nodes.coarse:
                data["filtered"] = torch.zeros((*data["value"].shape[:4], 4)).half()
            return data

    shader = gv.Filtered(SHADER, directions=False)
    with gv.Engine(Wrong(volume, filtered=shader), brick_size=4) as engine:
        engine.render(gv.Camera.orbit(width=40, height=40, distance=0.5), shader)
        assert "which only bricks above the finest level hold" in engine.failures[0].message


def test_a_coarse_channel_is_for_those_who_know_it():
    tree, shader = filtered(SHADER)
    rays = camera_rays(tree, 3)
    module = gv.ModuleShader(torch.nn.Identity(), channels=["filtered"])
    others = (gv.StoredColor("filtered"), gv.Lit(SHADER, normals="filtered"), module)
    for other in (*others, gv.Features(SHADER, "filtered")):
        with pytest.raises(ValueError, match="only coarse bricks have channel 'filtered'"):
            gv.trace(tree, rays, other)
    with pytest.raises(ValueError, match="only coarse bricks have channel 'filtered'"):
        gv.trace(tree, rays, SHADER, channel="filtered")
    gv.trace(tree, rays, shader)


def test_mistakes_are_told():
    volume = matter()
    tree = gv.N3Tree.from_volume(volume, 4)
    with pytest.raises(ValueError, match="must have one placement"):
        gv.Filtered.of(tree, gv.Volume(torch.zeros(8, 8, 8)), SHADER)
    with pytest.raises(ValueError, match="component must be"):
        gv.Filtered.of(tree, volume, SHADER, component=1)
    with pytest.raises(ValueError, match="that of the values"):
        gv.Filtered.of(tree, volume, SHADER, channel="value")
    with pytest.raises(ValueError, match="unknown channel 'filtered'"):
        gv.trace(tree, camera_rays(tree, 3), gv.Filtered(SHADER))
    with pytest.raises(ValueError, match="need 4 numbers a voxel"):
        gv.trace(tree, camera_rays(tree, 3), gv.Filtered(SHADER, "value"))
    transfer = gv.TransferFunction([(0, 0), (1, 0.5)])
    shader = gv.Filtered.of(tree, volume, transfer)
    transfer.opacity[1, 1] = 0.6
    for other in (shader, gv.Filtered(SHADER)):
        with pytest.raises(ValueError, match="made of another function or component"):
            gv.trace(tree, camera_rays(tree, 3), other)
