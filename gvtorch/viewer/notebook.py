"""`widget`: the viewer's page below a notebook's cell (JupyterLab, VS Code, Colab), by anywidget.

The page's modules are sent as texts, and a few lines load them in the browser in the order of their
imports; messages and pictures use the notebook's own connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import Any

from ..base.messages import need_library
from .client import Client, image_file
from .server import page_files
from .session import Session

#: Makes modules of the page's texts, and mounts it with the notebook's model as its transport.
_LOADER = """
const texts = %s;
const urls = {};
const moduleUrl = (name) => urls[name] ??= URL.createObjectURL(new Blob(
  [texts[name].replace(/from "\\.\\/([a-z]+\\.js)"/g, (_, other) => `from "${moduleUrl(other)}"`)],
  { type: "text/javascript" }));
export default {
  async render({ model, el }) {
    const { mount } = await import(moduleUrl("app.js"));
    const root = document.createElement("div");
    root.className = "gv";
    root.style.height = `${model.get("height")}px`;
    el.append(root);
    const listeners = {};
    const connect = (receive, onLost) => {
      listeners["msg:custom"] = (content, buffers) => {
        if (content.gone) onLost(content.gone);
        else receive(buffers.length ? buffers[0] : content.text);
      };
      listeners["comm_live_update"] = () => onLost("The notebook's kernel has ended.");
      for (const [event, listener] of Object.entries(listeners)) model.on(event, listener);
      return (text) => model.send({ text });
    };
    mount(root, connect);
    model.send({ joined: true });
    return () => {
      for (const [event, listener] of Object.entries(listeners)) model.off(event, listener);
      model.send({ joined: false });
    };
  },
};
"""


def module_text() -> str:
    """Returns the whole page as one JavaScript module."""
    files = {name: data.decode() for name, data in page_files().items() if name.endswith(".js")}
    del files["main.js"]  # the transport of a served page
    return _LOADER % json.dumps(files)


def widget(session: Session) -> Any:
    """Returns the widget that shows a session in a notebook: the live page, or a PNG where widgets
    do not run; raises ImportError without anywidget.
    """
    need_library("view in a notebook", "anywidget", extra="notebook")
    import anywidget
    import traitlets

    class ViewWidget(anywidget.AnyWidget):
        """A view below a cell; it shows `session`, and `close_view` ends it."""

        _esm = module_text()
        _css = page_files()["style.css"].decode()
        height = traitlets.Int(560).tag(sync=True)  # pixels

        def __init__(self, session: Session, **options: Any) -> None:
            super().__init__(**options)
            self.session = session
            self._client: Client | None = None  # for all cells that show it
            self._cells = 0  # that show it
            self.on_msg(self._receive)
            self._loop: asyncio.AbstractEventLoop | None = None  # running in this thread
            with contextlib.suppress(RuntimeError):
                self._loop = asyncio.get_running_loop()

        def _receive(self, _widget: Any, content: Any, _buffers: Any) -> None:
            if content.get("joined") is not None:
                self._cells = max(0, self._cells + (1 if content["joined"] else -1))
                if self._client is not None and (content["joined"] or not self._cells):
                    self.session.leave(self._client)
                    self._client = None
                if content["joined"]:
                    self._client = self.session.join(self._post)  # which welcomes all cells
            elif self._client is not None and isinstance(content.get("text"), str):
                self.session.receive(self._client, content["text"])

        def _post(self, data: str | bytes) -> None:
            if self._loop is None:
                self._send_now(data)
            else:
                self._loop.call_soon_threadsafe(self._send_now, data)

        def _send_now(self, data: str | bytes) -> None:
            if isinstance(data, str):
                self.send({"text": data})
            else:
                self.send({}, buffers=[data])

        def _repr_mimebundle_(self, **options: Any) -> Any:
            bundle = super()._repr_mimebundle_(**options)
            data = bundle[0] if isinstance(bundle, tuple) else dict(bundle or {})
            data["image/png"] = self.png()
            return (data, bundle[1]) if isinstance(bundle, tuple) else data

        def png(self, width: int = 960, height: int = 540) -> bytes:
            """Returns what is shown, as a PNG file."""
            eye = self.session.state.camera
            assert eye is not None
            picture = self.session.ask(lambda: self.session.still(eye, width, height), 600)
            return image_file(picture, "PNG")

        def close_view(self) -> None:
            """Ends the view; an engine that the caller made stays open."""
            self.session.close()
            self.send({"gone": "The view was closed."})

    return ViewWidget(session)
