"""Reading volumes from files."""

from .formats import read_volume

__all__ = ["read_volume"]
