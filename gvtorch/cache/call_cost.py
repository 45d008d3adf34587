"""`CallCost`: how long calls take, learned from those that were made."""

from __future__ import annotations

_NEWEST = 0.3  # weight of the newest call
_SPREAD = 0.1  # relative spread of batch sizes from which on the two parts of a cost are told apart
_PROBE = 1.25  # times as many items are tried where the sizes were all alike
_LEAST = 0.02  # share of a call's time that its items take at least


class CallCost:
    """The time of a call with n items as a line, own + n * each, fitted to the last calls; older
    ones weigh less. The first, which may load what all need, is forgotten at the second.

    Attributes:
        largest: About as many items as a call had lately.
    """

    def __init__(self) -> None:
        """Knows nothing yet."""
        self.largest, self._calls = 0.0, 0
        self._weight = self._items = self._time = self._squares = self._products = 0.0

    def learn(self, items: int, milliseconds: float) -> None:
        """Takes note of a call."""
        self._calls += 1
        if self._calls == 2:
            self._weight = self._items = self._time = self._squares = self._products = 0.0
        new = (1, items, milliseconds, items * items, items * milliseconds)
        old = (self._weight, self._items, self._time, self._squares, self._products)
        both = [before + _NEWEST * (n - before) for before, n in zip(old, new, strict=True)]
        self._weight, self._items, self._time, self._squares, self._products = both
        self.largest = max(float(items), (1 - _NEWEST) * self.largest)

    def fitting(self, milliseconds: float, unknown: int) -> int:
        """Returns how many items a call of so many milliseconds has, at least 1, and at most twice
        as many as were tried; `unknown` where there was no call.

        If a call without items would take most of that time, items get half of it all the same, for
        many small calls would take longer. If all calls had as many items, a few more are tried:
        the line cannot be fitted otherwise.
        """
        if not self._weight:
            return unknown
        own, each, known = self._line()
        fitting = max(1.0, max(milliseconds - own, 0.5 * milliseconds) / each)
        mean = self._items / self._weight
        if not known and abs(fitting - mean) <= _SPREAD * mean:
            fitting = max(fitting + 1, _PROBE * fitting)
        return int(min(fitting, max(2 * self.largest, 2.0)))

    def _line(self) -> tuple[float, float, bool]:
        """What a call takes by itself and for each item, and whether the two can be told apart."""
        items, time = self._items / self._weight, self._time / self._weight
        spread = self._squares / self._weight - items * items
        known = spread > (_SPREAD * items) ** 2
        most = time / items
        if not known:
            return 0.0, most, known
        slope = (self._products / self._weight - items * time) / spread
        each = min(max(slope, _LEAST * most), most)
        return time - each * items, each, known
