// The page that a server serves: its transport is a websocket at the page's own address.
import { mount } from "./app.js";

const address = new URL("ws" + location.search, location.href);
address.protocol = location.protocol === "https:" ? "wss:" : "ws:";

/** Opens the socket, and reopens it when it is lost. */
function connect(take, gone) {
  let socket = null;
  let wait = 500, why = "";
  const open = () => {
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { [wait, why] = [500, ""]; };
    socket.onmessage = (event) => take(event.data);
    socket.onclose = (event) => {
      if (event.wasClean && event.code === 1001) why = "The view was closed.";
      gone(why);
      setTimeout(open, wait);
      wait = Math.min(8000, wait * 2);
    };
  };
  open();
  return (text) => { if (socket.readyState === WebSocket.OPEN) socket.send(text); };
}

mount(document.getElementById("gv"), connect);
