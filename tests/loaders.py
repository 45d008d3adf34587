"""A data set of pictures for DataLoaders, in a module that spawned workers import in no time: it
needs neither pytest nor the helpers.
"""

from __future__ import annotations

import copy
import os

import torch

import gvtorch as gv


class Pictures(torch.utils.data.Dataset):
    """Pictures of a store, whose producer is made by the worker (`inside`) or before."""

    def __init__(self, path: str, inside: bool):
        self.path = path
        self.producer = None if inside else gv.StoredProducer(path)

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> torch.Tensor:
        producer = copy.deepcopy(self.producer) or gv.StoredProducer(self.path)
        pools = {"brick_pool": "1 MB", "node_pool": "1 MB"}
        with gv.Engine(producer, **pools, device="cpu") as engine:
            view = gv.Camera.orbit(40 * index, width=8, height=8)
            return engine.render(view, gv.TransferFunction.preset("gray", 0, 255)).color


def by_workers() -> dict[str, float | str]:
    """Returns the light of the pictures of the environment's STORE, or the error, by how workers
    are started and where they get their producer from.
    """
    results: dict[str, float | str] = {}
    for method, where in (("fork", "inside"), ("fork", "outside"), ("spawn", "outside")):
        loader = torch.utils.data.DataLoader(
            Pictures(os.environ["STORE"], where == "inside"),
            num_workers=1,
            timeout=300,
            multiprocessing_context=method,
        )
        try:
            results[f"{method} {where}"] = sum(float(one.sum()) for one in loader)
        except Exception as error:
            results[f"{method} {where}"] = " ".join(str(error).split())[-400:]
    return results
