"""GigaVoxels on PyTorch tensors: explore, render and learn from scenes far larger than memory.

Public names are declared once, in `__init__.pyi`, which editors and type checkers read as well.
Each is loaded when it is first used, so that `gvtorch --help` does not wait for torch. A program
that only loads TorchScript archives or exported programs imports `gvtorch.ops`, which registers the
ops.
"""

import importlib
import os
import sys

from .base.declared import imported_names

__version__ = "0.1.0"

#: How long OpenMP's threads spin before they sleep. By default they spin for milliseconds; if other
#: programs run, that takes cores from the threads they wait for. Read when torch is loaded.
if "torch" not in sys.modules and not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & set(os.environ):
    os.environ["GOMP_SPINCOUNT"] = "2000"

#: Public name -> the module that defines it; empty for a subpackage.
_HOME = imported_names("__init__.pyi")
__all__ = sorted(_HOME)  # noqa: PLE0605


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'gvtorch' has no attribute {name!r}")
    home = importlib.import_module(f".{_HOME[name] or name}", __name__)
    globals()[name] = value = getattr(home, name) if _HOME[name] else home
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
