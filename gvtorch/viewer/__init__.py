"""The viewer: an interactive page that shows a scene.

`view` opens it. A `Session` owns the scene and renders in its own thread for any number of
`Client`s; `Server` serves their pages by aiohttp, `notebook` by anywidget. What is shown is a
`ViewState`, made of dataclasses of the other rooms; `schema` converts it to and from JSON.
"""

from .flight import Flight as Flight
from .state import Development as Development
from .state import Eye as Eye
from .state import ViewState as ViewState
from .view import Viewer as Viewer
from .view import view as view
