// What was edited, step by step, and back.

const MOST = 100;  // steps that are kept

export class History {
  constructor() {
    this.done = [];
    this.undone = [];
  }

  /** Notes an edit by what takes it back and what does it again. */
  push(back, forth) {
    this.done = [...this.done.slice(1 - MOST), { back, forth }];
    this.undone = [];
  }

  /** Takes the last edit back; false: there is none. */
  undo() {
    return step(this.done, this.undone, "back");
  }

  redo() {
    return step(this.undone, this.done, "forth");
  }
}

function step(from, to, way) {
  const last = from.pop();
  if (!last) return false;
  to.push(last);
  last[way]();
  return true;
}
