"""CZI by pylibCZIrw; LIF files written here, which readlif reads the same; ND2 through a mock of
nd2, because no library writes such files.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import Library
from helpers.damage import assert_robust
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.stores.conversion import convert

czi = Library("pylibCZIrw.czi")


@pytest.fixture
def five() -> np.ndarray:
    return noise((2, 3, 4, 20, 30), "uint16")  # t c z y x


# --- CZI


def write_czi(file: Path, five: np.ndarray, scenes: int = 1, packed: str | None = None) -> Path:
    with czi.create_czi(str(file), exist_ok=True, compression_options=packed) as out:
        for scene in range(scenes):
            for t, c, z in np.ndindex(five.shape[:3]):
                plane = {"T": t, "C": c, "Z": z}
                corner = (100 * scene + 7, 50 * scene)
                out.write(five[t, c, z] + scene, location=corner, plane=plane, scene=scene)
        color, mode = czi.Rgb8Color, czi.TintingMode.Color
        settings_class = czi.ChannelDisplaySettingsDataClass
        out.write_metadata(
            "scan",
            channel_names=dict(enumerate(["DAPI", "GFP", "Cy5"][: five.shape[1]])),
            scale_x=1e-7,
            scale_y=2e-7,
            scale_z=3e-6,
            display_settings={0: settings_class(True, mode, color(255, 0, 51), 0.1, 0.9)},
        )
    return file


@pytest.mark.parametrize("packed", [None, "zstd1:ExplicitLevel=2"])
def test_czi(tmp_path, five, packed):
    source = open_source(write_czi(tmp_path / "a.czi", five, packed=packed), time=1)
    assert (source.extent, source.times, source.width) == ((30, 20, 4), 2, 3)
    assert source.spacing == pytest.approx((0.1, 0.2, 3)) and source.info.unit == "micrometer"
    assert [channel.name for channel in source.info.channels] == ["DAPI", "GFP", "Cy5"]
    first = source.info.channels[0]
    assert first.color == (1, 0, 0.2) and first.window == pytest.approx((6553.5, 58981.5))
    whole = np.moveaxis(five, 1, -1)
    assert np.array_equal(source.read_times(0, 2), whole)
    part = source.read_region((1, 2, 3), (3, 9, 20))
    assert np.array_equal(part, whole[1, 1:3, 2:9, 3:20]) and not source.whole


def test_scenes_of_czi(tmp_path, five):
    file = write_czi(tmp_path / "a.czi", five[:1, :1], scenes=2)
    with pytest.warns(UserWarning, match="1 other scenes; key .* among 0, 1"):
        volume = gv.read_volume(file)
    assert np.array_equal(volume.data[..., 0].numpy(), five[0, 0])
    other = gv.read_volume(file, key="1")
    assert np.array_equal(other.data[..., 0].numpy(), five[0, 0] + 1)
    with pytest.raises(ValueError, match="has no scene '2'; it holds 0, 1"):
        gv.read_volume(file, key="2")
    store = convert(file, tmp_path / "a.zarr", key="1")
    assert np.array_equal(store.read_region(0, (0, 0, 0), (4, 20, 30)), other.data.numpy())


def test_colors_of_czi(tmp_path):
    rgb = noise((20, 30, 3))
    with czi.create_czi(str(tmp_path / "a.czi")) as out:
        out.write(rgb[..., ::-1].copy(), plane={"C": 0})
        out.write_metadata("a")
    volume = gv.read_volume(tmp_path / "a.czi")
    assert np.array_equal(volume.data[0].numpy(), rgb)
    assert [channel.name for channel in volume.info.channels] == ["red", "green", "blue"]


@pytest.mark.long
def test_broken_czi_gives_one_line(tmp_path, five):
    assert_robust(write_czi(tmp_path / "a.czi", five), tmp_path / "broken")


# --- LIF


def write_lif(file: Path, images: dict[str, np.ndarray]) -> Path:
    """Writes (t, c, z, y, x) images, with channels inside of slices, as the format has them."""
    elements, blocks = "", b""
    for number, (name, data) in enumerate(images.items()):
        t, c, z, y, x = data.shape
        size = data.itemsize
        channels = "".join(
            f'<ChannelDescription DataType="0" Resolution="{8 * size}" LUTName="{color}" '
            f'BytesInc="{i * x * y * size}"/>'
            for i, color in zip(range(c), ("Green", "Red", "Blue"), strict=False)
        )
        steps = (size, x * size, c * x * y * size, c * x * y * z * size)
        lengths = (1e-7 * (x - 1), 2e-7 * (y - 1), -3e-6 * (z - 1), 2.5 * (t - 1))
        axes = "".join(
            f'<DimensionDescription DimID="{i + 1}" NumberOfElements="{n}" Origin="0" '
            f'Length="{length}" Unit="{"s" if i == 3 else "m"}" BytesInc="{step}"/>'
            for i, (n, length, step) in enumerate(zip((x, y, z, t), lengths, steps, strict=True))
        )
        elements += (
            f'<Element Name="{name}"><Memory Size="{data.nbytes}" MemoryBlockID="Block_{number}"/>'
            f"<Data><Image><ImageDescription><Channels>{channels}</Channels>"
            f"<Dimensions>{axes}</Dimensions></ImageDescription></Image></Data></Element>"
        )
        called = f"Block_{number}"
        head = struct.pack("<IIBQBI", 0x70, 0, 0x2A, data.nbytes, 0x2A, len(called))
        content = np.ascontiguousarray(data.transpose(0, 2, 1, 3, 4)).tobytes()
        blocks += head + called.encode("utf-16-le") + content
    xml = (
        '<LMSDataContainerHeader Version="2"><Element Name="project"><Children>'
        f"{elements}</Children></Element></LMSDataContainerHeader>"
    )
    head = struct.pack("<IIBI", 0x70, 0, 0x2A, len(xml))
    file.write_bytes(head + xml.encode("utf-16-le") + blocks)
    return file


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of readlif
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_lif(tmp_path, dtype):
    readlif = pytest.importorskip("readlif.reader")
    five, other = noise((2, 3, 4, 20, 30), dtype), noise((1, 1, 2, 5, 6), dtype)
    file = write_lif(tmp_path / "a.lif", {"cells": five, "small": other})
    theirs = readlif.LifFile(str(file)).get_image(0)
    assert np.array_equal(np.array(theirs.get_frame(z=2, t=1, c=1)), five[1, 1, 2])
    with pytest.warns(UserWarning, match="1 other images; key .* among 0 'cells', 1 'small'"):
        source = open_source(file, time=1)
    assert (source.extent, source.times, source.width) == ((30, 20, 4), 2, 3)
    assert source.spacing == pytest.approx((0.1, 0.2, 3)) and source.info.unit == "micrometer"
    assert (source.info.time_step, source.info.time_unit) == (2.5, "second")
    assert [c.color for c in source.info.channels] == [(0, 1, 0), (1, 0, 0), (0, 0, 1)]
    assert [c.name for c in source.info.channels] == ["Green", "Red", "Blue"]
    whole = np.moveaxis(five, 1, -1)[:, ::-1]  # slices run downwards, as their length says
    assert np.array_equal(source.read_times(0, 2), whole)
    part = source.read_region((1, 2, 3), (3, 9, 20))
    assert np.array_equal(part, whole[1, 1:3, 2:9, 3:20]) and not source.whole
    for key in ("1", "small"):
        assert np.array_equal(gv.read_volume(file, key=key).data[..., 0].float(), other[0, 0, ::-1])
    with pytest.raises(ValueError, match="has no image 'big'; it holds 0 'cells', 1 'small'"):
        gv.read_volume(file, key="big")


def test_lif_of_a_block_of_180_gb(tmp_path):
    """A byte of its length equals the mark behind a length of four bytes; the file is sparse."""
    data, length = noise((1, 1, 2, 5, 6)), 42 << 32
    file = write_lif(tmp_path / "a.lif", {"cells": data})
    content = file.read_bytes()
    size = struct.pack("<Q", data.nbytes)
    assert content.count(size) == 1
    file.write_bytes(content.replace(size, struct.pack("<Q", length)))
    os.truncate(file, len(content) - data.nbytes + length)
    assert np.array_equal(open_source(file).read_times(0, 1)[0, ..., 0], data[0, 0, ::-1])


def test_broken_lif_gives_one_line(tmp_path, five):
    assert_robust(write_lif(tmp_path / "a.lif", {"cells": five}), tmp_path / "broken")


# --- ND2


class StandIn:
    """The part of `nd2.ND2File` that the reader uses: frames (c, y, x) of times, positions, z."""

    data = np.stack([noise((2, 4, 3, 20, 30), "uint16") + p for p in range(2)], 1)  # t p z c y x

    def __init__(self, path: str) -> None:
        t, p, z, c, y, x = self.data.shape
        self.sizes = {"T": t, "P": p, "Z": z, "C": c, "Y": y, "X": x}
        self.dtype = self.data.dtype
        self.loop_indices = tuple(
            {"T": i, "P": j, "Z": k} for i, j, k in np.ndindex(self.data.shape[:3])
        )
        colors = (SimpleNamespace(r=255, g=0, b=51, a=1.0), None, None)
        channels = [
            SimpleNamespace(channel=SimpleNamespace(name=name, color=color))
            for name, color in zip(("DAPI", "GFP", "Cy5"), colors, strict=True)
        ]
        self.metadata = SimpleNamespace(channels=channels)
        loop = SimpleNamespace(type="TimeLoop", parameters=SimpleNamespace(periodMs=500.0))
        self.experiment, self.rois = [loop], {}

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def voxel_size(self) -> tuple[float, float, float]:
        return (0.1, 0.2, 3.0)

    def read_frame(self, number: int) -> np.ndarray:
        indices = self.loop_indices[number]
        return self.data[indices["T"], indices["P"], indices["Z"]].squeeze()


def test_nd2_through_a_stand_in(tmp_path, monkeypatch):
    nd2 = pytest.importorskip("nd2")
    for name in ("sizes", "dtype", "loop_indices", "metadata", "experiment", "rois", "read_frame"):
        assert hasattr(nd2.ND2File, name), f"nd2 has no {name} any more"
    monkeypatch.setattr(nd2, "ND2File", StandIn)
    (tmp_path / "a.nd2").write_bytes(b"")
    with pytest.warns(UserWarning, match="1 other positions; key .* among 0, 1"):
        source = open_source(tmp_path / "a.nd2", time=1)
    whole = np.moveaxis(StandIn.data[:, 0], 2, -1)
    assert np.array_equal(source.read_times(0, 2), whole)
    part = source.read_region((1, 2, 3), (3, 9, 20))
    assert np.array_equal(part, whole[1, 1:3, 2:9, 3:20])
    assert source.spacing == (0.1, 0.2, 3) and source.info.unit == "micrometer"
    assert (source.info.time_step, source.info.time_unit) == (500, "millisecond")
    assert source.info.channels[0] == gv.ChannelInfo(name="DAPI", color=(1, 0, 0.2))
    other = open_source(tmp_path / "a.nd2", key="1")
    assert np.array_equal(other.read_times(0, 1)[0], np.moveaxis(StandIn.data[0, 1], 1, -1))
    with pytest.raises(ValueError, match="has no position '2'; it holds 0, 1"):
        open_source(tmp_path / "a.nd2", key="2")


@pytest.mark.parametrize("content", [b"", b"\xda\xce\xbe\x0a" * 9, bytes(range(256)) * 16])
def test_what_is_no_nd2_is_one_line(tmp_path, content):
    pytest.importorskip("nd2")
    (tmp_path / "a.nd2").write_bytes(content)
    with pytest.raises((ValueError, OSError)) as caught:
        gv.read_volume(tmp_path / "a.nd2")
    assert "\n" not in str(caught.value) and "a.nd2" in str(caught.value)
