"""Functions of place."""

from . import noise

__all__ = ["noise"]
