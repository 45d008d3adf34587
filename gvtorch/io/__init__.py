"""Reading volumes from files, and the store on disk."""

from .convert import Estimate, convert, estimate
from .formats import read_volume
from .store import Store

__all__ = ["Estimate", "Store", "convert", "estimate", "read_volume"]
