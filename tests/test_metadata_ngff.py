"""OME-NGFF metadata: units, channels, times and associated data of an image are read back as they
were written, by gvtorch and by other libraries.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.stores import noise, read_with_warnings, serving, write_foreign
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base.image_info import ChannelInfo, ImageInfo
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.store import Store
from gvtorch.tools.cli import main

names = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=12)
numbers = st.floats(-1e6, 1e6, width=32)
positive = st.floats(1e-3, 1e3)
bytes_8 = st.integers(0, 255).map(lambda n: n / 255)
channels = st.builds(
    ChannelInfo,
    name=names,
    color=st.none() | st.tuples(bytes_8, bytes_8, bytes_8),
    window=st.none() | st.tuples(numbers, numbers).map(lambda w: (min(w), max(w))),
    active=st.booleans(),
)
lengths = st.sampled_from(["angstrom", "micrometer", "millimeter", "meter", "parsec", "yard"])
infos = st.builds(
    ImageInfo,
    unit=st.none() | lengths,
    channels=st.just(()) | st.lists(channels, min_size=2, max_size=2),
    quantity=st.none() | st.just("HU"),
    space=st.none() | st.just("left-posterior-superior"),
    time_step=positive,
    time_origin=st.floats(-1e3, 1e3),
    time_unit=st.sampled_from(["second", "millisecond", "day"]),
)


@settings(
    max_examples=18,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    info=infos,
    times=st.integers(1, 3),
    spacing=st.tuples(positive, positive, positive),
    origin=st.tuples(*[st.floats(-1e4, 1e4)] * 3),
    dtype=st.sampled_from(["uint8", "int16", "float32"]),
)
def test_what_ngff_holds_comes_back(tmp_path, info, times, spacing, origin, dtype):
    """A store, its conversion, and a volume read from it have the original metadata."""
    import yaozarrs

    from gvtorch.io.source import MemorySource

    for name in ("a.zarr", "b.zarr"):
        shutil.rmtree(tmp_path / name, ignore_errors=True)
    data = np.stack([noise((4, 5, 6, 2), dtype, seed=n) for n in range(times)])
    source = MemorySource.of(data, path="a", spacing=spacing, origin=origin, info=info)
    expected = info
    if times == 1:
        expected = ImageInfo(**{**vars(info), "time_step": None, "time_unit": None})
        expected = ImageInfo(**{**vars(expected), "time_origin": 0.0})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gvtorch.io.stores.conversion_plan.open_source", lambda *_, **__: source)
        patch.setattr("gvtorch.io.stores.unfinished.fingerprint", lambda *_: [])
        store = convert("a", tmp_path / "a.zarr", workers=1)
    yaozarrs.validate_zarr_store(str(tmp_path / "a.zarr"))
    for reopened in (store, convert(tmp_path / "a.zarr", tmp_path / "b.zarr", workers=1)):
        assert reopened.info == expected and not reopened.dropped
        assert reopened.spacing == spacing and reopened.origin == origin and reopened.times == times
        for time in range(times):
            region = Store.open(reopened.location, time=time).read_region(0, (0, 0, 0), (4, 5, 6))
            assert np.array_equal(region, data[time])
    volume, warned = read_with_warnings(tmp_path / "b.zarr", time=times - 1)
    assert volume.info == expected and not warned
    assert volume.spacing == spacing and np.array_equal(volume.data.numpy(), data[-1])


OMERO = {
    "id": 1,
    "name": "cells",
    "channels": [
        {
            "label": "DAPI",
            "color": "0000FF",
            "window": {"min": 0, "max": 65535, "start": 200, "end": 1500},
            "active": True,
            "coefficient": 1,
            "family": "linear",
            "inverted": False,
        },
        {
            "label": "GFP",
            "color": "#00ff00",
            "window": {"min": 0, "max": 65535, "start": 10.5, "end": 900},
            "active": False,
        },
    ],
    "rdefs": {"defaultT": 0, "defaultZ": 3, "model": "color"},
}
TOLD = (
    ChannelInfo(name="DAPI", color=(0, 0, 1), window=(200, 1500)),
    ChannelInfo(name="GFP", color=(0, 1, 0), window=(10.5, 900), active=False),
)


def test_an_image_that_yaozarrs_wrote(tmp_path):
    """0.5: five axes with units, `omero`, labels, and several series in a file."""
    from yaozarrs import v05
    from yaozarrs.write.v05 import write_bioformats2raw, write_image

    data = noise((3, 2 * 9, 20, 30), "uint16").reshape(3, 2, 9, 20, 30)
    axes = [
        v05.TimeAxis(name="t", unit="second"),
        v05.ChannelAxis(name="c"),
        *(v05.SpaceAxis(name=name, unit="micrometer") for name in "zyx"),
    ]

    def image(axes: list, scale: list[float], move: list[float]) -> v05.Image:
        transforms = [
            v05.ScaleTransformation(scale=scale),
            v05.TranslationTransformation(translation=move),
        ]
        dataset = v05.Dataset(path="0", coordinateTransformations=transforms)
        scales = v05.Multiscale(name="cells", axes=axes, datasets=[dataset])
        return v05.Image(multiscales=[scales], omero=v05.Omero.model_validate(OMERO))

    whole = image(axes, [30, 1, 2, 0.5, 0.25], [60, 0, 10, 20, 30])
    flat = image(axes[2:], [2, 0.5, 0.25], [0, 0, 0])
    label = v05.LabelImage.model_validate(
        {
            "multiscales": flat.multiscales,
            "image-label": {"colors": [{"label-value": 1, "rgba": [255, 0, 0, 255]}]},
        }
    )
    write_image(tmp_path / "a.zarr", whole, data, labels={"nuclei": (label, data[0, 0])})
    with pytest.warns(UserWarning, match=r"a\.zarr: not kept: the labels labels/nuclei"):
        store = convert(tmp_path / "a.zarr", tmp_path / "b.zarr")
    for opened in (Store.open(tmp_path / "a.zarr"), store):
        info = opened.info
        assert opened.times == 3 and info.channels == TOLD
        assert (info.unit, info.time_unit) == ("micrometer", "second")
        assert (info.time_step, info.time_origin) == (30, 60)
        assert opened.spacing == (0.25, 0.5, 2) and opened.origin == (30, 20, 10)
    assert Store.open(tmp_path / "a.zarr").dropped == ("the labels labels/nuclei",)
    volume, warned = read_with_warnings(tmp_path / "b.zarr", time=2)
    assert np.array_equal(volume.data.numpy(), data[2].transpose(1, 2, 3, 0)) and not warned
    nuclei = Store.open(tmp_path / "a.zarr", image="labels/nuclei")
    assert nuclei.info.labels and nuclei.dropped == ("colors of the labels",)
    series = {name: (image(axes, [1.0] * 5, [0] * 5), data) for name in ("0", "1")}
    write_bioformats2raw(tmp_path / "two.zarr", series)
    assert Store.open(tmp_path / "two.zarr").dropped == (
        "the images 1 beside 'cells' (key= or image= names one)",
    )


def test_an_image_that_ome_zarr_models_wrote(tmp_path):
    """0.4 on Zarr v2."""
    import zarr
    from ome_zarr_models.v04 import Image
    from ome_zarr_models.v04.axes import Axis
    from pydantic_zarr.v2 import ArraySpec

    data = noise((2 * 9, 20, 30, 1), "int16")[..., 0].reshape(2, 9, 20, 30)
    image = Image.new(
        array_specs=[ArraySpec.from_array(data, chunks=(1, 9, 16, 16))],
        paths=["full"],
        axes=[
            Axis(name="t", type="time", unit="hour"),
            *(Axis(name=name, type="space", unit="millimeter") for name in "zyx"),
        ],
        scales=[[0.5, 3, 2, 1]],
        translations=[[0, 1, 2, 3]],
        name="heart",
    )
    group = image.to_zarr(zarr.storage.LocalStore(tmp_path / "a"), path="")
    group["full"][...] = data
    store = convert(tmp_path / "a", tmp_path / "b.zarr")
    assert store.spacing == (1, 2, 3) and store.origin == (3, 2, 1) and store.times == 2
    assert (store.info.unit, store.info.time_unit) == ("millimeter", "hour")
    assert store.info.time_step == 0.5
    for time in range(2):
        volume, warned = read_with_warnings(tmp_path / "a", time=time)
        assert np.array_equal(volume.data[..., 0].numpy(), data[time]) and not warned


def with_omero(folder: Path, omero: object, version: int) -> Path:
    """Writes an image of two channels with zarr-python."""
    data = noise((6, 7, 8, 2), "uint16").transpose(3, 0, 1, 2)
    write_foreign(folder, [data], "czyx", [[1.0] * 4], version=version)
    file = folder / (".zattrs" if version == 2 else "zarr.json")
    content = json.loads(file.read_text())
    (content if version == 2 else content["attributes"]["ome"])["omero"] = omero
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("version", [2, 3])
def test_channels_of_foreign_images(tmp_path, version):
    folder = with_omero(tmp_path / "a", OMERO, version)
    store = Store.open(folder)
    assert store.info.channels == TOLD and not store.dropped
    assert Store.open(folder, channels=[1]).info.channels == TOLD[1:]
    volume, warned = read_with_warnings(folder)
    assert volume.info.channels == TOLD and not warned
    converted = convert(folder, tmp_path / "b.zarr")
    assert converted.info.channels == TOLD
    attributes = json.loads((tmp_path / "b.zarr/zarr.json").read_text())["attributes"]
    first = attributes["ome"]["omero"]["channels"][0]
    assert (first["label"], first["color"], first["active"]) == ("DAPI", "0000FF", True)
    assert (first["window"]["start"], first["window"]["end"]) == (200, 1500)
    assert converted.describe()["channel info"] == {
        "0": "DAPI, #0000ff, 200 to 1500",
        "1": "GFP, #00ff00, 10.5 to 900, not shown at first",
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": "red"}, "color 'red' of channel 0"),
        ({"color": 255}, "color 255 of channel 0"),
        ({"window": {"start": 1}}, "window {'start': 1} of channel 0"),
        ({"window": {"start": 9, "end": 1}}, "of channel 0"),
        ({"window": {"start": float("nan"), "end": 1}}, "of channel 0"),
        ({"window": [0, 1]}, "window [0, 1] of channel 0"),
        ({"inverted": True}, "channel 0 is shown inverted"),
    ],
)
def test_damaged_channels_are_named_and_do_not_keep_it_shut(tmp_path, change, message):
    first, second = OMERO["channels"]
    folder = with_omero(tmp_path / "a", {"channels": [{**first, **change}, second]}, 3)
    volume, (line,) = read_with_warnings(folder)
    assert message in line and "\n" not in line and volume.info.channels[1] == TOLD[1]
    for omero, complaint in (
        ([], "holds no list of channels"),
        ({"channels": [first]}, "metadata of 1 channels, where there are 2"),
    ):
        with_omero(folder, omero, 3)
        volume, (line,) = read_with_warnings(folder)
        assert complaint in line and volume.info.channels == ()


def test_what_lies_beside_an_image_is_named(tmp_path):
    data = noise((6, 7, 8, 1), "uint8")[..., 0]
    several = tmp_path / "several"
    for name in "012":
        write_foreign(several / name, [data + int(name)], "zyx", [[1.0] * 3], version=2, name=name)
    (several / ".zgroup").write_text('{"zarr_format": 2}')
    (several / ".zattrs").write_text('{"bioformats2raw.layout": 3}')
    (several / "OME").mkdir()
    (several / "OME/.zattrs").write_text('{"series": ["0", "1", "2"]}')
    volume, (line,) = read_with_warnings(several)
    assert "not kept: the images 1, 2 beside '0'" in line and volume.data[0, 0, 0] == data[0, 0, 0]
    volume, warned = read_with_warnings(several, key="2")
    assert not warned and volume.data[0, 0, 0, 0] == data[0, 0, 0] + 2
    (several / "OME/.zattrs").write_text('{"series": ["2", "0"]}')
    volume, (line,) = read_with_warnings(several)
    assert "the images 0 beside '2'" in line and volume.data[0, 0, 0] == data[0, 0, 0] + 2
    assert convert(several, tmp_path / "one.zarr", key="1").info == ImageInfo()
    assert Store.open(tmp_path / "one.zarr").read_region(0, (0,) * 3, (1,) * 3) == data[0, 0, 0] + 1
    write_foreign(tmp_path / "cells.zarr", [data], "zyx", [[1.0] * 3])
    group = {"zarr_format": 3, "node_type": "group", "attributes": {"ome": {"labels": ["nuclei"]}}}
    for labels in (tmp_path / "cells.zarr", tmp_path / "one.zarr"):
        write_foreign(labels / "labels/nuclei", [data], "zyx", [[1.0] * 3])
        (labels / "labels/zarr.json").write_text(json.dumps(group))
        assert "the labels labels/nuclei" in read_with_warnings(labels)[1][0]
        assert read_with_warnings(labels, key="labels/nuclei")[1] == []
    with serving(tmp_path) as url:
        for base in (tmp_path, url):
            assert read_with_warnings(f"{base}/cells.zarr:/labels/nuclei")[1] == []
            with pytest.raises(ValueError, match="no image 'labels/none'"):
                read_with_warnings(f"{base}/cells.zarr:/labels/none")
    (tmp_path / "plate").mkdir()
    (tmp_path / "plate/.zgroup").write_text('{"zarr_format": 2}')
    (tmp_path / "plate/.zattrs").write_text('{"plate": {}}')
    write_foreign(tmp_path / "plate/A/1/0", [data], "zyx", [[1.0] * 3], version=2)
    with pytest.raises(ValueError, match="it is a plate: name a field of view, as in 'A/1/0'"):
        gv.read_volume(tmp_path / "plate")
    assert read_with_warnings(tmp_path / "plate", key="A/1/0")[0].extent == (8, 7, 6)
    (tmp_path / "plate/.zattrs").unlink()  # a group like any other
    image, _ = read_with_warnings(f"{tmp_path}/plate:/A/1/0")
    assert np.array_equal(image.data[..., 0].numpy(), data)


@pytest.mark.parametrize("step", [0.0, -1.0])
def test_time_steps_that_are_none_are_left_out(tmp_path, step):
    data = np.zeros((2, 3, 4, 5), np.uint8)
    assert Store.open(write_foreign(tmp_path, [data], "tzyx", [[step, 1, 1, 1]])).info == (
        ImageInfo()
    )


def test_axes_and_units_of_other_kinds(tmp_path):
    data = noise((3, 6, 7, 8), "uint8")
    folder = write_foreign(tmp_path / "a", [data], "czyx", [[1.0, 2.0, 3.0, 4.0]])
    file = folder / "zarr.json"
    content = json.loads(file.read_text())
    image = content["attributes"]["ome"]["multiscales"][0]
    image["axes"] = [
        {"name": "angle", "type": "angle"},
        {"name": "z", "type": "space", "unit": "micrometer"},
        {"name": "y", "type": "space", "unit": "nanometer"},
        {"name": "x", "type": "space", "unit": "nanometer"},
    ]
    image["coordinateTransformations"] = [{"type": "rotation", "rotation": []}]
    file.write_text(json.dumps(content))
    volume, (line,) = read_with_warnings(folder)
    assert np.array_equal(volume.data[..., 0].numpy(), data[0])
    assert volume.spacing == (4, 3, 2000) and volume.info.unit == "nanometer"
    assert "an axis that is none of t, c, z, y, x: the first of 3 is read" in line
    assert "a transformation of type 'rotation'" in line
    for letter, unit in (("z", "mm"), ("y", "um"), ("x", "\u00b5m")):
        image["axes"]["azyx".index(letter)]["unit"] = unit
    file.write_text(json.dumps(content))
    volume, _ = read_with_warnings(folder)
    assert volume.spacing == (4, 3, 2000) and volume.info.unit == "micrometer"
    image["axes"][2]["unit"] = image["axes"][3]["unit"] = "nanometer"
    image["axes"][0] = {"name": "lambda", "type": "channel"}
    image["axes"][1]["unit"] = "parsec"
    file.write_text(json.dumps(content))
    volume, (line,) = read_with_warnings(folder)
    assert volume.data.shape[3] == 3 and volume.spacing == (4, 3, 2)
    assert "unit 'parsec' of z, where that of x is 'nanometer'" in line


def test_the_command_line_tells_and_names_components(tmp_path, capsys):
    folder = with_omero(tmp_path / "a.zarr", OMERO, 3)
    main(["info", str(folder)])
    out = capsys.readouterr().out
    assert "0: DAPI, #0000ff, 200 to 1500" in out
    with pytest.raises(SystemExit):
        main(["render", str(folder), "-o", str(tmp_path / "a.png"), "--component", "2"])
    err = capsys.readouterr().err
    assert err == "gvtorch: error: --component 2: a voxel has 2 numbers: 0 (DAPI), 1 (GFP)\n"
    volume = gv.Volume(torch.zeros(3, 3, 3, 2), info=ImageInfo(channels=TOLD[:1]))
    with pytest.raises(ValueError, match="its info names 1 channels, it has 2"):
        convert(volume, tmp_path / "b.zarr")


def holders(value: Any) -> list[tuple[Any, Any]]:
    """Returns every position in a JSON value, as its container and key."""
    pairs = []
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        pairs.append((value, key))
        if isinstance(inner, (dict, list)):
            pairs += holders(inner)
    return pairs


def test_metadata_broken_anywhere_is_one_line(tmp_path):
    """Every value of an image's metadata is replaced by invalid ones."""
    info = ImageInfo(unit="meter", channels=TOLD, time_step=2.0, quantity="HU")
    data = noise((9, 9, 9, 2))
    convert(gv.Volume(data, info=info), tmp_path / "own.zarr")
    foreign = with_omero(tmp_path / "foreign", OMERO, 3)
    refused = opened = 0
    for folder in (tmp_path / "own.zarr", foreign):
        file = folder / "zarr.json"
        whole = file.read_text()
        for number in range(len(holders(json.loads(whole)))):
            for bad in (None, "\u2028\n", -1, [1] * 9999, {}, 10**400, 5e-324, True, "../.."):
                content = json.loads(whole)
                holder, key = holders(content)[number]
                holder[key] = bad
                file.write_text(json.dumps(content))
                try:
                    Store.open(folder).describe()
                    opened += 1
                except (ValueError, OSError) as error:
                    assert "\n" not in str(error) and str(folder) in str(error), str(error)
                    assert len(str(error)) < 1000
                    refused += 1
        file.write_text(whole)
        assert np.array_equal(
            Store.open(folder).read_region(0, (0,) * 3, (1,) * 3).shape, (1, 1, 1, 2)
        )
    assert refused > 300 and opened > 100
