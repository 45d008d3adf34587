"""`Checked`: objects whose attributes are checked, and converted, whenever they are set: when the
object is made, and when it is edited.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, ClassVar

from . import check

#: Gets the object, the attribute's name and a value; returns the value to store, or raises
#: ValueError.
Check = Callable[[Any, str, Any], Any]


class Checked:
    """Checks attributes when they are set, by the `checks` of its class and the base classes."""

    checks: ClassVar[Mapping[str, Check]] = {}
    _all_checks: ClassVar[Mapping[str, Check]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        all_checks: dict[str, Check] = {}
        for base in reversed(cls.__mro__):
            all_checks.update(vars(base).get("checks", {}))
        cls._all_checks = all_checks

    def __setattr__(self, name: str, value: Any) -> None:
        checker = self._all_checks.get(name)
        super().__setattr__(name, value if checker is None else checker(self, name, value))

    def check_again(self) -> None:
        """Checks all attributes again: arrays and tensors may have been edited in place."""
        attributes = vars(self)
        for name, checker in self._all_checks.items():
            if name in attributes:
                checker(self, name, attributes[name])


def class_name(owner: Any) -> str:
    """Returns the name of an object's class, the start of its error messages."""
    return type(owner).__name__


def instance_of(*kinds: type) -> Check:
    """Returns a check that a value is an instance of one of the classes."""
    return lambda owner, name, value: check.instance(class_name(owner), name, value, *kinds)


def optional(checker: Check) -> Check:
    """Returns a check that also accepts None."""
    return lambda owner, name, value: None if value is None else checker(owner, name, value)


def positive(owner: Any, name: str, value: Any) -> float:
    """Checks that a value is a finite number above 0; stores it as a float."""
    return check.number(class_name(owner), name, value, low=0, open_low=True)


def whole_between(low: int, high: int = sys.maxsize) -> Check:
    """Returns a check for a whole number from `low` to `high`."""
    limits = {"low": low, "high": high}
    return lambda owner, name, value: check.integer(class_name(owner), name, value, **limits)


def name_text(owner: Any, name: str, value: Any) -> str:
    """Checks that a value is a str."""
    if not isinstance(value, str):
        raise ValueError(f"{class_name(owner)}: {name} must be a name, got {value!r}")
    return value


def flag(owner: Any, name: str, value: Any) -> bool:
    """Checks that a value is a bool."""
    if not isinstance(value, bool):
        raise ValueError(f"{class_name(owner)}: {name} must be true or false, got {value!r}")
    return value


def also_called(name: str) -> Any:
    """Returns a property that is another name of an attribute."""
    return property(attrgetter(name), lambda owner, value: setattr(owner, name, value))
