// The page that a server serves: its transport is a websocket at the page's own address.
import { mount } from "./app.js";

const address = new URL("ws" + location.search, location.href);
address.protocol = location.protocol === "https:" ? "wss:" : "ws:";

/** Opens the socket, and reopens it when it is lost. */
function connect(receive, onLost) {
  let socket = null;
  let delay = 500, reason = "";
  const open = () => {
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { [delay, reason] = [500, ""]; };
    socket.onmessage = (event) => receive(event.data);
    socket.onclose = (event) => {
      if (event.wasClean && event.code === 1001) reason = "The view was closed.";
      onLost(reason);
      setTimeout(open, delay);
      delay = Math.min(8000, delay * 2);
    };
  };
  open();
  return (text) => { if (socket.readyState === WebSocket.OPEN) socket.send(text); };
}

mount(document.getElementById("gv"), connect);
