"""How much noise was evaluated, and how much a plain sum would have taken."""

import torch


class Tally:
    """Counts what was evaluated; what a unit is, its user says.

    Nothing is counted while torch compiles: it takes an attribute for a constant, and a function
    that changes one would be compiled anew at each call.

    Attributes:
        made: Units that were evaluated so far.
        wanted: Those that were asked for, whether they had to be evaluated or not.
    """

    made = wanted = 0

    def _count(self, made: int = 0, wanted: int = 0) -> None:
        if not torch.compiler.is_compiling():
            self.made += made
            self.wanted += wanted
