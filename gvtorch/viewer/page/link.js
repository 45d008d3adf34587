// The messages: texts, passed on by their type, and pictures and files, which come as bytes.

const MAX_BYTES = 2 ** 20;  // of a message, above which the server would end the connection

export class Link {
  /** `connect(receive, onLost)` opens a transport and returns the function that sends a text. */
  constructor(connect) {
    this.handlers = new Map();
    this.post = connect((data) => this.receive(data), (reason) => this.emit("gone", { reason }));
  }

  on(type, handler) {
    this.handlers.set(type, [...(this.handlers.get(type) ?? []), handler]);
  }

  emit(type, content) {
    for (const handler of this.handlers.get(type) ?? []) handler(content);
  }

  send(type, content = {}) {
    const text = JSON.stringify({ type, ...content }), { size } = new Blob([text]);
    if (size > MAX_BYTES) this.emit("refused", { text: `${type}: ${size} bytes, more than ${MAX_BYTES}` });
    else this.post(text);
  }

  receive(data) {
    if (typeof data === "string") {
      const content = JSON.parse(data);
      this.emit(content.type, content);
      return;
    }
    const view = new DataView(data.buffer ?? data, data.byteOffset ?? 0, data.byteLength);
    const headSize = view.getUint32(0, true);
    const bytes = new Uint8Array(view.buffer, view.byteOffset);
    const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + headSize)));
    const body = bytes.subarray(4 + headSize, view.byteLength);
    this.emit(head.file ? "file" : "picture", { head, bytes: body });
  }
}
