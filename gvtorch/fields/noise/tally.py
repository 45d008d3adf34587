"""How many random numbers were made, and how many would have been."""

import torch


class Tally:
    """Counts while nothing is compiled: a count that a compiled function changes would be taken for
    a new constant at each call, and the function compiled anew.

    Attributes:
        made: Numbers made.
        wanted: Numbers that are made where nothing is left out or taken over.
    """

    made = wanted = 0

    def _count(self, made: int = 0, wanted: int = 0) -> None:
        if not torch.compiler.is_compiling():
            self.made += made
            self.wanted += wanted
