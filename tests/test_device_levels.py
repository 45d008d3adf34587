"""Levels that are made on a device have the bits of those that NumPy makes on the host."""

import numpy as np
import pytest
import torch

import gvtorch as gv
from gvtorch.base.downsample import (
    as_grid,
    by_node,
    from_grid,
    pool_max,
    pool_mean,
    pool_min,
    reduce_windows,
)
from gvtorch.base.volume import CHANNEL_DTYPES, movable

DTYPES = [str(dtype).removeprefix("torch.") for dtype in CHANNEL_DTYPES]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.backend("cuda"))]


def random_data(dtype: str, shape: tuple[int, ...], seed: int = 3) -> torch.Tensor:
    """Returns numbers over a dtype's whole range, many of them equal."""
    of = getattr(torch, dtype)
    drawn = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    drawn[: shape[0] // 2] = (drawn[: shape[0] // 2] * 4).floor() / 4
    if of.is_floating_point:
        return ((drawn - 0.5) * 2e4).to(of)
    ends = torch.iinfo(of)
    return (drawn * (ends.max - ends.min) + ends.min).round().to(torch.int32).to(of)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("factor", [2, 3, (1, 2, 3)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_tensors_are_reduced_to_the_bits_of_arrays(dtype, factor, device):
    array = as_grid(random_data(dtype, (13, 9, 17, 2)))
    wider = {"uint16": np.int32}.get(dtype, array.dtype)
    tensor = torch.from_numpy(array.astype(wider)).to(device)
    for reduce in (pool_mean, pool_min, pool_max):
        actual = reduce(tensor, factor)
        assert actual.dtype == tensor.dtype
        np.testing.assert_array_equal(actual.cpu().numpy(), reduce(array, factor))
    for reduction in ("min", "max", "mean"):
        actual = by_node(tensor, reduction, 4, 1)
        assert actual.dtype == torch.float32
        np.testing.assert_array_equal(actual.cpu().numpy(), by_node(array, reduction, 4, 1))
        np.testing.assert_array_equal(
            reduce_windows(tensor, reduction, size=3, step=2).cpu().numpy(),
            reduce_windows(array, reduction, size=3, step=2),
        )


@pytest.mark.parametrize("device", ["nonsense", "cuda:99", 5.5])
def test_a_device_that_is_not_there_is_told(device):
    volume = gv.Volume(random_data("uint8", (8, 8, 8, 1)))
    tree = gv.N3Tree.from_volume(volume)
    calls = {
        "from_volume": lambda: gv.N3Tree.from_volume(volume, device=device),
        "N3Tree.to": lambda: tree.to(device),
        "Volume.to": lambda: volume.to(device),
    }
    for context, call in calls.items():
        with pytest.raises(ValueError, match=f"^{context}: device "):
            call()


@pytest.mark.parametrize("dtype", DTYPES)
def test_grids_come_back_as_they_went(dtype):
    data = random_data(dtype, (5, 4, 3, 1))
    assert torch.equal(movable(from_grid(as_grid(data), data.dtype)), movable(data))


def parts(tree: gv.N3Tree) -> dict[str, torch.Tensor]:
    """Returns all words and voxels of a tree, on the host."""
    pools = {f"nodes.{name}": value for name, value in vars(tree.nodes).items()}
    pools |= {f"bricks.{name}": value for name, value in vars(tree.bricks).items()}
    tensors = {}
    for name, value in pools.items():
        for key, item in (value if isinstance(value, dict) else {"": value}).items():
            if isinstance(item, torch.Tensor):
                tensors[f"{name}.{key}"] = movable(item).cpu()
    return tensors


@pytest.mark.parametrize("branching", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.backend("cuda")
def test_a_tree_made_on_a_device_is_the_one_made_on_the_host(dtype, branching):
    data = random_data(dtype, (50, 37, 61, 2))
    data[30:, :, 20:] = 3  # CONSTANT regions
    options = {"branching": branching, "threshold": 3.0, "border": 1}
    for there in (data, data.cuda()):
        volume = gv.Volume(there, spacing=(1, 2, 3))
        assert volume.data.device == there.device
        on_device = gv.N3Tree.from_volume(volume, device="cuda", **options)
        host = gv.N3Tree.from_volume(gv.Volume(data, spacing=(1, 2, 3)), **options)
        assert on_device.bricks.bricks["value"].is_cuda
        assert on_device.value_range == host.value_range
        actual, expected = parts(on_device), parts(host)
        assert actual.keys() == expected.keys() and len(actual) > 8
        for name, part in expected.items():
            assert torch.equal(actual[name], part), name


@pytest.mark.backend("cuda")
def test_labels_and_directional_volumes_of_a_device():
    values = torch.randint(0, 5, (20, 20, 20), generator=torch.Generator().manual_seed(1))
    colors = torch.rand(20, 20, 20, 4, generator=torch.Generator().manual_seed(1))
    for volume in (gv.Volume(values, labels=True), gv.Volume(colors).directional()):
        on_device = gv.N3Tree.from_volume(volume, device="cuda")
        expected = parts(gv.N3Tree.from_volume(volume))
        for name, part in parts(on_device).items():
            assert torch.equal(part, expected[name]), name


@pytest.mark.backend("cuda")
def test_a_volume_on_a_device_serves_the_host_too(tmp_path):
    data = random_data("uint8", (20, 24, 28, 1))
    volume, there = gv.Volume(data), gv.Volume(data.cuda())
    assert there.describe() == volume.describe()
    assert there.value_range == volume.value_range
    assert torch.equal(there.to("cpu").data, data)
    picture = gv.slice_picture(there, "z", 5)
    assert torch.equal(picture.color, gv.slice_picture(volume, "z", 5).color)
    gv.convert(there, tmp_path / "a.zarr")
    assert torch.equal(gv.read_volume(tmp_path / "a.zarr").data, data)
    shader = gv.TransferFunction.from_points([(0, 0), (255, 0.1)])
    camera = gv.Camera.orbit(30, 20, 2.0, 35, 32, 32)
    with gv.Engine(gv.VolumeProducer(there), device="cuda") as engine:
        tree = gv.N3Tree.from_volume(there, device="cuda")
        streamed = engine.render(camera, shader)
        assert torch.equal(streamed.color, gv.render(tree, camera, shader).color)
