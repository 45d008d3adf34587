"""Conveniences of objects: options that `help` shows, arrays of pictures, `.to`."""

from __future__ import annotations

import dataclasses
import inspect
import sys
import types
import webbrowser
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY, camera

import gvtorch as gv
from gvtorch.base.explicit import option_texts
from gvtorch.engine import EngineSettings
from gvtorch.tracing.options import RenderSettings

RENDERERS = [
    gv.render,
    gv.trace,
    gv.cost,
    gv.Engine.frame,
    gv.Engine.render,
    gv.Engine.capture,
]
RECORDS = [(gv.RenderOptions, RenderSettings), (gv.EngineOptions, EngineSettings)]


@pytest.mark.parametrize(("record", "typed"), RECORDS)
def test_options_stand_once(record, typed):
    """Documentation and default are in the record; type checkers see the same names and types."""
    types_of = {field.name: field.type for field in dataclasses.fields(record)}
    declared = {name: hint.__forward_arg__ for name, hint in typed.__annotations__.items()}
    assert declared == types_of and option_texts(record).keys() == types_of.keys()


@pytest.mark.parametrize(
    ("function", "record"),
    [*((one, gv.RenderOptions) for one in RENDERERS), (gv.Engine.__init__, gv.EngineOptions)],
)
def test_signature_and_help_show_every_option(function, record):
    parameters = inspect.signature(function).parameters
    assert not any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    text = inspect.getdoc(function)
    for field in dataclasses.fields(record):
        parameter = parameters[field.name]
        assert parameter.kind is parameter.KEYWORD_ONLY
        assert (parameter.default, parameter.annotation) == (field.default, field.type)
        begin = text.index(f"    {field.name}: ")
        assert repr(field.default) in " ".join(text[begin : begin + 300].split())
    assert "**options" not in text


def test_the_signature_of_an_engine_is_that_of_its_options():
    names = [field.name for field in dataclasses.fields(gv.EngineOptions)]
    assert list(inspect.signature(gv.Engine).parameters) == ["scene", *names]


@pytest.fixture
def picture(blobs):
    return gv.render(gv.N3Tree.from_volume(blobs), camera(12, distance=1.3), GRAY)


def test_pictures_become_arrays(picture, blobs, tmp_path):
    image = np.asarray(picture)
    assert image.dtype == np.uint8 and np.array_equal(image, picture.to_srgb8().numpy())
    light = picture.numpy()
    assert light.shape == (12, 12, 4) and np.array_equal(light[..., :3], picture.color.numpy())
    assert np.asarray(picture, dtype=np.float32).dtype == np.float32
    with pytest.raises(ValueError, match="copy must not be False"):
        picture.__array__(copy=False)
    clear = gv.render(gv.N3Tree.from_volume(blobs), camera(12), GRAY, background=None)
    clear.save(tmp_path / "clear.png")
    from PIL import Image

    assert np.array_equal(np.asarray(clear), np.asarray(Image.open(tmp_path / "clear.png")))
    assert np.array_equal(np.asarray(Image.fromarray(np.asarray(picture))), image)


def test_what_has_tensors_moves(picture, blobs):
    wide = picture.to(dtype=torch.float64)
    assert wide.color.dtype == wide.depth.dtype == torch.float64
    assert wide.samples.dtype == torch.int32 and wide.stats is picture.stats
    assert torch.equal(wide.to("cpu", torch.float32).color, picture.color)
    tree = gv.N3Tree.from_volume(blobs)
    rays = camera(4).placed(tree.box).rays().to(dtype=torch.float32)
    hits = gv.trace(tree, rays, GRAY)
    assert (
        rays.range.dtype == torch.float32 and hits.to(dtype=torch.float64).depth.dtype.itemsize == 8
    )
    assert hits.to("meta").missed.device.type == "meta" and rays.to("meta").cone.is_meta
    assert blobs.shape == tuple(blobs.data.shape) == (*blobs.extent[::-1], 1)


def test_a_picture_is_shown_where_there_is_a_viewer(picture, monkeypatch):
    opened = []
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: None))
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    picture.show()
    image = gv.read_image(Path(opened[0].removeprefix("file://")))
    assert image.shape == (12, 12, 3)
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    with pytest.raises(RuntimeError, match=r"no viewer can be opened here; the PNG is .*\.png"):
        picture.show()
    display = types.SimpleNamespace(display=opened.append)
    shell = types.SimpleNamespace(kernel=1)
    notebook = types.SimpleNamespace(get_ipython=lambda: shell, display=display)
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    picture.show()
    assert opened[-1] is picture


class Net(torch.nn.Module):
    """A network as users write it: a tracer, and a layer."""

    def __init__(self, tracer: gv.TreeTracer) -> None:
        super().__init__()
        self.tracer, self.tint = tracer, torch.nn.Linear(3, 3)

    def forward(self, origin, direction, cone, range):
        color, _, _, _ = self.tracer(origin, direction, cone, range)
        return color, self.tint(color.to(self.tint.weight.dtype))


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("shader", [GRAY, gv.Lit(GRAY)], ids=["plain", "lit"])
@pytest.mark.parametrize("change", ["half", "bfloat16", "double", "float"])
def test_a_net_may_change_its_dtype_around_a_tracer(blobs, shader, change):
    tree = gv.N3Tree.from_volume(blobs)
    net = Net(gv.TreeTracer(tree, shader))
    rays = net.tracer.rays(camera(6, distance=1.3))
    expected, _ = net(*rays)
    kinds = {name: buffer.dtype for name, buffer in net.tracer.named_buffers()}
    changed = getattr(net, change)()
    assert changed is net and expected.max() > 0.1
    assert {name: buffer.dtype for name, buffer in net.tracer.named_buffers()} == kinds
    color, tinted = net(*rays)
    assert torch.equal(color, expected)
    assert tinted.dtype == net.tint.weight.dtype == getattr(torch.ones(1), change)().dtype
    assert torch.equal(torch.jit.script(net)(*rays)[0], expected)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(net(*rays)[0], expected)
    assert all(buffer.is_meta for buffer in net.to("meta").tracer.buffers())


@pytest.mark.backend("cpp")
def test_what_is_made_in_inference_mode_works_outside_of_it(blobs):
    """torch lets nobody write inference tensors there, and every frame writes its pools."""
    view = camera(12, distance=1.3)
    with torch.inference_mode():
        tree, engine = gv.N3Tree.from_volume(blobs), gv.Engine(gv.VolumeProducer(blobs))
        tracer = gv.TreeTracer(tree, GRAY)
        expected = gv.render(tree, view, GRAY).color
    with engine:
        assert torch.equal(engine.render(view, GRAY).color, expected)
    assert torch.equal(tracer(*tracer.rays(view))[0], expected)
    assert torch.equal(gv.render(tree, view, GRAY).color, expected)
    tree.refresh()
    assert torch.equal(gv.render(tree, view, GRAY).color, expected)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("shader", [GRAY, gv.Lit(GRAY), gv.Projection("max", GRAY)])
def test_a_tracer_takes_rays_of_any_leading_shape(blobs, shader):
    """With a camera's rays, in the shape of its picture, it returns the pictures of `render`."""
    tree = gv.N3Tree.from_volume(blobs)
    tracer = gv.TreeTracer(tree, shader)
    scripted = torch.jit.script(tracer)
    batch = gv.Camera.orbit([30, 60], 20, 1.3, width=6, height=5)
    for view, lead in ((camera(6, distance=1.3), (6, 6)), (batch, (2, 5, 6))):
        rays = tracer.rays(view)
        assert [tuple(part.shape) for part in rays] == [(*lead, n) for n in (3, 3, 2, 2)]
        expected = gv.render(tree, view, shader)
        for run in (tracer, scripted):
            color, alpha, depth, samples, _, features = run.hits(*rays)
            for mine, name in ((color, "color"), (alpha, "alpha"), (depth, "depth")):
                assert torch.equal(mine, getattr(expected, name)), name
            assert torch.equal(samples[..., None], expected.samples)
            if expected.features is not None and expected.features.numel():
                assert torch.equal(features, expected.features)
        corner = (0,) * len(lead)
        alone, *_ = tracer(*(part[corner] for part in rays))
        assert alone.shape == (3,) and torch.equal(alone, color[corner])
    assert repr(tracer).startswith("TreeTracer(N3Tree(45x29x37") and "\n" not in repr(tracer)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("mode", [lambda tracer: tracer, torch.jit.script], ids=["eager", "script"])
def test_a_tracer_refuses_columns_that_do_not_fit(blobs, mode):
    """As many numbers in another shape would be other rays."""
    tracer = gv.TreeTracer(gv.N3Tree.from_volume(blobs), GRAY)
    origin, direction, cone, ranges = tracer.rays(camera(6, distance=1.3))
    run = mode(tracer)
    turned = direction.reshape(4, 9, 3)
    for columns, message in (
        ((origin, turned, cone, ranges), r"direction must be \[6, 6, 3\], got \[4, 9, 3\]"),
        ((origin, direction, cone.reshape(24, 3), ranges), r"cone must be \[6, 6, 2\]"),
        ((origin, direction, cone, ranges[0]), r"range must be \[6, 6, 2\]"),
        ((origin[..., 0], direction, cone, ranges), r"origin must be \[6, 3\], got \[6, 6\]"),
        ((origin.sum(), direction, cone, ranges), r"origin must be \[3\], got \[\]"),
    ):
        with pytest.raises((ValueError, torch.jit.Error), match=message):
            run(*columns)


def test_a_net_that_holds_a_module_shader_has_its_parameters(blobs):
    class Holder(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.shader = gv.ModuleShader(gv.TransferModule(GRAY, 1.0))

    net = Holder()
    assert [name for name, _ in net.named_parameters()] == ["shader.module.rows"]
    net.shader.module = gv.TransferModule(GRAY, 2.0)  # edited: registered as well
    assert net.shader.module.rows is next(net.parameters())
    with pytest.raises(ValueError, match=r"trace with gv\.trace"):
        gv.TreeTracer(gv.N3Tree.from_volume(blobs), net.shader)
