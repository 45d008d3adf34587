"""Reading volumes from files, and the store on disk."""

from .formats import read_volume
from .store import Store

__all__ = ["Store", "read_volume"]
