"""`Parameters`: values of the scene itself that can be changed while it is shown: the numbers of a
producer's `nn.Parameter`s, and the fields of a dataclass from which a script makes its scene.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_type_hints

import torch

from ..base import check
from ..producers import Producer
from .scene import Scene
from .schema import arguments, control_for, decode, encode

_MAX_NUMBERS = 16  # most numbers of a parameter that gets a control


class Parameters:
    """The adjustable parameters of a scene.

    Attributes:
        producer: The present producer.
        record: The dataclass object from which it is made, or None.
    """

    def __init__(
        self, producer: Producer, record: Any = None, make: Callable[[Any], Producer] | None = None
    ) -> None:
        """Takes a producer, and the record and the function that made it, if there are such."""
        self.producer, self.record, self._make = producer, record, make

    @classmethod
    def of_function(cls, make: Callable[[Any], Producer]) -> Parameters:
        """Takes a function of one argument, a dataclass whose fields all have defaults.

        Raises:
            ValueError: It takes something else, or returns no producer.
        """
        try:
            hints, names = get_type_hints(make), [*inspect.signature(make).parameters]
        except (TypeError, ValueError, NameError):  # of what has no hints or no signature
            hints, names = {}, []
        kind = hints.get(names[0]) if len(names) == 1 else None
        if not (isinstance(kind, type) and is_dataclass(kind)) or any(
            default is inspect.Parameter.empty for _, default in arguments(kind).values()
        ):
            raise ValueError(
                "view: a function must take one argument, annotated with a dataclass whose fields "
                f"all have defaults, got {make!r:.80}"
            )
        record = kind()
        producer = check.instance("view", "result of the function", make(record), Producer)
        return cls(producer, record, make)

    def describe(self) -> dict[str, Any] | None:
        """Returns value and control of each parameter, by name; None if there are none."""
        descriptions: dict[str, Any] = {}
        if self.record is not None:
            hints = get_type_hints(type(self.record))
            for field in fields(self.record):
                control = control_for(hints[field.name])
                if "range" in field.metadata:
                    control["range"] = list(field.metadata["range"])
                descriptions[field.name] = {
                    **control,
                    "value": encode(getattr(self.record, field.name)),
                }
        for name, tensor in self._tensors().items():
            kind = "number" if tensor.numel() == 1 else "numbers"
            value = tensor.item() if tensor.numel() == 1 else tensor.flatten().tolist()
            descriptions[name] = {"type": kind, "value": encode(value)}
        return descriptions or None

    def _tensors(self) -> dict[str, torch.nn.Parameter]:
        named = self.producer.named_parameters()
        return {n: p for n, p in named if p.is_floating_point() and p.numel() <= _MAX_NUMBERS}

    def set(self, name: str, value: Any, scene: Scene) -> None:
        """Sets a parameter, and has the scene produced again.

        Raises:
            ValueError: There is no such parameter, or the value does not fit; nothing changes then.
        """
        tensors = self._tensors()
        if name in tensors:
            numbers = [value] if not isinstance(value, list) else value
            decoded = decode(name, list[float], numbers)
            if len(decoded) != tensors[name].numel():
                raise ValueError(f"set: {name} has {tensors[name].numel()} numbers")
            with torch.no_grad():
                tensors[name].copy_(tensors[name].new_tensor(decoded).view_as(tensors[name]))
            self.producer.changed()
            return
        field_names = [] if self.record is None else [field.name for field in fields(self.record)]
        if name not in field_names or self._make is None:
            raise ValueError(f"set: there is no parameter {name!r:.60}")
        hint = get_type_hints(type(self.record))[name]
        before = getattr(self.record, name)
        record = replace(self.record, **{name: decode(name, hint, value, before)})
        producer = self._make(record)
        scene.resize(lambda _: producer)
        self.record, self.producer = record, producer
