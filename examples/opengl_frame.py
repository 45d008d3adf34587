"""A frame drawn by OpenGL and gvtorch: OpenGL draws a ball, voxels join it, and OpenGL adds the
edges of the box, partly hidden by both. On an NVIDIA GPU no picture passes through the host.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
import tyro
from torch import Tensor
from torch.nn.functional import avg_pool2d

import gvtorch as gv

try:
    import moderngl
except ImportError as error:
    sys.exit(f"opengl_frame needs moderngl: pip install moderngl ({error})")

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
EYE, TARGET, UP = (-170.0, -290.0, 30.0), (62.0, 62.0, 128.0), (1.0, 0.3, 0.0)  # the body lies
BALL, RADIUS, TEAL, SIDES = (82.0, 46.0, 130.0), 30.0, (0.05, 0.55, 0.4), 192
SUN, GOLD, NIGHT = torch.tensor([(0.6, -0.7, -0.3), (0.9, 0.5, 0.1), (0.01, 0.013, 0.022)])
EDGES = torch.tensor([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
VERTEX = """#version 330
uniform mat4 camera; in vec3 position, color; out vec3 tint;
void main() { tint = color; gl_Position = camera * vec4(position, 1); }"""
FRAGMENT = """#version 330
in vec3 tint; out vec4 result;
void main() { result = vec4(tint, 1); }"""


def ball() -> Tensor:
    """Returns (k, 6): position and colour of a triangle strip that winds from pole to pole."""
    turns = (torch.arange(-SIDES, SIDES**2 + 1)[:, None] / SIDES + torch.arange(2)).flatten()
    u, v = 2 * torch.pi * turns, torch.pi * (turns / SIDES).clamp(0, 1)
    normals = torch.stack((v.sin() * u.cos(), v.sin() * u.sin(), v.cos()), 1)
    light = 0.25 + 0.75 * (normals @ SUN).clamp(min=0)[:, None]
    return torch.cat((torch.tensor(BALL) + RADIUS * normals, light * torch.tensor(TEAL)), 1)


def main(output: Path = Path("opengl_frame.png"), size: int = 720, device: str = "cpu") -> None:
    """Draws with OpenGL, with voxels, and with OpenGL again, at twice the saved resolution."""
    width, height = size * 16 // 9 * 2, size * 2
    camera = gv.Camera.look_at(EYE, TARGET, UP, 28, width, height)
    projection, modelview = gv.opengl.matrices(camera, near=100, far=1000)
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=device)
    shader = gv.Lit(gv.TransferFunction.from_json(SCAN.with_name("stent.json")), ambient=0.3)
    try:
        context = moderngl.create_context(standalone=True, backend="egl")
    except Exception as error:
        sys.exit(f"opengl_frame needs OpenGL: a GPU's driver with EGL, or Mesa's ({error})")
    frame = context.simple_framebuffer((width, height), dtype="f4")  # linear light
    program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
    program["camera"].write((projection @ modelview).mT.float().contiguous().numpy())

    def draw(corners: Tensor, mode: int) -> None:
        buffer = context.buffer(corners.contiguous().numpy())
        context.vertex_array(program, [(buffer, "3f 3f", "position", "color")]).render(mode)

    frame.use()
    frame.clear(*NIGHT, 1.0)
    context.enable_only(moderngl.DEPTH_TEST)
    context.line_width = 3.0
    draw(ball(), moderngl.TRIANGLE_STRIP)
    with gv.opengl.Exchange(width, height, device) as exchange:
        drawn_color, depth = exchange.read_color()[..., :3], exchange.read_depth()
        layer = gv.Layer(drawn_color, gv.opengl.ray_distance(depth, projection))
        picture = gv.render(tree, camera, shader, layer=layer, background=drawn_color)
        exchange.draw(picture.color, gv.opengl.window_depth(picture.nearest, projection))
        points = tree.box[EDGES.flatten()[:, None] >> torch.arange(3) & 1, torch.arange(3)].float()
        draw(torch.cat((points, GOLD.expand_as(points)), 1), moderngl.LINES)
        color = exchange.read_color()[..., :3].movedim(-1, 0)
    replace(picture, color=avg_pool2d(color, 2).movedim(0, -1)).save(output)
    print(f"{output}: {exchange}")


if __name__ == "__main__":
    tyro.cli(main)
