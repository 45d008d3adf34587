"""A frame drawn by OpenGL and gvtorch: OpenGL draws a ball, voxels join it, and OpenGL adds the
edges of the box, which voxels and ball hide.

On an NVIDIA GPU (`--device cuda`) no picture passes through the host.
"""

import dataclasses
import itertools
import math
import sys
from pathlib import Path

import torch
import tyro
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

import gvtorch as gv

try:
    import moderngl
except ImportError as error:
    sys.exit(f"opengl_frame needs moderngl: pip install moderngl ({error})")

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (-260.0, -340.0, 190.0), (63.5, 63.5, 127.5), (0.0, 0.0, 1.0)
BACKGROUND = (0.15, 0.15, 0.18)  # as the framebuffer stores it
BALL, RADIUS, GREEN = (95.0, 50.0, 110.0), 32.0, (0.35, 0.9, 0.6)
SUN, GOLD = (-0.5, -0.7, 0.5), (0.95, 0.8, 0.3)
VERTEX = """#version 330
uniform mat4 camera;
in vec3 place, color;
out vec3 tint;
void main() { tint = color; gl_Position = camera * vec4(place, 1); }
"""
FRAGMENT = """#version 330
in vec3 tint;
out vec4 result;
void main() { result = vec4(tint, 1); }
"""


def ball(sides: int = 96) -> Tensor:
    """(k, 6) place and colour of triangle corners."""
    v, u = torch.linspace(0, math.pi, sides + 1), torch.linspace(0, 2 * math.pi, 2 * sides + 1)
    v, u = torch.meshgrid(v, u, indexing="ij")
    normals = torch.stack((v.sin() * u.cos(), v.sin() * u.sin(), v.cos()), -1)
    a, b, c, d = normals[:-1, :-1], normals[1:, :-1], normals[1:, 1:], normals[:-1, 1:]
    normals = torch.stack((a, b, c, a, c, d), 2).reshape(-1, 3)
    light = 0.45 + 0.55 * (normals @ torch.tensor(SUN)).clamp(min=0)
    return torch.cat(
        (torch.tensor(BALL) + RADIUS * normals, light[:, None] * torch.tensor(GREEN)), 1
    )


def edges(box: Tensor) -> Tensor:
    """(24, 6) place and colour of the ends of the 12 edges of a (2, 3) box."""
    corners = torch.tensor(list(itertools.product((0, 1), repeat=3)))
    pairs = [(i, j) for i, j in itertools.combinations(range(8), 2) if (i ^ j) in (1, 2, 4)]
    ends = corners[torch.tensor(pairs).flatten()]
    places = box[ends, torch.arange(3)].float()
    return torch.cat((places, torch.tensor(GOLD).expand_as(places)), 1)


@dataclasses.dataclass
class Settings:
    """Renders the bundled stent between what OpenGL draws."""

    output: Path = Path("opengl_frame.png")
    size: int = 512
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Draws with OpenGL, with voxels, and with OpenGL again."""
    size, device = settings.size, settings.device
    camera = gv.Camera.look_at(EYE, TARGET, UP, fov=36, width=size, height=size)
    projection, modelview = gv.opengl.matrices(camera, near=200, far=1000)
    volume = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    tree = gv.N3Tree.from_volume(volume, device=device)
    shader = gv.TransferFunction.from_json(DATA / "stent.json")
    try:
        context = moderngl.create_context(standalone=True, backend="egl")
    except Exception as error:
        sys.exit(f"opengl_frame needs OpenGL: a GPU's driver with EGL, or Mesa's ({error})")
    frame = context.simple_framebuffer((size, size))
    program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
    program["camera"].write((projection @ modelview).mT.float().contiguous().numpy())

    def draw(corners: Tensor, mode: int) -> None:
        buffer = context.buffer(corners.contiguous().numpy())
        context.vertex_array(program, [(buffer, "3f 3f", "place", "color")]).render(mode)

    frame.use()
    frame.clear(*BACKGROUND, 1.0)
    context.enable_only(moderngl.DEPTH_TEST)
    draw(ball(), moderngl.TRIANGLES)
    with gv.opengl.Exchange(size, size, device) as exchange:
        stored, depth = exchange.read_color()[..., :3], exchange.read_depth()
        drawn = rgb_to_linear_rgb(stored.movedim(-1, 0)).movedim(0, -1)
        layer = gv.Layer(drawn, gv.opengl.ray_distance(depth, projection))
        background = gv.Backdrop(drawn)  # OpenGL's, also where it drew nothing
        picture = gv.render(tree, camera, shader, layer=layer, background=background)
        mixed = linear_rgb_to_rgb(picture.color.movedim(-1, 0)).movedim(0, -1)
        exchange.draw(mixed, gv.opengl.window_depth(picture.nearest, projection))
        draw(edges(tree.box), moderngl.LINES)
        whole = rgb_to_linear_rgb(exchange.read_color()[..., :3].movedim(-1, 0)).movedim(0, -1)
    dataclasses.replace(picture, color=whole).save(settings.output)
    print(f"{settings.output}: {exchange}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
