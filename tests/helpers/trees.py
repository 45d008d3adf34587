"""Trees as tests need them: fresh copies, trees with holes, volumes of several channels."""

from __future__ import annotations

import torch

import gvtorch as gv
from gvtorch.base import constants as config


def on(tree: gv.N3Tree, device: str) -> gv.N3Tree:
    """A copy of the tree whose marks are clean, on a device."""
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
    for name, voxels in tree.bricks.bricks.items():  # some channels are those of the first bricks
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


def share(tree: gv.N3Tree, seed: int) -> gv.N3Tree:
    """A copy in which a quarter of the nodes that have children have those of others, from any
    depth; of some of these the tiles know no parent.
    """
    copy = on(tree, "cpu")
    nodes, generator = copy.nodes, torch.Generator().manual_seed(seed)
    child = nodes.child_tn.view(-1)
    owner = (child >= 0).nonzero()[1:, 0]  # the root keeps its own
    owner = owner[torch.randperm(len(owner), generator=generator)]
    some, others, *_ = owner.tensor_split(4)
    child[some[: len(others)]] = child[others]
    shared = child[others].long()
    nodes.parent_t[shared[::3]] = -1
    nodes.shared_t[shared] = nodes.shared_t[tree.number] = True
    return copy


def forget(tree: gv.N3Tree, share: float, seed: int) -> gv.N3Tree:
    """A copy in which a share of the bricks and of the tiles is not there yet."""
    copy = on(tree, "cpu")
    generator = torch.Generator().manual_seed(seed)
    for words, absent in (
        (copy.nodes.brick_tn, config.ABSENT),
        (copy.nodes.child_tn, config.ABSENT),
    ):
        gone = (torch.rand(words.shape, generator=generator) < share) & (words >= 0)
        words[gone] = absent
    return copy
