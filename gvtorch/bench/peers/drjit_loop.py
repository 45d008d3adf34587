"""A marcher in Dr.Jit on its LLVM backend: one symbolic loop over all rays, a 3D texture."""

from __future__ import annotations

import drjit as dr
import torch
from drjit import llvm
from torch import Tensor

from .peer import Peer, Task, bake, spans

_ROWS = 255 * 16 + 1
_LLVM = dr.has_backend(dr.JitBackend.LLVM) and ".".join(map(str, dr.detail.llvm_version()))


class Marcher(Peer):
    """Dr.Jit's vectorised kernel, on all threads."""

    differences = (
        f"compiled by LLVM {_LLVM} (newer ones make it faster: DRJIT_LIBLLVM_PATH); float32 voxels "
        "in a texture, no empty space is skipped; opacity from the nearest of 4081 table rows, "
        "scaled linearly in a ray's last, shorter interval"
    )

    @classmethod
    def why_unavailable(cls, device: torch.device) -> str:
        """Returns why it can't run: it needs LLVM, and is compared on the CPU only."""
        if device.type != "cpu":
            return "compared on the CPU only"
        if not _LLVM:
            return "no LLVM library was found (DRJIT_LIBLLVM_PATH names one)"
        return ""

    def __init__(self, task: Task) -> None:
        """Copies voxels, rays and table to Dr.Jit's arrays."""
        dr.set_thread_count(torch.get_num_threads())
        voxels = task.scene.volume.data.float().numpy()
        wrap, linear = dr.WrapMode.Clamp, dr.FilterMode.Linear
        tensor = llvm.TensorXf(voxels)
        self.texture = llvm.Texture3f(tensor, filter_mode=linear, wrap_mode=wrap)
        sizes = torch.tensor(task.scene.volume.extent, dtype=torch.float64, device="cpu")
        origin, direction = (task.rays.origin + 0.5) / sizes, task.rays.direction / sizes
        self.origin, self.direction = (
            llvm.Array3f(*(llvm.Float(ray[:, axis].float().numpy()) for axis in range(3)))
            for ray in (origin, direction)
        )
        limits = spans(task).float()
        self.first, self.last = (llvm.Float(limits[:, end].numpy()) for end in (0, 1))
        table = bake(task.scene.shader, task.scene.step, _ROWS)
        table[:, :3] *= table[:, 3:]
        self.table = llvm.Float(torch.from_numpy(table).float().flatten().numpy())
        self.step, self.stop_alpha = task.scene.step, task.stop_alpha
        self.color, self.transmittance = llvm.Array3f(0), llvm.Float(1)
        dr.eval(self.origin, self.direction, self.first, self.last, self.table)
        dr.sync_thread()

    def render(self) -> None:
        scale, step = (_ROWS - 1) / 255, self.step

        def is_active(t: llvm.Float, transmittance: llvm.Float, color: llvm.Array3f) -> llvm.Bool:
            return (t < self.last) & (transmittance > 1 - self.stop_alpha)

        def march(
            t: llvm.Float, transmittance: llvm.Float, color: llvm.Array3f
        ) -> tuple[llvm.Float, llvm.Float, llvm.Array3f]:
            length = dr.select(t + step < self.last, llvm.Float(step), self.last - t)
            position = dr.fma(self.direction, t + 0.5 * length, self.origin)
            value = self.texture.eval(position)[0]
            row = dr.gather(llvm.Array4f, self.table, llvm.UInt32(dr.fma(value, scale, 0.5)))
            fraction = length * (1 / step)
            color = dr.fma(row.xyz, transmittance * fraction, color)
            return t + step, transmittance * (1 - fraction * row.w), color

        start = (self.first, llvm.Float(1), dr.zeros(llvm.Array3f, dr.width(self.first)))
        _, self.transmittance, self.color = dr.while_loop(start, is_active, march)
        dr.eval(self.transmittance, self.color)
        dr.sync_thread()

    def picture(self) -> Tensor:
        planes = [torch.from_numpy(self.color[axis].numpy().copy()) for axis in range(3)]
        return torch.stack([*planes, 1 - torch.from_numpy(self.transmittance.numpy().copy())], 1)
