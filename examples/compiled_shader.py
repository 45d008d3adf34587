"""Your own shader in C++, ink.h: vessels in pen and ink; at the right, a transfer function and the
ink with other uniforms. It is compiled once; uniforms may change with every frame.
"""

import dataclasses
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

HERE = Path(__file__).parent
PAPER = (0.9, 0.9, 0.9)
INK = gv.TransferFunction.from_points(
    opacity=[(25, 0), (60, 0.9), (255, 1)], color=[(0, 0.02, 0.015, 0.02)]
)


@dataclass
class Settings:
    """Renders the bundled aneurism three times."""

    output: Path = Path("compiled_shader.png")
    size: int = 720
    samples: int = 3
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Compiles, renders, changes uniforms, renders again."""
    volume = gv.read_volume(HERE / "data" / "aneurism_256x256x256_uint8.raw.gz")
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    plain = gv.TransferFunction.preset("vessels", *volume.value_range)
    uniforms = {"steep": 20, "sharpness": 2, "wash": 0, "near": 200, "far": 520, "paper": PAPER[0]}
    start = time.perf_counter()
    ink = gv.CompiledShader(HERE / "ink.h", "Ink", uniforms=uniforms, transfer=INK)
    print(f"{ink.name} is there after {time.perf_counter() - start:.2f} s")

    def draw(shader: gv.Shader, fov: float, width: int, height: int) -> gv.Picture:
        camera = gv.Camera.orbit(40, 15, 1.3, fov, width, height)
        render = partial(gv.render, tree, shader=shader, background=PAPER, lod="finest")
        picture = gv.Progressive(render).refine(camera, settings.samples)
        print(f"{picture.stats.milliseconds:.0f} ms, {picture.stats.samples} samples")
        return picture

    full_height, half_height = settings.size, settings.size // 2
    third_width = -(-settings.size * 16 // 27)  # a third of 16:9
    left = draw(ink, 27, 2 * third_width, full_height)
    ink.uniforms.update(sharpness=6, wash=0.02, far=1000)
    right = [draw(shader, 30, third_width, half_height).color for shader in (plain, ink)]
    color = torch.cat([left.color, torch.cat(right)], dim=1)
    dataclasses.replace(left, color=color).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
