"""Copies of trees: on a device with cleared marks, and with holes."""

from __future__ import annotations

import torch

import gvtorch as gv
from gvtorch.base import constants as config


def copy_to(tree: gv.N3Tree, device: str) -> gv.N3Tree:
    """Returns a copy of the tree on a device, with requests and usage stamps cleared."""
    nodes = gv.NodePool(
        tree.nodes.capacity, tree.bricks.channels, branching=tree.branching, device=device
    )
    bricks = gv.BrickPool(
        tree.bricks.capacity,
        tree.bricks.channels,
        brick_size=tree.bricks.brick_size,
        border=tree.bricks.border,
        device=device,
    )
    for name, voxels in tree.bricks.bricks.items():  # coarse channels have fewer slots
        bricks.bricks[name] = torch.empty_like(voxels, device=device)
    half = 0.5 * torch.tensor(tree.spacing, dtype=torch.float64)
    origin = tuple((tree.box[0] + half).tolist())
    copy = gv.N3Tree(
        *(nodes, bricks), depth=tree.depth, extent=tree.extent, spacing=tree.spacing, origin=origin
    )
    copy.labels = tree.labels
    for old, new in ((tree.nodes.fields, nodes.fields), (tree.bricks.fields, bricks.fields)):
        for name, field in new.items():
            field.copy_(old[name])
    nodes.request_tn.zero_()
    nodes.stamp_t.fill_(-1)
    bricks.stamp_b.fill_(-1)
    return copy


def with_holes(tree: gv.N3Tree, share: float, seed: int) -> gv.N3Tree:
    """Returns a copy in which a share of the bricks and of the tiles is absent."""
    copy = copy_to(tree, "cpu")
    generator = torch.Generator().manual_seed(seed)
    for pointers, absent in (
        (copy.nodes.brick_tn, config.ABSENT),
        (copy.nodes.child_tn, config.ABSENT),
    ):
        removed = (torch.rand(pointers.shape, generator=generator) < share) & (pointers >= 0)
        pointers[removed] = absent
    return copy
