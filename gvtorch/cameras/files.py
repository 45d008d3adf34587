"""`read_cameras`, `write_cameras`: cameras of other programs: ParaView's .pvcc, `transforms.json`
as Blender's add-ons and NeRF data sets have it, and COLMAP's text models.

| | axes of a camera | what is stored |
|---|---|---|
| .pvcc | view up, focal point | eye, target, up, vertical angle or parallel scale; one camera |
| .json | x right, y up, z back; camera to world | intrinsics in pixels, also of fisheyes |
| folder | x right, y down, z forward; world to camera | intrinsics in pixels, also of fisheyes |

Pixel centres lie at +0.5 in all of them, as here. None stores the largest angle of a fisheye.

Sources: COLMAP documentation, "Output format"; Mildenhall et al., "NeRF", 2020, released data;
ParaView, vtkSMCameraConfigurationWriter.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as xml
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.messages import one_line
from ..base.whole_file import write_text
from .camera import Camera
from .models import MODELS
from .motion import quaternion_of, rotation_of
from .poses import Coordinates

_FLIP = torch.tensor([1.0, -1, -1, 1], dtype=torch.float64, device="cpu").diag()  # y down to up
_PVCC_VECTORS = ("CameraPosition", "CameraFocalPoint", "CameraViewUp", "CenterOfRotation")
_PVCC_NUMBERS = ("CameraViewAngle", "CameraParallelScale", "CameraParallelProjection")
_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")  # the first four, if a fisheye's
_FISHEYE = "OPENCV_FISHEYE"
#: Parameters of COLMAP's models; distorted pinholes are read only if all their coefficients are 0.
_COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": ("fx", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("fx", "cx", "cy", "k1"),
    "RADIAL": ("fx", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    _FISHEYE: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}


def read_cameras(
    path: str | Path, *, width: int | None = None, height: int | None = None
) -> dict[str, Camera]:
    """Reads cameras that another program wrote.

    Args:
        path: ParaView's .pvcc; a .json of frames with `transform_matrix`; or a folder with COLMAP's
            cameras.txt and images.txt.
        width: Pixels of a .pvcc, which does not store them; other cameras are scaled to this size.
        height: As `width`; give both or none.

    Returns:
        Each camera, by the name of its picture, in the file's order; that of a .pvcc is "camera".

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The path is none of these, or damaged, or no model supports a lens's distortion.
    """
    check.instance("read_cameras", "path", path, str, PathLike)
    path = Path(path)
    if (width is None) != (height is None):
        raise ValueError("read_cameras: give both width and height, or neither")
    if not (path.is_file() or path.is_dir()):  # a pipe may never end
        raise FileNotFoundError(f"cameras not found: {path}")
    readers = {".pvcc": _read_pvcc, ".json": _read_transforms}
    if path.is_file() and path.suffix not in readers:
        wanted = "end in .pvcc or .json or be a folder of COLMAP"
        raise ValueError(f"read_cameras: path must {wanted}, got {path}")
    try:
        size = (width, height)
        cameras = _read_colmap(path) if path.is_dir() else readers[path.suffix](path, *size)
        if width is not None and height is not None:
            cameras = {name: _scaled(camera, width, height) for name, camera in cameras.items()}
    except (KeyError, IndexError, TypeError, ArithmeticError, xml.ParseError) as error:
        message = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: can't be read as cameras: {one_line(message)}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {one_line(error)}") from None
    if not cameras:
        raise ValueError(f"{path}: has no cameras")
    return cameras


def write_cameras(
    path: str | Path, cameras: Camera | Mapping[str, Camera], *, distance: float = 1.0
) -> None:
    """Writes cameras for another program: see `read_cameras`.

    Args:
        path: .pvcc (of one camera), .json, or a folder for COLMAP's cameras.txt, images.txt and an
            empty points3D.txt, which is made.
        cameras: A camera, or a batch, whose pictures are called 0000.png, 0001.png, ..., or cameras
            by the names of their pictures; in world units.
        distance: World units from the eye to a .pvcc's centre of rotation.

    Raises:
        ValueError: The ending is none of these, the file can't store a model, or a camera is
            relative to a box: call `placed(tree.box)` first.
        FileNotFoundError: The folder around it does not exist.
    """
    path, context = Path(path), "write_cameras"
    check.instance(context, "cameras", cameras, Camera, Mapping)
    if isinstance(cameras, Camera):
        cameras = {f"{n:04d}.png": cameras[n] for n in range(len(cameras))}
    for name, camera in cameras.items():
        check.instance(context, "cameras", camera, Camera)
        if camera.frame is Coordinates.BOX or len(camera) != 1 or camera.model not in MODELS:
            wanted = "one camera in the world, of a model"
            raise ValueError(f"{context}: {name!r} must be {wanted}, got {camera}")
        if not name or any(letter.isspace() for letter in name):
            raise ValueError(f"{context}: names must not contain blanks, got {name!r}")
    if not cameras:
        raise ValueError(f"{context}: there are no cameras")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{context}: folder not found: {path.parent}")
    if path.suffix == ".pvcc":
        eye_distance = check.number(context, "distance", distance, low=0, open_low=True)
        write_text(path, _pvcc_text(cameras, eye_distance))
    elif path.suffix == ".json":
        write_text(path, json.dumps(_transforms_content(cameras), indent=1) + "\n")
    elif path.suffix == "" and (path.is_dir() or not path.exists()):
        texts = _colmap_texts(cameras)
        path.mkdir(exist_ok=True)
        for name, text in texts.items():
            write_text(path / name, text)
    else:
        raise ValueError(f"{context}: path must end in .pvcc or .json or be a folder, got {path}")


def _scaled(camera: Camera, width: int, height: int) -> Camera:
    """Returns the camera with pictures of another size, which show the same."""
    Ks = camera.Ks[0].clone()
    Ks[0] *= width / camera.width
    Ks[1] *= height / camera.height
    coefficients = camera.radial_coeffs[0] if camera.distorted else None
    view, model = camera.viewmats[0], camera.model
    return Camera(view, Ks, width, height, model=model, radial_coeffs=coefficients)


# ParaView.


def _read_pvcc(path: Path, width: int | None, height: int | None) -> dict[str, Camera]:
    root = xml.fromstring(_read_text(path))
    properties: dict[str, list[float]] = {}
    for element in root.iter("Property"):
        values = [float(item.attrib["value"]) for item in element.iter("Element")]
        properties[element.attrib["name"]] = values
    eye, target, up = (properties[name][:3] for name in _PVCC_VECTORS[:3])
    if width is None or height is None:
        raise ValueError("does not give the size of the picture: give width and height")
    if not properties.get("CameraParallelProjection", [0])[0]:
        fov = properties["CameraViewAngle"][0]
        return {"camera": Camera.look_at(eye, target, up, fov, width, height)}
    camera = Camera.look_at(eye, target, up, 30.0, width, height, "ortho")
    camera.Ks[:, (0, 1), (0, 1)] = 0.5 * height / properties["CameraParallelScale"][0]
    return {"camera": camera}


def _pvcc_text(cameras: Mapping[str, Camera], distance: float) -> str:
    if len(cameras) != 1:
        raise ValueError(f"write_cameras: .pvcc holds one camera, got {len(cameras)}")
    (camera,) = cameras.values()
    centre = camera.Ks.new_tensor([camera.width / 2, camera.height / 2])
    square = bool(torch.isclose(camera.Ks[0, 0, 0], camera.Ks[0, 1, 1], rtol=1e-9))
    if camera.model not in ("pinhole", "ortho") or not square:
        raise ValueError(f"write_cameras: .pvcc holds pinhole or ortho, of square pixels: {camera}")
    if not torch.allclose(camera.Ks[0, :2, 2], centre, atol=1e-6):
        raise ValueError("write_cameras: .pvcc has its axis in the middle of the picture")
    to_world = torch.linalg.inv(camera.viewmats[0])
    eye, forward, up = to_world[:3, 3], to_world[:3, 2], -to_world[:3, 1]
    target, half_height = eye + distance * forward, 0.5 * camera.height / float(camera.Ks[0, 1, 1])
    is_ortho = camera.model == "ortho"
    angle = 30.0 if is_ortho else math.degrees(2 * math.atan(half_height))
    scale = half_height if is_ortho else half_height * distance
    property_values = (eye, target, up, target, [angle], [scale], [int(is_ortho)])
    root = xml.Element("PVCameraConfiguration", description="ParaView camera", version="1.0")
    proxy = xml.SubElement(root, "Proxy", group="views", type="RenderView", id="1", servers="21")
    for name, values in zip(_PVCC_VECTORS + _PVCC_NUMBERS, property_values, strict=True):
        attributes = {"name": name, "id": f"1.{name}", "number_of_elements": str(len(values))}
        element = xml.SubElement(proxy, "Property", attributes)
        numbers = values.tolist() if isinstance(values, Tensor) else values
        for index, value in enumerate(numbers):
            xml.SubElement(element, "Element", index=str(index), value=repr(value))
    xml.indent(root)
    return '<?xml version="1.0"?>\n' + xml.tostring(root, encoding="unicode") + "\n"


# Blender and NeRF.


def _read_transforms(path: Path, width: int | None, height: int | None) -> dict[str, Camera]:
    content = check.json_file("cameras", path)
    if not isinstance(content, dict):  # such as the keys of a flight
        raise ValueError("must be an object with frames")
    cameras = {}
    for number, frame in enumerate(content["frames"]):
        fields = {**content, **frame}
        pose = check.reals(f"frame {number}", "pose", fields["transform_matrix"], (4, 4)) @ _FLIP
        view = torch.eye(4, dtype=torch.float64, device="cpu")
        view[:3, :3], view[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        x, y = (fields.get(k) or size for k, size in (("w", width), ("h", height)))
        if not x or not y:
            raise ValueError("does not give the size of the pictures: give width and height")
        x, y = (_pixels(number, name, size) for name, size in (("w", x), ("h", y)))
        lens = {**fields, "fx": _focal_length(fields, "x", x), "fy": _focal_length(fields, "y", y)}
        if lens["fx"] is None:
            raise KeyError("camera_angle_x")
        name = str(fields.get("file_path", f"{number:04d}.png"))
        if name in cameras:
            raise ValueError(f"frame {number}: there is one of {name!r} already")
        is_fisheye = fields.get("is_fisheye")  # as instant-ngp says it
        model = _FISHEYE if is_fisheye else fields.get("camera_model", "PINHOLE")
        cameras[name] = _camera_of_lens(model, view, lens, (x, y))
    return cameras


def _pixels(number: int, name: str, size: Any) -> int:
    """Returns a side of a frame's picture, which some programs write as 800.0."""
    whole = int(size) if isinstance(size, float) and size.is_integer() else size
    return check.integer(f"frame {number}", name, whole, low=1)


def _focal_length(fields: Mapping[str, Any], axis: str, size: int) -> Any:
    """Returns pixels, from the length or the field of view of an axis; None if there is neither."""
    angle = fields.get(f"camera_angle_{axis}")
    return fields.get(f"fl_{axis}", angle and 0.5 * size / math.tan(angle / 2))


def _camera_of_lens(
    model: str, view: Tensor, lens: Mapping[str, Any], size: tuple[int, int]
) -> Camera:
    """Returns a camera of one of COLMAP's models, given its parameters; without fy pixels are
    square, without cx and cy the axis is in the middle.
    """
    _parameters_of(model)
    fx = lens["fx"]
    fy = fx if lens.get("fy") is None else lens["fy"]
    cx, cy = lens.get("cx", size[0] / 2), lens.get("cy", size[1] / 2)
    Ks = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64, device="cpu")
    distortion = {name: float(lens.get(name) or 0) for name in _DISTORTIONS}
    readable = _DISTORTIONS[:4] if model == _FISHEYE else ()
    if unread := [name for name, value in distortion.items() if value and name not in readable]:
        found = f"{model} is not read ({', '.join(unread)})"
        raise ValueError(f"distortion of model {found}: undistort first")
    if not any(distortion.values()):
        return Camera(view, Ks, *size, model="fisheye" if model == _FISHEYE else "pinhole")
    coefficients = [distortion[name] for name in readable]
    return Camera(view, Ks, *size, model="fisheye", radial_coeffs=coefficients)


def _parameters_of(model: str) -> tuple[str, ...]:
    if model not in _COLMAP_PARAMETERS:
        known = ", ".join(_COLMAP_PARAMETERS)
        raise ValueError(f"camera model {model} is not read; known: {known}")
    return _COLMAP_PARAMETERS[model]


def _transforms_content(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    frames = []
    for name, camera in cameras.items():
        model, parameters = _lens_of(camera)
        names = {"fx": "fl_x", "fy": "fl_y"}
        frames.append(
            {
                "file_path": name,
                "camera_model": model,
                **{"w": camera.width, "h": camera.height},
                **{names.get(key, key): value for key, value in parameters.items()},
                "transform_matrix": (torch.linalg.inv(camera.viewmats[0]) @ _FLIP).tolist(),
            }
        )
    return {"frames": frames}


def _lens_of(camera: Camera) -> tuple[str, dict[str, float]]:
    """Returns COLMAP's model and parameters of a camera."""
    (fx, _, cx), (_, fy, cy), _ = camera.Ks[0].tolist()
    parameters = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    if camera.model == "pinhole":
        return "PINHOLE", parameters
    if camera.model == "fisheye":
        coefficients = camera.radial_coeffs[0].tolist()
        return _FISHEYE, parameters | dict(zip(("k1", "k2", "k3", "k4"), coefficients, strict=True))
    raise ValueError(f"write_cameras: only pinhole and fisheye can be written, got {camera.model}")


# COLMAP.


def _read_colmap(path: Path) -> dict[str, Camera]:
    lenses: dict[str, tuple[str, dict[str, float], tuple[int, int]]] = {}
    for line in _read_lines(path / "cameras.txt"):
        number, model, x, y, *values = line.split()
        lens = dict(zip(_parameters_of(model), map(float, values), strict=True))
        lenses[number] = (model, lens, (int(x), int(y)))
    cameras = {}
    for line in _read_lines(path / "images.txt", points=True):
        _, *numbers, number, name = line.split(maxsplit=9)
        if name in cameras:
            raise ValueError(f"there are two images {name!r}")
        pose = check.reals(f"image {name}", "pose", [float(n) for n in numbers], (7,))
        view = torch.eye(4, dtype=torch.float64, device="cpu")
        view[:3, :3], view[:3, 3] = rotation_of(pose[:4].tolist()), pose[4:]
        model, lens, size = lenses[number]
        cameras[name] = _camera_of_lens(model, view, lens, size)
    return cameras


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError("is not a text file") from None


def _read_lines(path: Path, *, points: bool = False) -> list[str]:
    """Returns the lines of a text without comments and empty ones. In images.txt each of them is
    followed by a line with the image's `points`, which may be empty and is left out.
    """
    if not path.is_file():
        raise ValueError(f"has no {path.name}")
    kept, lines = [], iter(_read_text(path).splitlines())
    for line in lines:
        if line.startswith("#") or not line.strip():
            continue
        kept.append(line)
        numbers = next(lines, "").split() if points else []  # x, y, and the number of a point
        if len(numbers) % 3 or (numbers and not numbers[-1].lstrip("-").isdigit()):
            raise ValueError(f"{path.name}: after the line of an image comes one of its points")
    return kept


def _colmap_texts(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lenses: dict[str, int] = {}
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points"]
    for number, (name, camera) in enumerate(cameras.items(), 1):
        model, parameters = _lens_of(camera)
        size = (model, str(camera.width), str(camera.height))
        lens = " ".join((*size, *(repr(value) for value in parameters.values())))
        lens_id = lenses.setdefault(lens, len(lenses) + 1)
        pose = [*quaternion_of(camera.viewmats[0, :3, :3]), *camera.viewmats[0, :3, 3].tolist()]
        images += [f"{number} {' '.join(map(repr, pose))} {lens_id} {name}", ""]
    lens_lines = [f"{lens_id} {lens}" for lens, lens_id in lenses.items()]
    head = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS"
    return {
        "cameras.txt": "\n".join((head, *lens_lines)) + "\n",
        "images.txt": "\n".join(images) + "\n",
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK\n",
    }
