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
    const last = this.done.pop();
    if (!last) return false;
    this.undone.push(last);
    last.back();
    return true;
  }

  redo() {
    const last = this.undone.pop();
    if (!last) return false;
    this.done.push(last);
    last.forth();
    return true;
  }
}
