"""Boxes of a tree's nodes, to be drawn over the picture: those whose bricks the last frame read."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..pool import N3Tree

MOST = 1500  # boxes that a page is told


def node_boxes(tree: N3Tree, eye: tuple[float, float, float], most: int = MOST) -> dict[str, Any]:
    """Returns the nodes whose bricks the last frame read, those nearest to an eye first.

    Returns:
        boxes: At most so many [x, y, z, depth], see `N3Tree.loc`.
        count: How many there are.
        low, size: World corner and sides of the root.
        branching: N.
    """
    nodes, bricks = tree.nodes, tree.bricks
    own = (nodes.tree_t == tree.number)[:, None] & (nodes.brick_tn >= 0)
    tile, child = own.nonzero().unbind(1)
    brick = nodes.brick_tn[tile, child].to(torch.int64)
    read = bricks.stamp_b[brick] == tree.frame
    loc = tree.loc(tile[read] * nodes.nodes_per_tile + child[read])
    low, size, _ = tree.place.unbind(0)
    nearest = _distance(loc, low, size, torch.tensor(eye, dtype=torch.float64), tree.branching)
    first = nearest.argsort(stable=True)[:most]
    return {
        "boxes": loc[first].tolist(),
        "count": len(loc),
        "low": low.tolist(),
        "size": size.tolist(),
        "branching": tree.branching,
    }


def _distance(loc: Tensor, low: Tensor, size: Tensor, eye: Tensor, branching: int) -> Tensor:
    """(k,) world distance of nodes' centres from an eye."""
    share = float(branching) ** -loc[:, 3:].to(torch.float64)
    centre = low + (loc[:, :3] + 0.5) * share * size
    return (centre - eye.to(centre)).norm(dim=1)
