"""`JoinedProducer`: joins the channels of several producers of the same grid; `StoredChannels`
does so for a store of several channels.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from ..base import check
from ..fields.field import modules_by_name
from ..io.stores.channels import channel_names
from ..io.stores.store import Store
from .nodes import grid_of
from .producer import Bricks, Nodes, OfProducers, Producer, Region, Regions, wait_for
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
        context = type(self).__name__
        if not isinstance(producers, Mapping):
            got = type(producers).__name__
            raise ValueError(f"{context}: producers must be producers by name, got a {got}")
        if not producers:
            raise ValueError(f"{context}: producers must hold at least one")
        channels, ranges, labels = dict[str, Any](), dict[str, Any](), dict[str, Any]()
        for name, producer in producers.items():
            check.instance(context, f"producers[{name!r}]", producer, Producer)
            if len(producer.channels) != 1:
                names = ", ".join(producer.channels)
                raise ValueError(
                    f"{context}: each producer must have one channel, {name!r} has {names}"
                )
            if producer.needs_parent:
                raise ValueError(f"{context}: {name!r} needs its parents' bricks")
            ((channel_name, channel),) = producer.channels.items()
            channels[name] = channel
            if channel_name in producer.value_range:
                ranges[name] = producer.value_range[channel_name]
            if channel_name in producer.labels:
                labels[name] = producer.labels[channel_name]
        first = next(iter(producers.values()))
        for name, producer in producers.items():
            pairs = zip(grid_of(producer).items(), grid_of(first).values(), strict=True)
            for (attribute, value), expected in pairs:
                if value != expected:
                    raise ValueError(
                        f"{context}: {attribute} of {name!r} is {value}, "
                        f"that of the first {expected}"
                    )
        super().__init__(**grid_of(first), channels=channels, value_range=ranges, labels=labels)
        self.producers = modules_by_name(context, producers)
        self.on_host = all(producer.on_host for producer in producers.values())
        self.on_device = all(producer.on_device for producer in producers.values())

    def parts(self) -> dict[str, Producer]:
        return cast("dict[str, Producer]", dict(self.producers.items()))

    def classify(self, nodes: Nodes) -> Regions | Future:
        """Joins the regions of all producers."""
        answers = {name: producer.classify(nodes) for name, producer in self.parts().items()}
        return _when_all(answers, functools.partial(self._regions, nodes))

    def fill(self, nodes: Nodes) -> Bricks | Future:
        """Joins the bricks of all producers."""
        answers = {name: producer.fill(nodes) for name, producer in self.parts().items()}
        return _when_all(answers, functools.partial(self._bricks, nodes))

    def _regions(self, nodes: Nodes, answers: Mapping[str, Any]) -> Regions:
        regions = {
            n: answer if isinstance(answer, Regions) else Regions(kind=answer)
            for n, answer in answers.items()
        }
        kind = self._kinds(nodes, [answer.kind for answer in regions.values()])
        constants: dict[str, Tensor] = {}
        ranges: dict[str, Tensor] = {}
        for name, answer in regions.items():
            ((channel_name, channel),) = self.parts()[name].channels.items()
            zero = torch.zeros((len(kind), channel.width), dtype=channel.dtype, device=kind.device)
            constant = answer.constants.get(channel_name, zero)
            constants[name] = constant.view(len(kind), -1).to(channel.dtype)
            if channel_name in answer.ranges:
                ranges[name] = answer.ranges[channel_name]
        return Regions(kind=kind, constants=constants, ranges=ranges, errors=_errors(regions))

    def _bricks(self, nodes: Nodes, answers: Mapping[str, Any]) -> Bricks:
        data: dict[str, Any] = {}
        constants: dict[str, Tensor] = {}
        bricks: dict[str, Bricks] = {}
        for name, producer in self.parts().items():
            answer = bricks[name] = producer.as_bricks(answers[name])
            (channel_name,) = producer.channels
            data[name] = answer.voxels(channel_name)
            if channel_name in answer.constants:
                constants[name] = answer.constants[channel_name]
        if all(answer.kind is None for answer in bricks.values()):
            return Bricks(data=data, errors=_errors(bricks))
        kind = self._kinds(nodes, [answer.kind for answer in bricks.values()])
        if len(constants) < len(bricks):  # without all constants, CONSTANT nodes need their voxels
            kind = torch.where(kind == Region.CONSTANT, int(Region.DATA), kind)
        return Bricks(data=data, kind=kind, constants=constants, errors=_errors(bricks))

    def _kinds(self, nodes: Nodes, kinds: Sequence[Tensor | None]) -> Tensor:
        """Returns (k,) regions true for all; -1, which fails, where any is none. An ALIAS raises
        ValueError, on CUDA it is -1.
        """
        device = nodes.loc.device if self.on_device else torch.device("cpu")
        data = torch.full((len(nodes),), int(Region.DATA), device=device)
        on_device = [data if kind is None else kind.to(device, torch.int64) for kind in kinds]
        stacked = torch.stack(on_device)
        if device.type == "cpu" and bool((stacked == Region.ALIAS).any()):
            raise ValueError("JoinedProducer: producers must answer without alias")
        voxels = (stacked == Region.DATA) | (stacked == Region.DATA_MAX_DEPTH)
        deepest = (~voxels | (stacked == Region.DATA_MAX_DEPTH)).all(0)
        kind = torch.where(deepest, int(Region.DATA_MAX_DEPTH), int(Region.DATA))
        kind = torch.where(voxels.any(0), kind, int(Region.CONSTANT))
        kind = torch.where((stacked == Region.EMPTY).all(0), int(Region.EMPTY), kind)
        return torch.where((stacked < Region.EMPTY) | (stacked >= Region.ALIAS), -1, kind).amin(0)


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
        stored_names = channel_names(store)
        if not stored_names:
            raise ValueError(f"{store}: is not a store of several channels: use StoredProducer")
        names = stored_names if channels is None else tuple(channels)
        for name in names:
            check.channel(str(store), name, stored_names, "the store")
        limit = check.nbytes("StoredChannels", "host_cache", host_cache) // max(len(names), 1)
        options: dict[str, Any] = {"host_cache": limit, "timeout": timeout, "workers": workers}
        stores = {name: Store.open(store, image=name) for name in names}
        super().__init__({n: StoredProducer(opened, **options) for n, opened in stores.items()})


def _when_all(answers: Mapping[str, Any], join: Callable[[Mapping[str, Any]], Any]) -> Any:
    """Joins answers: at once, or as a future if any of them is one."""
    futures = [answer for answer in answers.values() if isinstance(answer, Future)]
    if not futures:
        return join(answers)
    joined: Future = Future()
    joined.set_running_or_notify_cancel()
    remaining, lock = len(futures), threading.Lock()

    def on_done(_: Future) -> None:
        nonlocal remaining
        with lock:
            remaining -= 1
            if remaining:
                return
        try:
            joined.set_result(join({name: wait_for(answer) for name, answer in answers.items()}))
        except BaseException as error:  # a read that failed or was cancelled
            joined.set_exception(error)

    for future in futures:
        future.add_done_callback(on_done)
    return joined


def _errors(answers: Mapping[str, Regions | Bricks]) -> dict[int, str]:
    return {row: message for answer in answers.values() for row, message in answer.errors.items()}
