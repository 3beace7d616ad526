// One button for each frame: its state as a colour and a shape; jumps there.

export const WORDS = {
  none: "not labelled", visible: "visible", occluded: "occluded", out_of_view: "out of view",
};

export class Strip {
  #buttons;
  #current = 0;

  constructor(list, frames, go) {
    this.#buttons = frames.map((frame, place) => {
      const button = document.createElement("button");
      button.type = "button";
      button.tabIndex = -1;
      button.addEventListener("click", () => go(place));
      const item = document.createElement("li");
      item.append(button);
      list.append(item);
      return button;
    });
    list.addEventListener("keydown", (event) => {
      const place = this.#buttons.indexOf(event.target);
      const steps = { ArrowLeft: -1, ArrowRight: 1 };
      const next = { Home: 0, End: this.#buttons.length - 1 }[event.key] ??
        place + (steps[event.key] ?? NaN);
      if (event.ctrlKey || event.metaKey || event.altKey || !this.#buttons[next]) return;
      event.preventDefault();
      event.stopPropagation();
      this.#buttons[next].focus();
    });
    frames.forEach((frame, place) => this.update(frame, place));
  }

  update(frame, place) {
    const button = this.#buttons[place];
    const state = frame.label?.state ?? "none";
    button.className = state;
    const text = `Frame ${place + 1}, image ${frame.image}: ${WORDS[state]}`;
    button.title = text;
    button.setAttribute("aria-label", text);
  }

  select(place) {
    const before = this.#buttons[this.#current];
    before.removeAttribute("aria-current");
    before.tabIndex = -1;
    this.#current = place;
    const button = this.#buttons[place];
    button.setAttribute("aria-current", "true");
    button.tabIndex = 0;
    button.scrollIntoView({ block: "nearest" });
  }
}
