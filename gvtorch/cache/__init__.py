"""The cache: pools with an order of use, requests, and the choice of those that are served."""

from .cache import LRU as LRU
from .cache import Cache as Cache
from .requests import KINDS as KINDS
from .requests import RequestList as RequestList
from .requests import Requests as Requests
from .requests import RequestsByKind as RequestsByKind
from .requests import Scheduler as Scheduler
