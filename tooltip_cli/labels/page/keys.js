// Every key and what it does: the help shows this table and the page listens by it.

const TABLE = [
  ["Point", [
    ["", "Click", "place the point; hold the button to adjust it before letting go"],
    ["place", "Enter", "place the point at the cursor, or in the middle", "enter"],
    ["nudge", "Arrow keys", "move the point by a pixel", "arrow"],
    ["nudge", "Shift + arrow", "by a tenth of a pixel", "shift+arrow"],
    ["nudge", "Ctrl + arrow", "by ten pixels", "ctrl+arrow"],
    ["occluded", "Q", "something hides the tip", "q"],
    ["out", "O", "the tip is out of view", "o"],
    ["repeat", "R", "put the point where the last one was", "r"],
    ["remove", "Del", "remove the label", "delete", "backspace"],
    ["undo", "Z", "undo, as far back as you like", "z", "ctrl+z"],
    ["redo", "Shift + Z", "redo", "shift+z", "ctrl+shift+z", "ctrl+y"],
  ]],
  ["Frames", [
    ["next", "F", "next frame", "f"],
    ["previous", "D", "previous frame", "d"],
    ["unlabelled", "N", "next frame without a label", "n"],
    ["first", "Home", "first frame", "home"],
    ["last", "End", "last frame", "end"],
    ["flash", "S", "while held: the next image, to see the motion", "s"],
    ["flashBack", "Shift + S", "while held: the image before", "shift+s"],
  ]],
  ["View", [
    ["", "Wheel", "zoom about the cursor"],
    ["", "Space + drag", "move the image; the middle button does, too"],
    ["nearer", "+", "zoom in about the point", "+", "="],
    ["farther", "−", "zoom out", "-"],
    ["fit", "0", "show the whole image", "0"],
    ["hints", "H", "show what the machine found; this can bias you", "h"],
    ["help", "?", "this list", "?"],
  ]],
];

const ARROWS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };
const STEPS = { arrow: 1, "shift+arrow": 0.1, "ctrl+arrow": 10 };
const bound = new Map();
const shown = new Map();
for (const [, rows] of TABLE) {
  for (const [action, keys, , ...names] of rows) {
    names.forEach((name) => bound.set(name, action));
    if (action && !shown.has(action)) shown.set(action, [keys, names]);
  }
}

function named(event) {
  let key = event.key.toLowerCase();
  // letters of other alphabets: the key in the place of the Latin one
  if (key.length === 1 && key > "\x7f" && /^Key[A-Z]$/.test(event.code)) {
    key = event.code[3].toLowerCase();
  }
  const plain = key.length === 1 && !/[a-z]/.test(key); // shift is part of ? and +
  const control = event.ctrlKey || event.metaKey ? "ctrl+" : "";
  return [control + (event.shiftKey && !plain ? "shift+" : ""), key];
}

// Calls actions[name](event, [du, dv]) for the keys of the table; returns nothing.
export function listen(actions, dialog) {
  document.addEventListener("keydown", (event) => {
    if (event.altKey || event.isComposing) return;
    const [prefix, key] = named(event);
    if (dialog.open) {
      if (key === "?") dialog.close();
      return;
    }
    const onButton = event.target.closest("button") !== null;
    if (onButton && (key === "enter" || key === " ")) return;
    const arrow = ARROWS[key];
    const name = prefix + (arrow ? "arrow" : key);
    const action = bound.get(name);
    if (!action) return;
    event.preventDefault();
    const step = STEPS[name];
    actions[action](event, arrow && arrow.map((value) => value * step));
  });
}

export function labelButtons() {
  for (const button of document.querySelectorAll("button[data-action]")) {
    const [keys, names] = shown.get(button.dataset.action);
    const key = document.createElement("kbd");
    key.textContent = keys.replace("Shift + ", "⇧");
    key.setAttribute("aria-hidden", "true");
    button.append(key);
    button.setAttribute("aria-keyshortcuts", names.join(" "));
  }
}

export function fillHelp(box) {
  for (const [title, rows] of TABLE) {
    const part = document.createElement("section");
    const heading = document.createElement("h3");
    heading.textContent = title;
    const list = document.createElement("dl");
    for (const [, keys, text] of rows) {
      const row = document.createElement("div");
      const term = document.createElement("dt");
      keys.split(" + ").forEach((key, place) => {
        const shape = document.createElement("kbd");
        shape.textContent = key;
        term.append(...(place ? [" + ", shape] : [shape]));
      });
      const meaning = document.createElement("dd");
      meaning.textContent = text;
      row.append(term, meaning);
      list.append(row);
    }
    part.append(heading, list);
    box.append(part);
  }
}
