// The labels of all frames, every change to them, and the way back.

export class Labels {
  #saver;
  #changed;
  #key;
  #past; // of { place, before, after }
  #future;

  // changed(place) is called after every change, by whomever.
  constructor(state, saver, changed) {
    this.frames = state.frames;
    this.#saver = saver;
    this.#changed = changed;
    this.#key = `${state.recording} ${state.file}`;
    [this.#past, this.#future] = this.#stored();
  }

  get done() {
    return this.frames.filter((frame) => frame.label).length;
  }

  // The next frame without a label, from the start again after the last one.
  unlabelled(from) {
    const count = this.frames.length;
    for (let step = 1; step <= count; step += 1) {
      const place = (from + step) % count;
      if (!this.frames[place].label) return place;
    }
    return undefined;
  }

  // The change joins the one before where both belong to one movement.
  set(place, label, merge = false) {
    const before = this.frames[place].label;
    if (same(before, label)) return;
    const newest = this.#past.at(-1);
    if (merge && newest?.place === place && same(newest.after, before)) newest.after = label;
    else this.#past.push({ place, before, after: label });
    this.#future = [];
    this.#write(place, label);
  }

  // Return the frame that was changed back; undefined where there is nothing to undo.
  undo() {
    return this.#travel(this.#past, this.#future, "before");
  }

  redo() {
    return this.#travel(this.#future, this.#past, "after");
  }

  #travel(from, to, side) {
    const change = from.pop();
    if (!change) return undefined;
    to.push(change);
    this.#write(change.place, change[side]);
    return change.place;
  }

  #write(place, label) {
    this.frames[place].label = label;
    this.#store();
    this.#saver.save(place);
    this.#changed(place);
  }

  // The way back outlives a reload of this tab; it is of no use once others have changed labels.
  #store() {
    try {
      sessionStorage.setItem(this.#key, JSON.stringify([this.#past, this.#future]));
    } catch {
      sessionStorage.removeItem(this.#key); // full: then a reload forgets it
    }
  }

  #stored() {
    const [past, future] = JSON.parse(sessionStorage.getItem(this.#key) ?? "[[], []]");
    const newest = new Map([...past.map((change) => [change.place, change.after]),
      ...future.map((change) => [change.place, change.before])]);
    const fits = [...newest].every(([place, label]) =>
      this.frames[place] && same(this.frames[place].label, label));
    return fits ? [past, future] : [[], []];
  }
}

export function same(a, b) {
  return a === b || Boolean(a && b && a.state === b.state && a.u === b.u && a.v === b.v);
}
