"""`JoinedProducer`: joins the channels of several producers of the same grid; `StoredChannels`
does so for a store of several channels.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..io.stores.channels import channel_names
from ..io.stores.store import Store
from .nodes import grid_of
from .producer import Bricks, Nodes, OfProducers, Producer, Region, Regions, arrived
from .stored import StoredProducer


class JoinedProducer(OfProducers):
    """Asks several producers for the same nodes; each makes one of the channels.

    A node is EMPTY if it is for all producers, and CONSTANT if none has voxels for it. Answers with
    aliases are rejected.

    Attributes:
        producers: By the name of the channel that each makes.
    """

    def __init__(self, producers: Mapping[str, Producer]) -> None:
        """Joins producers of one channel each.

        Args:
            producers: By the name that the channel of each gets.

        Raises:
            ValueError: One has several channels or needs its parents' bricks, or extent, spacing,
                origin or branching differ.
        """
        where = type(self).__name__
        if not isinstance(producers, Mapping):
            got = type(producers).__name__
            raise ValueError(f"{where}: producers must be producers by name, got a {got}")
        if not producers:
            raise ValueError(f"{where}: producers must hold at least one")
        channels, ranges, labels = dict[str, Any](), dict[str, Any](), dict[str, Any]()
        for name, one in producers.items():
            check.instance(where, f"producers[{name!r}]", one, Producer)
            if len(one.channels) != 1:
                known = ", ".join(one.channels)
                raise ValueError(
                    f"{where}: each producer must have one channel, {name!r} has {known}"
                )
            if one.needs_parent:
                raise ValueError(f"{where}: {name!r} needs its parents' bricks")
            ((own, channel),) = one.channels.items()
            channels[name] = channel
            ranges |= {name: one.value_range[own]} if own in one.value_range else {}
            labels |= {name: one.labels[own]} if own in one.labels else {}
        first = next(iter(producers.values()))
        for name, one in producers.items():
            both = zip(grid_of(one).items(), grid_of(first).values(), strict=True)
            for (what, its), wanted in both:
                if its != wanted:
                    raise ValueError(
                        f"{where}: {what} of {name!r} is {its}, that of the first {wanted}"
                    )
        super().__init__(**grid_of(first), channels=channels, value_range=ranges, labels=labels)
        self.producers = torch.nn.ModuleDict(producers)
        self.on_host = all(one.on_host for one in producers.values())
        self.on_device = all(one.on_device for one in producers.values())
        waits = [one.patience for one in producers.values() if one.patience is not None]
        self.patience = max(waits) if waits else None

    def parts(self) -> dict[str, Producer]:
        return {name: one for name, one in self.producers.items() if isinstance(one, Producer)}

    def classify(self, nodes: Nodes) -> Regions | Future:
        """Joins the regions of all producers."""
        answers = {name: one.classify(nodes) for name, one in self.parts().items()}
        return _when_all(answers, functools.partial(self._regions, nodes))

    def fill(self, nodes: Nodes) -> Bricks | Future:
        """Joins the bricks of all producers."""
        answers = {name: one.fill(nodes) for name, one in self.parts().items()}
        return _when_all(answers, functools.partial(self._bricks, nodes))

    def _regions(self, nodes: Nodes, answers: Mapping[str, Any]) -> Regions:
        given = {
            n: one if isinstance(one, Regions) else Regions(kind=one) for n, one in answers.items()
        }
        kind = self._kinds(nodes, [one.kind for one in given.values()])
        constants, ranges = dict[str, Tensor](), dict[str, Tensor]()
        for name, one in given.items():
            ((own, channel),) = self.parts()[name].channels.items()
            zero = torch.zeros((len(kind), channel.width), dtype=channel.dtype, device=kind.device)
            constants[name] = one.constants.get(own, zero).view(len(kind), -1).to(channel.dtype)
            ranges |= {name: one.ranges[own]} if own in one.ranges else {}
        return Regions(kind=kind, constants=constants, ranges=ranges, errors=_errors(given))

    def _bricks(self, nodes: Nodes, answers: Mapping[str, Any]) -> Bricks:
        data, constants, given = dict[str, Any](), dict[str, Tensor](), dict[str, Bricks]()
        for name, producer in self.parts().items():
            one = given[name] = producer.as_bricks(answers[name])
            (own,) = producer.channels
            data[name] = one.data[own]
            constants |= {name: one.constants[own]} if own in one.constants else {}
        if all(one.kind is None for one in given.values()):
            return Bricks(data=data, errors=_errors(given))
        kind = self._kinds(nodes, [one.kind for one in given.values()])
        if len(constants) < len(given):  # without all constants, CONSTANT nodes need their voxels
            kind = torch.where(kind == Region.CONSTANT, int(Region.DATA), kind)
        return Bricks(data=data, kind=kind, constants=constants, errors=_errors(given))

    def _kinds(self, nodes: Nodes, kinds: Sequence[Tensor | None]) -> Tensor:
        """Returns (k,) regions true for all. An ALIAS raises ValueError; on CUDA it becomes -1."""
        device = nodes.loc.device if self.on_device else torch.device("cpu")
        data = torch.full((len(nodes),), int(Region.DATA), device=device)
        given = torch.stack([data if one is None else one.to(device, torch.int64) for one in kinds])
        if device.type == "cpu" and bool((given == Region.ALIAS).any()):
            raise ValueError("JoinedProducer: producers must answer without alias")
        voxels = (given == Region.DATA) | (given == Region.DATA_MAX_DEPTH)
        deepest = (~voxels | (given == Region.DATA_MAX_DEPTH)).all(0)
        kind = torch.where(deepest, int(Region.DATA_MAX_DEPTH), int(Region.DATA))
        kind = torch.where(voxels.any(0), kind, int(Region.CONSTANT))
        kind = torch.where((given == Region.EMPTY).all(0), int(Region.EMPTY), kind)
        return torch.where((given == Region.ALIAS).any(0), -1, kind)


class StoredChannels(JoinedProducer):
    """Streams the channels of a store that `gvtorch voxelize` made with several of them."""

    def __init__(
        self,
        store: str | Path,
        channels: Sequence[str] | None = None,
        *,
        host_cache: int | str = "512 MB",
        timeout: float = 30.0,
        workers: int | None = None,
    ) -> None:
        """Opens the store.

        Args:
            store: A folder or a URL.
            channels: Which of them; None reads all.
            host_cache: Most bytes of decoded blocks kept in host memory, for all channels together.
            timeout: As in `StoredProducer`.
            workers: Number of threads that read each channel, as in `StoredProducer`.

        Raises:
            ValueError: It has no such channel, or is not such a store; or see `StoredProducer`.
            OSError: It can't be read.
        """
        known = channel_names(store)
        if not known:
            raise ValueError(f"{store}: is not a store of several channels: use StoredProducer")
        names = known if channels is None else tuple(channels)
        for name in names:
            if name not in known:
                raise ValueError(f"{store}: has no channel {name!r}; there are {', '.join(known)}")
        limit = check.nbytes("StoredChannels", "host_cache", host_cache) // max(len(names), 1)
        told: dict[str, Any] = {"host_cache": limit, "timeout": timeout, "workers": workers}
        super().__init__(
            {name: StoredProducer(Store.open(store, image=name), **told) for name in names}
        )


def _when_all(answers: Mapping[str, Any], join: Callable[[Mapping[str, Any]], Any]) -> Any:
    """Joins answers: at once, or as a future if any of them is one."""
    late = [one for one in answers.values() if isinstance(one, Future)]
    if not late:
        return join(answers)
    found: Future = Future()
    found.set_running_or_notify_cancel()
    left, lock = len(late), threading.Lock()

    def came(_: Future) -> None:
        nonlocal left
        with lock:
            left -= 1
            if left:
                return
        try:
            found.set_result(join({name: arrived(one) for name, one in answers.items()}))
        except BaseException as error:  # a read that failed or was cancelled
            found.set_exception(error)

    for one in late:
        one.add_done_callback(came)
    return found


def _errors(given: Mapping[str, Regions | Bricks]) -> dict[int, str]:
    return {row: text for one in given.values() for row, text in one.errors.items()}
