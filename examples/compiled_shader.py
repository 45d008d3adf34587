"""A shader of one's own in C++, examples/ink.h: a CT scan by a transfer function, and by pen and
ink. It is compiled when it is used first; its numbers may change with each frame.
"""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

HERE = Path(__file__).parent
EYE, TARGET, UP = (-230.0, -330.0, 170.0), (63.5, 63.5, 127.5), (0.0, 0.0, 1.0)
PAPER = 0.85
INK = gv.TransferFunction.from_points(  # vessels and bones in one dark colour
    opacity=[(150, 0), (260, 0.3), (600, 0.9)],
    color=[(150, 0.2, 0.08, 0.05), (600, 0.05, 0.06, 0.1)],
)


@dataclass
class Settings:
    """Renders the bundled stent twice."""

    output: Path = Path("compiled_shader.png")
    size: int = 400
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Compiles, renders, and changes a number."""
    volume = gv.read_volume(HERE / "data" / "stent_256x128x128_int16.npz")
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    camera = gv.Camera.look_at(EYE, TARGET, UP, fov=28, width=settings.size, height=settings.size)
    start = time.perf_counter()
    numbers = {"sharpness": 2.0, "thinness": 0.02, "near": 300.0, "far": 560.0, "paper": PAPER}
    ink = gv.CompiledShader(HERE / "ink.h", "Ink", uniforms=numbers, transfer=INK)
    print(f"{ink.kind} is there after {time.perf_counter() - start:.2f} s")
    paper = {"background": (PAPER,) * 3, "lod": "finest"}
    plain = gv.render(tree, camera, INK, **paper)
    pictures = [plain, gv.render(tree, camera, ink, **paper)]
    ink.uniforms["thinness"] = 0.3  # nothing is compiled for it
    pictures.append(gv.render(tree, camera, ink, **paper))
    for picture in pictures:
        print(f"{picture.stats.milliseconds:.0f} ms, {picture.stats.samples} samples")
    color = torch.cat([picture.color for picture in pictures], dim=1)
    dataclasses.replace(plain, color=color).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
