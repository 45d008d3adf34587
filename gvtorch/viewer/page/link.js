// The messages: texts, passed on by their type, and pictures and files, which come as bytes.

export class Link {
  /** `connect(take, gone)` opens a transport and returns the function that sends a text. */
  constructor(connect) {
    this.takers = new Map();
    this.post = connect((data) => this.take(data), (why) => this.emit("gone", { why }));
  }

  on(type, take) {
    this.takers.set(type, [...(this.takers.get(type) ?? []), take]);
  }

  emit(type, content) {
    for (const take of this.takers.get(type) ?? []) take(content);
  }

  send(type, content = {}) {
    this.post(JSON.stringify({ type, ...content }));
  }

  take(data) {
    if (typeof data === "string") {
      const content = JSON.parse(data);
      this.emit(content.type, content);
      return;
    }
    const view = new DataView(data.buffer ?? data, data.byteOffset ?? 0, data.byteLength);
    const size = view.getUint32(0, true);
    const bytes = new Uint8Array(view.buffer, view.byteOffset);
    const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size)));
    const rest = bytes.subarray(4 + size, view.byteLength);
    this.emit(head.file ? "file" : "picture", { head, bytes: rest });
  }
}
