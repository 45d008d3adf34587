"""`Volume`: a dense grid of values with a position in the world."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from . import check
from .boxes import check_extent
from .image_info import ImageInfo
from .labels import check_narrowed, counted, stored_labels

#: The dtypes that a brick channel can have. Wider ones are narrowed on the way in, see `Volume`.
CHANNEL_DTYPES = (
    torch.uint8,
    torch.int8,
    torch.int16,
    torch.uint16,
    torch.float16,
    torch.bfloat16,
    torch.float32,
)

_NUMPY_FLOATS = (torch.float16, torch.float32, torch.float64)
#: The viewing directions of `Volume.directional`, in the order of its numbers.
DIRECTIONS = ("+x", "-x", "+y", "-y", "+z", "-z")


class Volume:
    """A dense grid. The centre of voxel (x, y, z) lies at index * spacing + origin in the world.

    The box runs from voxel face to voxel face, -0.5 to n - 0.5 in index units; between the
    outermost centres and the box's faces the outermost values continue. Threads may share a volume
    that none of them changes.

    Attributes:
        data: (z, y, x, c) tensor, one of `CHANNEL_DTYPES`, on the device where it was given.
        spacing, origin, name, info: See the constructor.
        filter: How coarse levels are made: "mean"; "majority", the most frequent label; or
            "directional", what is seen along six directions, see `directional`.
        label_values: (k,) int64, sorted, where labels are indexed: the data's value i is the label
            label_values[i]. None: the data's values are the labels.
    """

    filter: Literal["mean", "majority", "directional"] = "mean"
    label_values: Tensor | None = None

    def __init__(
        self,
        data: Tensor | np.ndarray,
        spacing: Sequence[float] = (1.0, 1.0, 1.0),
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        name: str = "volume",
        nan: float | None = None,
        info: ImageInfo | None = None,
        labels: bool = False,
    ) -> None:
        """Checks a grid and holds it, without a copy where its dtype and layout allow.

        Args:
            data: (z, y, x) or (z, y, x, c). Any device, any byte order. bool becomes uint8; 32 and
                64 bit integers and float64 become float32. Labels are whole numbers of any dtype,
                below 2^63; those of more than 16 bits are indexed, see `label_values`.
            spacing: (x, y, z) world units, distance between neighbouring voxel centres.
            origin: (x, y, z) world units, centre of voxel 0.
            name: Where it came from, for messages.
            nan: Replaces values that are NaN or infinite; None: they are an error.
            info: Unit, names and colours of channels, ...; nothing is known if left out.
            labels: Whether values are label numbers: kept exactly, never blended, and shaded by
                `Labels`. Also true if `info.labels` is.

        Raises:
            ValueError: data is empty, of another shape, dtype or layout, a masked array (which
                `gv.as_volume` takes), has more than 2^31 voxels or holds values that are not
                finite, or integers beyond 2^24, which float32 can't all represent; spacing is not
                positive, or the origin lies more than 2^50 voxels from 0. Or labels are not whole
                numbers, or there are more than 2^24 of them.
            RuntimeError: data requires gradients, and autograd is recording.
        """
        context = f"Volume {name!r}" if name != "volume" else "Volume"
        if isinstance(data, Tensor):
            data = plain_tensor(context, data)
        elif isinstance(data, np.ma.MaskedArray):
            raise ValueError(f"{context}: data is a masked array, which gv.as_volume takes")
        nan = None if nan is None else check.number(context, "nan", nan)
        info = ImageInfo() if info is None else check.instance(context, "info", info, ImageInfo)
        if labels or info.labels:
            info, self.filter = replace(info, labels=True), "majority"
            data, self.label_values = _as_labels(context, data, nan)
        tensor = _as_tensor(context, data)
        if tensor.dim() not in (3, 4):
            got = check.as_text(data)
            raise ValueError(f"{context}: data must be (z, y, x) or (z, y, x, c), got {got}")
        if tensor.dim() == 3:
            tensor = tensor[..., None]
        check_extent(context, tensor.shape[:3], what="data")
        check_extent(context, tensor.shape, what="data with its channels")
        self.data = _finite_values(context, tensor.contiguous(), nan)
        self.spacing, self.origin = check.grid_placement(context, spacing, origin, self.extent)
        self.name, self.info = name, info

    @property
    def extent(self) -> tuple[int, int, int]:
        """Voxels in (x, y, z)."""
        z, y, x, _ = self.data.shape
        return (x, y, z)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the data: (z, y, x, c)."""
        z, y, x, c = self.data.shape
        return (z, y, x, c)

    @property
    def width(self) -> int:
        """How many numbers a voxel has."""
        return int(self.data.shape[3])

    @property
    def value_range(self) -> tuple[float, float]:
        """Smallest and largest value over all channels."""
        unordered = self.data.dtype == torch.uint16  # torch can't compare them
        low, high = torch.aminmax(self.data.to(torch.int32) if unordered else self.data)
        return (float(low), float(high))

    def to(self, device: torch.device | str) -> Volume:
        """Returns the volume with its data on a device; data that is there already is shared."""
        other = copy.copy(self)
        other.data = self.data.to(check.device("Volume.to", device))
        return other

    def directional(
        self, *, premultiplied: bool = False, dtype: torch.dtype = torch.float16
    ) -> Volume:
        """Returns a volume of colour and opacity for `StoredColor` with six directions: 24 numbers
        a voxel, namely for each of `DIRECTIONS` the premultiplied red, green, blue and the opacity
        seen along it. A finest voxel looks the same from all sides; in coarser voxels, the front
        hides what lies behind it. So thin walls let no light through, and their two sides keep
        their colours.

        Opacity is per length of the smallest spacing. `premultiplied` states whether colours are
        already multiplied by opacity; `dtype` is float16, bfloat16 or float32.

        Raises:
            ValueError: A voxel does not have 4 numbers, an opacity lies outside 0 to 1 (integers
                are scaled to 0 to 1), or the dtype is not one of the three.

        Source: Crassin et al., "Interactive indirect illumination using voxel cone tracing", CGF
            2011 (anisotropic voxels).
        """
        context = "Volume.directional"
        if dtype not in (torch.float16, torch.bfloat16, torch.float32):
            raise ValueError(f"{context}: dtype must be float16, bfloat16 or float32, got {dtype}")
        if self.width != 4:
            raise ValueError(
                f"{context}: needs red, green, blue and opacity, got {self.width} numbers a voxel"
            )
        rgba = self.data.to(torch.float32)
        if not self.data.is_floating_point():
            rgba = rgba / torch.iinfo(self.data.dtype).max
        color, opacity = rgba[..., :3], rgba[..., 3:]
        low, high = (float(end) for end in torch.aminmax(opacity))
        if low < 0 or high > 1:
            raise ValueError(f"{context}: opacity must lie in 0 to 1, got {low:g} to {high:g}")
        color = color if premultiplied else color * opacity
        views = torch.cat((color, opacity), -1).to(dtype).repeat(1, 1, 1, len(DIRECTIONS))
        info = replace(self.info, channels=(), quantity=None, labels=False)
        volume = Volume(views, self.spacing, self.origin, name=self.name, info=info)
        volume.filter = "directional"
        return volume

    def describe(self, bins: int = 32) -> dict[str, Any]:
        """Returns extent, dtype, position, range, a histogram of `bins` etc. as plain values."""
        check.integer("Volume.describe", "bins", bins, low=1)
        low, high = self.value_range
        values = to_numpy(self.data)
        limits = (low, high) if high > low else (low, low + max(1.0, abs(low)))
        counts, total = np.zeros(bins, np.int64), 0.0
        for plane in values:  # by z, in float64: the full range of float16 or float32 needs it
            plane64 = plane.astype(np.float64)
            counts += np.histogram(plane64, bins=bins, range=limits)[0]
            total += float(plane64.sum())
        return {
            "name": self.name,
            "extent": list(self.extent),
            "channels": self.width,
            "dtype": str(self.data.dtype).removeprefix("torch."),
            "spacing": list(self.spacing),
            "origin": list(self.origin),
            **self.info.describe(),
            **self._label_summary(),
            "range": [low, high],
            "mean": total / values.size,
            "histogram": [int(count) for count in counts],
            "bytes": self.data.nbytes,
        }

    def _label_summary(self) -> dict[str, Any]:
        """For label volumes: the count and range of the labels, without the background 0."""
        if not self.info.labels:
            return {}
        table = self.label_values
        stored = self.data.to(torch.int32)  # torch can't compare uint16
        label_numbers = stored.unique().to(torch.int64) if table is None else table
        note = "" if table is None else "; the other numbers are places in their list"
        return {"labels": f"{counted(label_numbers)}{note}"}

    def __repr__(self) -> str:
        dtype = str(self.data.dtype).removeprefix("torch.")
        extent = "x".join(str(size) for size in self.extent)
        return (
            f"Volume({self.name!r}, {extent} (x, y, z), {dtype}x{self.width}, "
            f"spacing={self.spacing})"
        )


def plain_tensor(context: str, data: Tensor) -> Tensor:
    """Returns voxels without gradients, and without a sign that torch has yet to change.

    Raises:
        RuntimeError: They require gradients, and autograd is recording.
        ValueError: They are sparse, quantized, or have no data (device meta).
    """
    if data.requires_grad and torch.is_grad_enabled():
        raise RuntimeError(
            f"{context}: data requires gradients, which a volume does not keep: take detach(); "
            'to learn voxels, let tree.bricks["value"] require gradients and render with a '
            "gv.ModuleShader"
        )
    if data.layout != torch.strided or data.is_quantized or data.is_meta:
        raise ValueError(f"{context}: data must be a dense tensor, got {check.describe(data)}")
    return data.detach().resolve_neg()


def to_numpy(values: Tensor) -> np.ndarray:
    """Returns voxels as an array; floats that NumPy lacks, such as bfloat16, as float32."""
    in_numpy = not values.is_floating_point() or values.dtype in _NUMPY_FLOATS
    return (values if in_numpy else values.float()).cpu().numpy()


def movable(tensor: Tensor) -> Tensor:
    """Returns the tensor, or for uint16, which torch can't index or write, a view as int16."""
    return tensor.view(torch.int16) if tensor.dtype == torch.uint16 else tensor


def _as_labels(
    context: str, data: Tensor | np.ndarray, nan: float | None
) -> tuple[Tensor | np.ndarray, Tensor | None]:
    """Returns labels as bricks hold them, and the table of labels if they are indexed."""
    device = data.device if isinstance(data, Tensor) else None
    if isinstance(data, Tensor):
        data = to_numpy(data)
    if not isinstance(data, np.ndarray) or data.ndim not in (3, 4) or not data.size:
        return data, None  # `_as_tensor` and `Volume` raise the error
    if data.dtype.kind == "f" and nan is not None:
        data = np.where(np.isfinite(data), data, nan)
    values, labels = stored_labels(context, data)
    tensor = _as_tensor(context, values).to(device)
    return tensor, None if labels is None else torch.from_numpy(labels)


def _as_tensor(context: str, data: Tensor | np.ndarray) -> Tensor:
    if isinstance(data, Tensor):
        tensor = data
    elif isinstance(data, np.ndarray):
        if data.dtype.kind not in "biuf":
            raise ValueError(f"{context}: data must hold numbers, got dtype {data.dtype}")
        if data.dtype.kind == "f" and data.dtype.itemsize > 8:
            data = data.astype(np.float64)
        native = data.astype(data.dtype.newbyteorder("="), copy=False)
        tensor = torch.from_numpy(np.require(native, requirements=["C", "W"]))
    else:
        raise ValueError(f"{context}: data must be a tensor or array, got {type(data).__name__}")
    if tensor.dtype == torch.bool:
        return tensor.to(torch.uint8)
    if tensor.dtype in CHANNEL_DTYPES:
        return tensor
    if tensor.is_complex():
        raise ValueError(f"{context}: data must hold real numbers, got {check.describe(tensor)}")
    if not tensor.is_floating_point():
        check_narrowed(context, tensor.cpu().numpy())
    return tensor.to(torch.float32)


def _finite_values(context: str, tensor: Tensor, nan: float | None) -> Tensor:
    if not tensor.is_floating_point() or tensor.numel() == 0:
        return tensor
    if nan is not None:
        limits = torch.finfo(tensor.dtype)
        nan = check.number(context, "nan", nan, low=limits.min, high=limits.max)
    low, high = torch.aminmax(tensor)
    if torch.isfinite(low) and torch.isfinite(high):
        return tensor
    bad_count = int((~torch.isfinite(tensor)).sum())
    if nan is None:
        raise ValueError(
            f"{context}: data holds {bad_count} values that are NaN or infinite "
            f"(of {tensor.numel()}); pass nan=VALUE (--nan VALUE) to replace them"
        )
    return torch.where(torch.isfinite(tensor), tensor, tensor.new_tensor(nan))
