"""Your own shader in C++, examples/ink.h: vessels by a transfer function, in pen and ink, and with
other uniforms. It is compiled once; uniforms may change with every frame.
"""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

HERE = Path(__file__).parent
PAPER = 0.9
INK = gv.TransferFunction.from_points(
    opacity=[(25, 0), (60, 0.9), (255, 1)], color=[(0, 0.02, 0.015, 0.02)]
)


@dataclass
class Settings:
    """Renders the bundled aneurism three times."""

    output: Path = Path("compiled_shader.png")
    size: int = 320
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Compiles, renders, changes uniforms, renders again."""
    volume = gv.read_volume(HERE / "data" / "aneurism_256x256x256_uint8.raw.gz")
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    camera = gv.Camera.orbit(40, 15, 1.45, fov=30, width=settings.size, height=settings.size)
    plain = gv.TransferFunction.preset("vessels", *volume.value_range)
    numbers = {"steep": 20, "sharpness": 2, "wash": 0, "near": 300, "far": 540, "paper": PAPER}
    start = time.perf_counter()
    ink = gv.CompiledShader(HERE / "ink.h", "Ink", uniforms=numbers, transfer=INK)
    print(f"{ink.name} is there after {time.perf_counter() - start:.2f} s")
    paper = {"background": (PAPER,) * 3, "lod": "finest"}
    pictures = [gv.render(tree, camera, shader, **paper) for shader in (plain, ink)]
    ink.uniforms.update(sharpness=6, wash=0.02, far=1000)
    pictures.append(gv.render(tree, camera, ink, **paper))
    for picture in pictures:
        print(f"{picture.stats.milliseconds:.0f} ms, {picture.stats.samples} samples")
    color = torch.cat([picture.color for picture in pictures], dim=1)
    dataclasses.replace(pictures[0], color=color).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
