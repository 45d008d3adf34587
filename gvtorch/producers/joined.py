"""`JoinedProducer`: the channels of several producers of one grid, as one; `StoredChannels`: those
of a store of several channels.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..io.stores.channels import channel_names
from ..io.stores.store import Store
from .producer import (
    Bricks,
    Layout,
    Nodes,
    Producer,
    Region,
    Regions,
    Where,
    arrived,
    grid_of,
)
from .stored import StoredProducer


class JoinedProducer(Producer):
    """Asks several producers for the same nodes; each gives one channel, under a name of its own.

    A node is EMPTY where all say so, and CONSTANT where none has voxels for it. Answers with
    aliases are refused.

    Attributes:
        producers: By the name of its channel.
    """

    def __init__(self, producers: Mapping[str, Producer]) -> None:
        """Takes producers of one channel each.

        Args:
            producers: By the name that the channel of each gets.

        Raises:
            ValueError: One has several channels, or they differ in extent, place or branching.
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

    def _each(self) -> dict[str, Producer]:
        return {name: one for name, one in self.producers.items() if isinstance(one, Producer)}

    @property
    def version(self) -> int:  # type: ignore[override]
        """Rises with that of each."""
        return max(one.version for one in self._each().values())

    def changed(self, where: Any = None) -> None:
        """See `Producer.changed`; all have changed."""
        for one in self._each().values():
            one.changed(where)

    def changes(self, since: int) -> list[Where] | None:
        """Wherever any has changed."""
        new = [one.changes(since) for one in self._each().values() if one.version > since]
        known = [changes for changes in new if changes is not None]
        if len(known) < len(new):
            return None
        return [*dict.fromkeys(where for changes in known for where in changes)]  # each once

    def differs(self, nodes: Nodes, before: float, after: float) -> Tensor:
        """Where any differs."""
        timed = [one for one in self._each().values() if hasattr(one, "time")]
        return torch.stack([one.differs(nodes, before, after) for one in timed]).any(0)

    def prepare(self, layout: Layout) -> None:
        """Prepares all."""
        for one in self._each().values():
            one.prepare(layout)

    def classify(self, nodes: Nodes) -> Regions | Future:
        """Asks all."""
        answers = {name: one.classify(nodes) for name, one in self._each().items()}
        join = functools.partial(_joined_regions, self._device(nodes), len(nodes), self._each())
        return _when_all(answers, join)

    def fill(self, nodes: Nodes) -> Bricks | Future:
        """Asks all."""
        answers = {name: one.fill(nodes) for name, one in self._each().items()}
        join = functools.partial(_joined_bricks, self._device(nodes), self._each())
        return _when_all(answers, join)

    def _device(self, nodes: Nodes) -> torch.device:
        """Where answers are joined."""
        return nodes.loc.device if self.on_device else torch.device("cpu")

    def close(self) -> None:
        """Closes all."""
        for one in self._each().values():
            one.close()


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
            channels: Which of them; None takes all.
            host_cache: Most bytes of decoded blocks kept in host memory, of all together.
            timeout: As of `StoredProducer`.
            workers: Number of threads that read a channel, as of `StoredProducer`.

        Raises:
            ValueError: It has no such channel, or is no store of several; or see `StoredProducer`.
            OSError: It can't be read.
        """
        known = channel_names(store)
        if not known:
            raise ValueError(f"{store}: is no store of several channels: take StoredProducer")
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
    """Joins answers, once all are there if some come later."""
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


def _joined_kinds(kinds: Sequence[Tensor | None], count: int, device: torch.device) -> Tensor:
    """(k,) of regions that hold for all; on CUDA, that of an alias is none that there is."""
    data = torch.full((count,), int(Region.DATA), device=device)
    told = [data if kind is None else kind.to(device, torch.int64) for kind in kinds]
    given = torch.stack(told)
    if device.type == "cpu" and bool((given == Region.ALIAS).any()):
        raise ValueError("JoinedProducer: producers must answer without alias")
    voxels = (given == Region.DATA) | (given == Region.DATA_MAX_DEPTH)
    deepest = (~voxels | (given == Region.DATA_MAX_DEPTH)).all(0)
    kind = torch.where(deepest, int(Region.DATA_MAX_DEPTH), int(Region.DATA))
    kind = torch.where(voxels.any(0), kind, int(Region.CONSTANT))
    kind = torch.where((given == Region.EMPTY).all(0), int(Region.EMPTY), kind)
    return torch.where((given == Region.ALIAS).any(0), -1, kind)


def _joined_regions(
    device: torch.device,
    count: int,
    producers: Mapping[str, Producer],
    answers: Mapping[str, Any],
) -> Regions:
    given = {
        name: one if isinstance(one, Regions) else Regions(kind=one)
        for name, one in answers.items()
    }
    constants, ranges = dict[str, Tensor](), dict[str, Tensor]()
    for name, one in given.items():
        ((own, channel),) = producers[name].channels.items()
        zero = torch.zeros((count, channel.width), dtype=channel.dtype, device=device)
        constants[name] = one.constants.get(own, zero).view(count, -1).to(channel.dtype)
        ranges |= {name: one.ranges[own]} if own in one.ranges else {}
    kind = _joined_kinds([one.kind for one in given.values()], count, device)
    return Regions(kind=kind, constants=constants, ranges=ranges, errors=_errors(given))


def _joined_bricks(
    device: torch.device, producers: Mapping[str, Producer], answers: Mapping[str, Any]
) -> Bricks:
    data, constants, given = dict[str, Any](), dict[str, Tensor](), dict[str, Bricks]()
    for name, one in answers.items():
        given[name] = producers[name].as_bricks(one)
        (own,) = producers[name].channels
        data[name] = given[name].data[own]
        constants |= {name: given[name].constants[own]} if own in given[name].constants else {}
    errors = _errors(given)
    if all(one.kind is None for one in given.values()):
        return Bricks(data=data, errors=errors)
    counts = [len(one.kind) for one in given.values() if one.kind is not None]
    kind = _joined_kinds([one.kind for one in given.values()], counts[0], device)
    if len(constants) < len(given):  # some tell no constants: their voxels do
        kind = torch.where(kind == Region.CONSTANT, int(Region.DATA), kind)
    return replace(Bricks(data=data, errors=errors), kind=kind, constants=constants)


def _errors(given: Mapping[str, Regions | Bricks]) -> dict[int, str]:
    return {row: text for one in given.values() for row, text in one.errors.items()}
