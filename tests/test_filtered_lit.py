"""`Filtered` of a `Lit`: lit matter from afar. Every backend gives the twin's bits, pictures equal
those of many rays a pixel, and light and material may change.
"""

from __future__ import annotations

from functools import cache

import pytest
import torch
from helpers import gvtorch
from helpers.afar import assert_same_bits, compare, filtered, matter, picture
from helpers.rays import camera_rays
from helpers.traces import SHADER

import gvtorch as gv

SUN = gv.DirectionalLight((-1.0, -0.5, 0.3), (1.0, 0.9, 0.8))
LAMP = gv.PointLight((0.0, 40.0, 60.0), (1.0, 0.9, 0.8))
FIELDS = ("color", "alpha", "depth", "normal")


@pytest.mark.parametrize(
    ("directions", "branching", "dtype"),
    [  # any two of the options meet in every way
        *((True, 2, torch.float32), (True, 3, torch.float64)),
        *((False, 2, torch.float64), (False, 3, torch.float32)),
    ],
)
def test_compiled_equals_reference(compiled, directions, branching, dtype):
    tree, shader = filtered(gv.Lit(SHADER), branching, directions=directions)
    assert tree.bricks.channels["filtered"].width == (60 if directions else 10)
    for light, distance, step in (
        (gv.Headlight(), 0.3, 0.9),
        (SUN, 1.3, 0.9),
        (LAMP, 1.3, 1.8),
        (LAMP, 5.0, 2.3),
    ):
        shader.transfer = gv.Lit(SHADER, light=light, specular=0.9, shininess=25.0)
        hits = assert_same_bits(tree, compiled, distance, shader, dtype=dtype, step=step)
        if distance == 1.3:
            assert hits["alpha"].max() > 0.3, "the test must see something"


@pytest.mark.backend("cpp")
def test_close_by_it_is_the_lit_transfer_function():
    base = gv.Lit(SHADER, light=SUN)
    tree, shader = filtered(base)
    rays = camera_rays(tree, 17)
    near, lit = (gv.trace(tree, rays, s, lod="finest") for s in (shader, base))
    for field in (*FIELDS, "samples"):
        assert torch.equal(getattr(near, field), getattr(lit, field)), field


#: Scan, transfer function, voxels a pixel, light; least PSNR, and largest relative error of the
#: mean light.
CASES = [
    ("stent", "translucent", 2.0, gv.Headlight(), 40, 0.05),
    ("stent", "translucent", 8.0, SUN, 40, 0.08),
    ("stent", "opaque", 2.0, SUN, 26, 0.17),
    ("stent", "opaque", 8.0, gv.Headlight(), 29, 0.17),
    ("aneurism", "translucent", 2.0, SUN, 35, 0.05),
    ("aneurism", "translucent", 8.0, gv.Headlight(), 30, 0.08),
    ("aneurism", "opaque", 8.0, SUN, 29, 0.15),
]
SCANS = {
    "stent": ((140, 900, 0.1), (380, 430)),
    "aneurism": ((20, 255, 0.15), (60, 70)),
}


@pytest.fixture(scope="module")
def filtered_scan(request):
    """Returns what makes the tree of a scan's middle and its shader of a kind, once each."""

    @cache
    def tree_of(scan: str) -> tuple[gv.Volume, gv.N3Tree]:
        whole = request.getfixturevalue(scan)
        z, y, x = (max(0, size // 2 - 32) for size in whole.data.shape[:3])
        part = whole.data[z : z + 64, y : y + 64, x : x + 64].contiguous()
        volume = gv.Volume(part, whole.spacing)
        return volume, gv.N3Tree.from_volume(volume)

    @cache
    def made(scan: str, kind: str) -> tuple[gv.N3Tree, gv.Filtered]:
        (low, high, peak), (clear, solid) = SCANS[scan]
        color = [(clear, 0.8, 0.4, 0.25), (2 * solid, 1, 0.9, 0.7)]
        opacity = [(low, 0), (high, peak)] if kind == "translucent" else [(clear, 0), (solid, 0.95)]
        volume, tree = tree_of(scan)
        return tree, gv.Filtered.of(tree, volume, gv.Lit(gv.TransferFunction(opacity, color)))

    return made


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(("scan", "kind", "pixel", "light", "least", "tolerance"), CASES)
def test_from_afar_it_shows_what_many_fine_rays_show(
    filtered_scan, scan, kind, pixel, light, least, tolerance
):
    tree, shader = filtered_scan(scan, kind)
    shader.transfer = lit = gv.Lit(shader.transfer.transfer, light=light)
    direction = (0.37, 0.23, 1.0)
    truth = picture(tree, lit, direction, pixel, 6 if pixel < 4 else 12, "finest")
    share, psnr = compare(picture(tree, shader, direction, pixel), truth)
    means, before = compare(picture(tree, lit, direction, pixel), truth)
    sharp, alone = compare(picture(tree, lit, direction, pixel, 1, "finest"), truth)
    print(f"{share:.3f} {psnr:.1f} dB; means {means:.3f} {before:.1f}; one {sharp:.3f} {alone:.1f}")
    assert psnr > least and psnr > before + 5 and psnr > alone
    assert abs(share - 1) < tolerance


@pytest.mark.backend("cpp")
def test_highlights_of_rough_matter_widen():
    """A ball of rough matter has a highlight with as much light as that of many fine rays, and not
    sharper.
    """
    n = 64
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32),) * 3, indexing="ij")
    radius = torch.sqrt((x - 31.5) ** 2 + (y - 31.5) ** 2 + (z - 31.5) ** 2)
    generator = torch.Generator().manual_seed(3)
    rough = torch.nn.functional.avg_pool3d(
        torch.rand((1, 1, n + 2, n + 2, n + 2), generator=generator), 3, 1
    )[0, 0]
    volume = gv.Volume((0.5 + (25 - radius) / 8 + 1.2 * (rough - 0.5)).clamp(0, 1))
    shine = {"ambient": 0.0, "diffuse": 0.0, "specular": 1.0, "shininess": 60.0}
    base = gv.Lit(gv.TransferFunction([(0.4, 0), (0.5, 0.95)]), **shine)
    tree = gv.N3Tree.from_volume(volume)
    shader = gv.Filtered.of(tree, volume, base)
    truth = picture(tree, base, (0.37, 0.23, 1.0), 6.0, 8, "finest")[..., 0]
    smooth = picture(tree, base, (0.37, 0.23, 1.0), 6.0)[..., 0]
    actual = picture(tree, shader, (0.37, 0.23, 1.0), 6.0)[..., 0]
    assert 0.6 < float(actual.sum() / truth.sum()) < 1.6
    assert float(actual.max()) < 1.6 * float(truth.max()) < float(smooth.max())


@pytest.mark.parametrize("directions", [True, False])
def test_streamed_equals_resident(compiled, directions):
    device = "cuda" if compiled == "cuda" else "cpu"
    volume, base = matter(), gv.Lit(SHADER, light=SUN)
    tree = gv.N3Tree.from_volume(volume, 4, device=device)
    resident = gv.Filtered.of(tree, volume, base, directions=directions)
    for size in (8_000_000, 400_000):
        shader = gv.Filtered(base, directions=directions)
        producer = gv.VolumeProducer(volume, filtered=shader)
        with gv.Engine(producer, brick_size=4, brick_pool=size, device=device) as engine:
            for distance in (1.5, 4.0, 10.0):
                camera = gv.Camera.orbit(width=40, height=30, distance=distance)
                actual, expected = engine.render(camera, shader), gv.render(tree, camera, resident)
                assert actual.stats.converged and actual.alpha.max() > 0.1
                for field in FIELDS:
                    assert torch.equal(getattr(actual, field), getattr(expected, field)), field
            engine.validate()


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("opacity", [0.05, 0.9])
def test_streamed_from_disk_equals_resident(tmp_path, opacity):
    volume = gv.Volume((200 * matter().data).to(torch.uint8))
    base = gv.Lit(gv.TransferFunction([(30, 0), (120, opacity)]))
    gv.convert(volume, tmp_path / "a.zarr")
    gv.Filtered.add_to(tmp_path / "a.zarr", base)
    stored = gv.Filtered.stored(tmp_path / "a.zarr")
    assert isinstance(stored.transfer, gv.Lit) and stored.made_of["normals"]
    stored.transfer.light = base.light = SUN
    tree = gv.N3Tree.from_volume(volume, 8)
    resident = gv.Filtered.of(tree, volume, base)
    with gv.Engine(gv.StoredProducer(tmp_path / "a.zarr", filtered=stored), brick_size=8) as engine:
        for distance in (1.0, 4.0, 12.0):
            camera = gv.Camera.orbit(width=32, height=24, distance=distance)
            actual, expected = engine.render(camera, stored), gv.render(tree, camera, resident)
            assert actual.stats.converged and not engine.failures
            for field in FIELDS:
                assert torch.equal(getattr(actual, field), getattr(expected, field)), field


@pytest.mark.backend("cpp")
def test_light_and_material_are_edited_without_making_colours_anew():
    tree, shader = filtered(gv.Lit(SHADER))
    rays = camera_rays(tree, 12, distance=4.0)
    before = gv.trace(tree, rays, shader).color
    assert isinstance(shader.transfer, gv.Lit)
    shader.transfer.light, shader.transfer.ambient = LAMP, 0.7
    after = gv.trace(tree, rays, shader).color
    _, fresh = filtered(gv.Lit(SHADER, light=LAMP, ambient=0.7))
    assert not torch.equal(after, before)
    assert torch.equal(after, gv.trace(tree, rays, fresh).color)


@pytest.mark.backend("cpp")
def test_unlit_it_shows_the_filtered_colours_and_lighting_lights_them():
    tree, shader = filtered(gv.Lit(SHADER))
    plain_tree = gv.N3Tree.from_volume(matter(), 4, threshold=0.0)
    plain = gv.Filtered.of(plain_tree, matter(), SHADER)
    rays = camera_rays(tree, 12, distance=4.0)
    bare, expected = gv.trace(tree, rays, shader.unlit()), gv.trace(plain_tree, rays, plain)
    torch.testing.assert_close(bare.color, expected.color, rtol=1e-4, atol=1e-5)
    camera = gv.Camera.orbit(width=20, height=20, distance=4.0)
    lighting = gv.Lighting(lights=[SUN], occlusion=0.5)
    lit = gv.render(tree, camera, shader, lighting=lighting)
    assert lit.color.max() > 0.05 and not torch.equal(
        lit.color, gv.render(tree, camera, shader).color
    )
    with pytest.raises(ValueError, match="lighting needs normals"):
        gv.render(plain_tree, camera, plain, lighting=lighting)


def test_mistakes_are_told(tmp_path):
    volume = matter()
    tree = gv.N3Tree.from_volume(volume, 4)
    with pytest.raises(ValueError, match="must be a TransferFunction or Lit, got Isosurface"):
        gv.Filtered(gv.Isosurface(0.5))
    for base in (
        gv.Lit(SHADER, normals="normal"),
        gv.Lit(SHADER, shadows=True),
        gv.Lit(SHADER, light=SUN, octaves=2),
    ):
        with pytest.raises(ValueError, match="a Lit must take its normals from the gradient"):
            gv.Filtered.of(tree, volume, base)
    rays = camera_rays(tree, 3)
    plain = gv.Filtered.of(tree, volume, SHADER)
    with pytest.raises(ValueError, match="made of another function or component"):
        gv.trace(tree, rays, gv.Filtered(gv.Lit(SHADER)))
    lit = gv.Filtered.of(tree, volume, gv.Lit(SHADER))
    with pytest.raises(ValueError, match="made of another function or component"):
        gv.trace(tree, rays, plain)
    lit.transfer.shadows = True
    with pytest.raises(ValueError, match="without shadows per sample"):
        gv.trace(tree, rays, lit)
    with pytest.raises(ValueError, match="filtered colours need 10 numbers a voxel, or 60"):
        gv.trace(tree, rays, gv.Filtered(gv.Lit(SHADER), "value"))


@pytest.mark.backend("cpp")
def test_the_command_line(tmp_path):
    gv.convert(gv.Volume((200 * matter().data).to(torch.uint8)), tmp_path / "a.zarr")
    far = ("--size", "24x16", "--camera", "orbit:20,10,9", "-o", tmp_path / "a.npy")
    done = gvtorch("filter", tmp_path / "a.zarr", "--tf", "hot", "--lit")
    assert done.returncode == 0, done.stderr
    for flags in ((), ("--tf", "hot")):
        shader = ("--shader", "filtered-lit", *flags)
        done = gvtorch("render", tmp_path / "a.zarr", *shader, *far)
        assert done.returncode == 0, done.stderr
    done = gvtorch("render", tmp_path / "a.zarr", "--shader", "filtered", *far)
    assert done.returncode == 2 and "are for --shader filtered-lit" in done.stderr
