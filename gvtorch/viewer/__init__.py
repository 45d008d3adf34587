"""The viewer: a page in which a scene is turned and looked into.

`view` opens it. A `Session` owns the scene and renders in a thread of its own for any number of
`Client`s; `Server` brings pages to them by aiohttp, `notebook` by anywidget. What is shown is a
`ViewState`, which `schema` makes of the dataclasses of the other rooms.
"""

from .flight import Flight as Flight
from .state import Development as Development
from .state import Eye as Eye
from .state import ViewState as ViewState
from .view import Viewer as Viewer
from .view import view as view
