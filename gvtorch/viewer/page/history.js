// The history of edits: undo and redo.

const MAX_STEPS = 100;  // steps that are kept

export class History {
  constructor() {
    this.done = [];
    this.undone = [];
  }

  /** Adds an edit: `back` undoes it, `forth` redoes it. */
  push(back, forth) {
    this.done = [...this.done.slice(1 - MAX_STEPS), { back, forth }];
    this.undone = [];
  }

  /** Undoes the last edit; returns false if there is none. */
  undo() {
    return step(this.done, this.undone, "back");
  }

  redo() {
    return step(this.undone, this.done, "forth");
  }
}

function step(from, to, direction) {
  const last = from.pop();
  if (!last) return false;
  to.push(last);
  last[direction]();
  return true;
}
