"""Decodes compressed DICOM frames with imagecodecs, as a decoding plugin of pydicom: RLE, JPEG (8
and 12 bits, lossless), JPEG-LS, JPEG 2000 and High-Throughput JPEG 2000.

The size in a frame's own header is compared with the file's header before the frame is decoded; RLE
frames do not state it, and are decoded to no more bytes than the file's header allows.
Source: DICOM PS3.5, annex A.
"""

from __future__ import annotations

from typing import Any

from .picture_size import jpeg2k_size, jpeg_size

_RLE = "1.2.840.10008.1.2.5"
_CODECS = {
    _RLE: "dicomrle",
    "1.2.840.10008.1.2.4.50": "jpeg",
    "1.2.840.10008.1.2.4.51": "jpeg",
    "1.2.840.10008.1.2.4.57": "ljpeg",
    "1.2.840.10008.1.2.4.70": "ljpeg",
    "1.2.840.10008.1.2.4.80": "jpegls",
    "1.2.840.10008.1.2.4.81": "jpegls",
    "1.2.840.10008.1.2.4.90": "jpeg2k",
    "1.2.840.10008.1.2.4.91": "jpeg2k",
    "1.2.840.10008.1.2.4.201": "jpeg2k",
    "1.2.840.10008.1.2.4.202": "jpeg2k",
    "1.2.840.10008.1.2.4.203": "jpeg2k",
}
DECODER_DEPENDENCIES = dict.fromkeys(_CODECS, ("imagecodecs",))
_PLUGIN_NAME = "gvtorch-imagecodecs"


def plugin_of(syntax: str) -> str:
    """Registers this plugin with pydicom and returns its name; "" if it can't decode `syntax`."""
    if syntax not in _CODECS:
        return ""
    from pydicom.pixels import get_decoder

    decoder = get_decoder(syntax)
    if _PLUGIN_NAME not in (*decoder.available_plugins, *decoder.missing_dependencies):
        decoder.add_plugin(_PLUGIN_NAME, (__name__, "decode_frame"))
    return _PLUGIN_NAME


def is_available(uid: str) -> bool:
    """Returns whether imagecodecs is installed; called by pydicom."""
    import importlib.util

    return uid in _CODECS and importlib.util.find_spec("imagecodecs") is not None


def decode_frame(packed: bytes, runner: Any) -> bytes:
    """Decodes a frame; called by pydicom.

    Raises:
        ValueError: The frame is damaged, or its size differs from that in the file's header.
    """
    import imagecodecs
    import numpy as np

    codec = _CODECS[str(runner.transfer_syntax)]
    if codec == "dicomrle":
        return _unpack_rle(packed, runner)
    expected = (runner.columns, runner.rows, runner.samples_per_pixel)
    size = jpeg2k_size(packed) if codec == "jpeg2k" else jpeg_size(packed)
    if size != expected:
        raise ValueError(f"a frame is of {size} (columns, rows, samples), not of {expected}")
    options: dict[str, Any] = {}
    if codec == "jpeg" and size[2] == 3:  # colours stay as they are stored: pydicom converts them
        options = {"colorspace": "YCBCR", "outcolorspace": "YCBCR"}
    data = np.asarray(getattr(imagecodecs, f"{codec}_decode")(packed, **options))
    if data.size != size[0] * size[1] * size[2] or data.dtype.kind not in "iu":
        raise ValueError(f"a frame holds {data.shape} {data.dtype}")
    if codec == "jpeg2k" and size[2] == 3:
        runner.set_option("photometric_interpretation", "RGB")
    runner.set_option("bits_allocated", 8 * data.dtype.itemsize)
    if size[2] > 1:
        runner.set_option("planar_configuration", 0)
    return np.ascontiguousarray(data).tobytes()


def _unpack_rle(packed: bytes, runner: Any) -> bytes:
    """Returns the values plane by plane, little-endian."""
    import imagecodecs

    width = runner.bits_allocated // 8
    size = runner.columns * runner.rows * runner.samples_per_pixel * width
    data = bytes(imagecodecs.dicomrle_decode(packed, f"<u{width}", out=size))
    if len(data) != size:
        raise ValueError(f"a frame unpacks to {len(data)} bytes, not to {size}")
    runner.set_option("planar_configuration", 1)
    return data
