"""`OctaveProducer`: sums of octaves of noise, to which each level adds its finest octaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..base import check
from ..base.constants import DEEP_VOXELS
from ..fields.noise import OctaveSum, SplineSum
from ..pool import Channel
from .producer import Nodes, Producer, by_depth


class OctaveProducer(Producer):
    """Makes bricks of a `gv.noise.SplineSum` or `gv.noise.OctaveSum`, or of a function of it.

    A level holds the sum of the octaves that its voxels can represent. If the voxels hold a
    function of the sum that can't be inverted, a second channel, "inherited", holds the sum, which
    the children continue. Cells begin at the low corner of the box.

    Attributes:
        total: The sum.
        values: Function from the sum to voxels; None: voxels hold the sum.
    """

    needs_parent = on_device = True

    def __init__(
        self,
        total: OctaveSum | SplineSum,
        extent: int | Sequence[int],
        *,
        box: Sequence[Sequence[float]] | None = None,
        values: Callable[[Tensor, Nodes], Tensor] | None = None,
        branching: int = 2,
        value_range: tuple[float, float] | None = None,
    ) -> None:
        """Sets the sum and the grid of voxels.

        Args:
            total: The sum; a `SplineSum` needs cells that are 2^n voxels wide.
            extent: Voxels of the finest level, one number or (x, y, z).
            box: World corners ((x, y, z), (x, y, z)); voxels must be cubes.
            values: A function of the sum (k, z, y, x) in some nodes, and of these `Nodes`, that
                returns the same shape, such as a density. On CUDA it must not make the host wait.
            branching: N; 2 for a `SplineSum`, whose levels halve their voxels.
            value_range: Smallest and largest value, if they are known.

        Raises:
            ValueError: Voxels are not cubes, N is not 2 for a `SplineSum`, or see `Producer`.
        """
        context = type(self).__name__
        if not isinstance(total, (OctaveSum, SplineSum)):
            kind = type(total).__name__
            raise ValueError(f"{context}: total must be a SplineSum or an OctaveSum, got {kind}")
        if values is not None and not callable(values):
            raise ValueError(f"{context}: values must be a function, got {type(values).__name__}")
        if isinstance(total, SplineSum):
            check.branching_two(context, branching, "a SplineSum")
        self._names = ["value"]
        if isinstance(total, OctaveSum) or values is not None:
            self._names.append("inherited")
        super().__init__(
            extent,
            channels={name: Channel() for name in self._names},
            box=box,
            branching=branching,
            value_range=None if value_range is None else {"value": value_range},
        )
        if max(self.spacing) > min(self.spacing) * (1 + 1e-9):
            raise ValueError(f"{context}: voxels must be cubes, got sides {self.spacing}")
        self.total, self.values = total, values

    def fill(self, nodes: Nodes) -> dict[str, Tensor]:
        """Adds the finest octaves, level by level. On the CPU each level's nodes are computed;
        elsewhere all nodes at every level, because counting those of a level would block.
        """
        on_cpu = nodes.loc.device.type == "cpu" and not torch.compiler.is_compiling()
        return self._by_level(nodes) if on_cpu else self._at_every_level(nodes)

    def _by_level(self, nodes: Nodes) -> dict[str, Tensor]:
        shape, device = (len(nodes), *(nodes.layout.side,) * 3), nodes.loc.device
        bricks = {n: torch.empty(shape, dtype=torch.float32, device=device) for n in self._names}
        for depth, rows in by_depth(nodes.loc):
            sums = self._sums(nodes[rows], depth)
            for name, values in zip(self._names, sums, strict=False):
                bricks[name][rows] = values
        return bricks

    def _at_every_level(self, nodes: Nodes) -> dict[str, Tensor]:
        shape, device = (len(nodes), *(nodes.layout.side,) * 3), nodes.loc.device
        bricks = {n: torch.zeros(shape, dtype=torch.float32, device=device) for n in self._names}
        for depth in range(nodes.layout.depth + 1):
            at_depth = (nodes.depth == depth)[:, None, None, None]
            without_parents = Nodes(nodes.loc, nodes.layout)  # a root has no parent
            sums = self._sums(nodes if depth else without_parents, depth)
            for name, values in zip(self._names, sums, strict=False):
                bricks[name] = torch.where(at_depth, values, bricks[name]).to(torch.float32)
        return bricks

    def _sums(self, nodes: Nodes, depth: int) -> tuple[Tensor, Tensor]:
        """Returns the values of nodes of one level, and what children inherit, (k, z, y, x)."""
        layout = nodes.layout
        side = self.spacing[0] * float(layout.branching) ** (layout.depth - depth)
        offsets = layout.reach.to(nodes.loc.device)
        coordinates = (nodes.loc[:, :3, None] * layout.brick_size + offsets + 0.5) * side
        parents = None if nodes.parents is None else nodes.parents[self._names[-1]][..., 0]
        if isinstance(self.total, OctaveSum):
            deep = max(self.extent) > DEEP_VOXELS
            coordinates = coordinates.to(torch.float64 if deep else torch.float32)
            parents = None if parents is None else parents.to(coordinates.dtype)
        axes = coordinates.unbind(1)
        options = {"border": layout.border, "branching": layout.branching}
        values, inherited = self.total.bricks(axes, side, parents, nodes.child, **options)
        if self.values is None:
            return values, inherited
        result = self.values(values, nodes)
        if not isinstance(result, Tensor) or result.shape != values.shape:
            shape, got = tuple(values.shape), check.describe(result)
            raise ValueError(f"{type(self).__name__}: values must return {shape}, got {got}")
        return result, inherited
