"""Pool words that lead out of the pools, and numbers by which rays would leave the tree or never
end: kernels treat them as absent, and loading such words is refused.
"""

from __future__ import annotations

import io
import pickle

import pytest
import torch
from helpers import DEVICES
from helpers.rays import camera_rays, world_rays
from helpers.shaders import SHADERS
from helpers.traces import SHADER, arguments, assert_equal, trace
from helpers.trees import copy_to

import gvtorch as gv
from gvtorch.base.constants import ABSENT, TERMINAL
from gvtorch.ops import trace_rays

FAR = (2**31 - 1, 2**30, 10**6)


def spoilt(tree: gv.N3Tree, seed: int, absent: bool = False) -> gv.N3Tree:
    """Returns a copy in which a third of the words lead out of the pools, or are absent."""
    copy = copy_to(tree, "cpu")
    generator = torch.Generator().manual_seed(seed)
    for words, count in (
        (copy.nodes.child_tn, copy.nodes.capacity),
        (copy.nodes.brick_tn, copy.bricks.capacity),
    ):
        bad = torch.rand(words.shape, generator=generator) < 0.3
        bad &= torch.arange(len(words))[:, None] > 0  # rays get into the tree
        values = torch.tensor([count, count + 1, *FAR], dtype=torch.int32)
        chosen = values[torch.randint(len(values), words.shape, generator=generator)]
        words[bad] = torch.full_like(chosen, ABSENT)[bad] if absent else chosen[bad]
    return copy


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("branching", [2, 3])
def test_words_that_lead_out_of_the_pools_count_as_absent(blobs, backend, dtype, branching):
    tree = gv.N3Tree.from_volume(blobs, 4, branching=branching)
    rays, seed = camera_rays(tree, 8), branching
    actual = trace(spoilt(tree, seed), backend, rays, dtype=dtype)
    expected = trace(spoilt(tree, seed, absent=True), backend, rays, dtype=dtype)
    for mine, other in zip(actual, expected, strict=True):
        assert all(torch.equal(mine[name], other[name]) for name in other)
    assert actual[0]["missed"].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("word", [-3, -(2**31)])
def test_words_below_all_that_are_known_end_a_tree_and_hide_nothing(blobs, backend, dtype, word):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays, results = camera_rays(tree, 8), []
    for instead in (word, TERMINAL):
        copy = copy_to(tree, "cpu")
        chosen = torch.rand(copy.nodes.child_tn.shape, generator=torch.Generator().manual_seed(5))
        copy.nodes.child_tn[chosen < 0.3] = instead
        results.append(trace(copy, backend, rays, dtype=dtype))
    for mine, other in zip(*results, strict=True):
        assert all(torch.equal(mine[name], other[name]) for name in other)
    assert results[0][0]["alpha"].max() > 0.1, "the test must see something"


@pytest.mark.parametrize("high", [1e6, -5.0, torch.nan])
@pytest.mark.parametrize("branching", [2, 3])
def test_a_scene_does_not_reach_out_of_its_root_cube(blobs, backend, branching, high):
    """Rays led there would request nodes of no tile, one interval at a time."""
    tree = gv.N3Tree.from_volume(blobs, 4, branching=branching, device=DEVICES[backend])
    rays, trace_args = arguments(tree, 4)
    results = []
    for corner in (high, 1.0 if high > 1 else 0.0):
        placement = trace_args.place_33.clone()
        placement[2] = corner
        hits = trace_rays(rays, trace_args._replace(place_33=placement), backend=backend)
        results.append([*hits, tree.nodes.request_tn.clone()])
    assert all(torch.equal(*each) for each in zip(*results, strict=True))


def test_a_cone_that_is_no_number_ends_its_ray(blobs, backend):
    """Each node lookup would be valid for only one interval, of which there may be millions."""
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    rays, args = arguments(tree, 4)
    rays, args = rays._replace(cone_r2=rays.cone_r2 * torch.nan), args._replace(step=1e-4)
    _, alpha, _, samples, missed = trace_rays(rays, args, backend=backend)
    assert not (alpha.any() or samples.any() or missed.any())


@pytest.fixture(scope="module")
def spoilt_channels(tree_of_channels) -> gv.N3Tree:
    return spoilt(tree_of_channels, 1)


@pytest.mark.parametrize("name", SHADERS)
def test_no_shader_follows_such_words(spoilt_channels, compiled, name):
    rays = camera_rays(spoilt_channels, 8)
    assert_equal(spoilt_channels, compiled, rays, SHADERS[name], step=2.5)


@pytest.mark.filterwarnings("ignore")  # torch deprecates its own TorchScript
def test_a_scripted_tracer_of_such_words_sees_what_is_there(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = world_rays(tree.box, 33, DEVICES[compiled])
    tracers = []
    for absent in (False, True):
        tracer = gv.TreeTracer(tree, SHADER).to(DEVICES[compiled])
        nodes = spoilt(tree, 3, absent).nodes
        tracer.child_tn, tracer.brick_tn = (
            nodes.child_tn.to(tracer.child_tn),
            nodes.brick_tn.to(tracer.brick_tn),
        )
        tracers.append(torch.jit.script(tracer))
    file = io.BytesIO()
    torch.jit.save(tracers[0], file)
    file.seek(0)
    for mine, other in zip(torch.jit.load(file)(*rays), tracers[1](*rays), strict=True):
        assert torch.equal(mine, other)


@pytest.mark.parametrize("name", ["child_tn", "brick_tn"])
@pytest.mark.parametrize("word", [10**6, -9])
def test_a_tracer_does_not_load_such_words(blobs, name, word):
    tracer = gv.TreeTracer(gv.N3Tree.from_volume(blobs, 4), SHADER)
    before = {key: value.clone() for key, value in tracer.state_dict().items()}
    state = {key: value.clone() for key, value in before.items()}
    state[name][1, 2] = word
    net = torch.nn.Sequential(tracer)
    with pytest.raises(RuntimeError, match=rf"TreeTracer: 0\.{name} holds {word}"):
        net.load_state_dict({f"0.{key}": value for key, value in state.items()})
    assert all(torch.equal(before[key], value) for key, value in tracer.state_dict().items())
    net.load_state_dict({f"0.{key}": value for key, value in before.items()})
    getattr(tracer, name)[1, 2] = word
    with pytest.raises(ValueError, match=f"TreeTracer: {name} holds {word}"):
        pickle.loads(pickle.dumps(tracer))


def test_a_tree_does_not_come_out_of_a_pickle_with_such_words(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    assert pickle.loads(pickle.dumps(tree)).depth == tree.depth
    with pytest.raises(ValueError, match="N3Tree: child_tn holds"):
        pickle.loads(pickle.dumps(spoilt(tree, 2)))
