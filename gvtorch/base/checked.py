"""`Checked`: objects whose attributes are checked, and converted, whenever they are set: when the
object is made, and when it is edited.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from . import check

#: Given the object, the attribute's name and a value, returns what is kept; ValueError if it is
#: refused.
Check = Callable[[Any, str, Any], Any]


class Checked:
    """Checks what its attributes are set to, by the `checks` of its class and of the bases."""

    checks: ClassVar[Mapping[str, Check]] = {}
    _all_checks: ClassVar[Mapping[str, Check]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        known: dict[str, Check] = {}
        for base in reversed(cls.__mro__):
            known.update(vars(base).get("checks", {}))
        cls._all_checks = known

    def __setattr__(self, name: str, value: Any) -> None:
        found = self._all_checks.get(name)
        super().__setattr__(name, value if found is None else found(self, name, value))

    def check_again(self) -> None:
        """Checks all attributes anew: arrays and tensors may have been edited in place."""
        held = vars(self)
        for name, found in self._all_checks.items():
            if name in held:
                found(self, name, held[name])


def kind_of(owner: Any) -> str:
    """Returns the name of an object's class, with which messages begin."""
    return type(owner).__name__


def instance_of(kind: type) -> Check:
    """A check that a value is of a class."""
    return lambda owner, name, value: check.instance(kind_of(owner), name, value, kind)


def or_none(given: Check) -> Check:
    """A check that also lets None pass."""
    return lambda owner, name, value: None if value is None else given(owner, name, value)


def positive(owner: Any, name: str, value: Any) -> float:
    """Checks that a value is a finite number above 0; keeps a float."""
    return check.number(kind_of(owner), name, value, low=0, open_low=True)


def whole_between(low: int, high: int = sys.maxsize) -> Check:
    """A check for a whole number from `low` to `high`."""
    return lambda owner, name, value: check.whole(kind_of(owner), name, value, low=low, high=high)


def as_name(owner: Any, name: str, value: Any) -> str:
    """Checks that a value is a name."""
    if not isinstance(value, str):
        raise ValueError(f"{kind_of(owner)}: {name} must be a name, got {value!r}")
    return value


def flag(owner: Any, name: str, value: Any) -> bool:
    """Checks that a value is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{kind_of(owner)}: {name} must be true or false, got {value!r}")
    return value
