// The labelling page: brings together labels, images, the view and what the person does.
import { Images } from "./images.js";
import { fillHelp, labelButtons, listen } from "./keys.js";
import { Labels, same } from "./labels.js";
import { Saver } from "./saving.js";
import { Strip, WORDS } from "./strip.js";
import { View, paintLoupe } from "./view.js";

const $ = (id) => document.getElementById(id);
const state = await (await fetch("state")).json();
const { frames } = state;
const size = [state.width, state.height];
const canvas = $("view");
const images = new Images(size, arrived);
const saver = new Saver(state, { saving, saved, broken, conflict });
const labels = new Labels(state, saver, changed);
const strip = new Strip($("strip"), frames, (place) => { go(place); canvas.focus(); });
const view = new View(canvas, size, paint);
let current = 0;
let cursor = null; // the mouse on the canvas, CSS pixels
let focus = null; // the pixel in the middle of the loupe
let last = null; // the pixel that was placed last
let held = null; // the image that is flashed
let hints = null; // what the machine found; null: hidden
let dragged = null; // "point" or "image" while a button is down
let space = false;
let addressing = 0;

// Frames

function go(place) {
  performance.mark("asked");
  current = place;
  held = null;
  images.want(wanted());
  strip.select(place);
  const pixel = placed(frames[place].label);
  if (pixel) view.reveal(pixel);
  focus = pixel ?? view.toImage(cursor ?? view.middle);
  clearTimeout(addressing); // browsers limit how often the address may change
  addressing = setTimeout(() => window.history.replaceState(null, "", `#${place + 1}`), 200);
  message("");
  describe();
  paint();
  say(`Frame ${place + 1} of ${frames.length}, ${words(frames[place].label)}`);
}

function wanted() {
  const places = [current, current + 1, current + 2, current + 3, labels.unlabelled(current),
    current - 1];
  const found = places.map((place) => frames[place]?.image);
  return [...found, neighbour(1), neighbour(-1)].filter((image) => image !== undefined);
}

// The next image of the recording, or the one before; at an end the other one.
function neighbour(step) {
  const inside = (image) => image >= 0 && image < state.images;
  return [step, -step].map((by) => frames[current].image + by).find(inside);
}

function arrived(image) {
  if (image === frames[current].image || image === held) paint();
}

// Labels

function placed(label) {
  return label?.state === "visible" ? [label.u, label.v] : undefined;
}

function words(label) {
  const pixel = placed(label);
  if (!pixel) return WORDS[label?.state ?? "none"];
  return `visible at ${pixel.map((value) => value.toFixed(1)).join(", ")}`;
}

function set(label, merge) {
  if (saver.broken) return;
  labels.set(current, label, merge);
}

function put(pixel, merge) {
  if (!images.ready(frames[current].image) || held !== null) {
    message("The image is not here yet.");
    return;
  }
  const [u, v] = view.clamped(pixel);
  set({ state: "visible", u, v, labeler: state.labeler }, merge);
}

function mark(name) {
  set({ state: name, u: null, v: null, labeler: state.labeler });
}

function nudge(event, [du, dv]) {
  const pixel = placed(frames[current].label);
  if (!pixel) {
    message("There is no point yet: click, or press Enter.");
    return;
  }
  put([pixel[0] + du, pixel[1] + dv], event.repeat);
}

// The point that was placed last; after a reload, that of the nearest frame before.
function repeat() {
  const before = frames.slice(0, current).map((frame) => placed(frame.label)).filter(Boolean);
  const pixel = last ?? before.at(-1);
  if (pixel) put(pixel);
  else message("No point has been placed yet.");
}

function travel(place, nothing) {
  if (place === undefined) message(nothing);
  else if (place !== current) go(place);
}

function changed(place) {
  const label = frames[place].label;
  strip.update(frames[place], place);
  if (placed(label)) last = placed(label);
  if (place !== current) return;
  focus = placed(label) ?? focus;
  if (placed(label) && dragged === null) view.reveal(placed(label));
  message("");
  describe();
  paint();
  say(words(label));
}

const actions = {
  place: () => put(view.toImage(cursor ?? view.middle)),
  nudge,
  occluded: () => mark("occluded"),
  out: () => mark("out_of_view"),
  repeat,
  remove: () => set(null),
  undo: () => saver.broken || travel(labels.undo(), "There is nothing to undo."),
  redo: () => saver.broken || travel(labels.redo(), "There is nothing to redo."),
  next: () => (current + 1 < frames.length ? go(current + 1) : message("This is the last frame.")),
  previous: () => (current > 0 ? go(current - 1) : message("This is the first frame.")),
  unlabelled: () => travel(labels.unlabelled(current), "Every frame is labelled."),
  first: () => go(0),
  last: () => go(frames.length - 1),
  flash: (event) => flash(event, 1),
  flashBack: (event) => flash(event, -1),
  nearer: () => zoom(1.25),
  farther: () => zoom(0.8),
  fit: () => { view.fit(); paint(); },
  hints: toggleHints,
  help: () => $("help").showModal(),
};

// What the page shows

function describe() {
  const { image, label } = frames[current];
  const where = `Frame ${current + 1} of ${frames.length}`;
  $("frame").textContent = where;
  $("image").textContent = `image ${image}`;
  $("state").className = `chip ${label?.state ?? "none"}`;
  $("state").textContent = words(label);
  $("done").firstChild.textContent = `${labels.done} of ${frames.length}`;
  canvas.setAttribute("aria-label", `${where}, ${words(label)}`);
  document.title = `${current + 1}/${frames.length} ${state.name}: label the tip`;
  for (const button of document.querySelectorAll("button.state")) {
    button.classList.toggle("on", button.classList.contains(label?.state));
  }
}

function paint() {
  const { image, label } = frames[current];
  const bitmap = images.ready(held ?? image);
  const marks = [];
  const pixel = placed(label);
  if (hints && held === null) {
    for (const [kind, found] of [["detection", hints.detections], ["prediction", hints.predictions]]) {
      if (found[image]) marks.push({ kind, pixel: found[image] });
    }
  }
  if (pixel) marks.push({ kind: "label", pixel });
  view.paint(bitmap, marks);
  paintLoupe($("loupe"), bitmap, focus, marks);
  const failure = images.failure(held ?? image);
  $("badge").hidden = Boolean(bitmap) && held === null;
  $("badge").textContent = failure ? `Image ${held ?? image} cannot be shown: ${failure}`
    : !bitmap ? "Loading …" : `Image ${held}, not the one to label`;
  $("zoom").textContent = `${Number(view.scale.toPrecision(2))}×`;
  $("where").textContent = focus ? focus.map((value) => value.toFixed(1)).join(", ") : "";
  if (bitmap && held === null) timed();
}

// How long a frame took from being asked for to being on the screen, for whoever measures it.
function timed() {
  if (!performance.getEntriesByName("asked").length) return;
  requestAnimationFrame(() => {
    setTimeout(() => {
      if (!performance.getEntriesByName("asked").length) return;
      performance.measure("shown", "asked");
      performance.clearMarks("asked");
    });
  });
}

function message(text) {
  $("message").hidden = !text;
  $("message").textContent = text;
  if (text) say(text);
}

function say(text) {
  $("spoken").textContent = text;
}

function zoom(factor) {
  const pixel = placed(frames[current].label);
  if (pixel) view.reveal(pixel);
  view.zoomAt(pixel ? view.toScreen(pixel) : cursor ?? view.middle, factor);
  paint();
}

function flash(event, step) {
  if (event.repeat) return;
  held = neighbour(step) ?? null;
  paint();
  if (event.type === "click") setTimeout(unflash, 600);
}

function unflash() {
  if (held === null) return;
  held = null;
  paint();
}

async function toggleHints() {
  if (!state.hints) return;
  const button = document.querySelector("[data-action=hints]");
  if (hints) {
    hints = null;
  } else {
    const answer = await fetch("hints").catch(() => null);
    if (!answer?.ok) {
      message("The server does not answer.");
      return;
    }
    hints = await answer.json();
  }
  button.setAttribute("aria-pressed", String(hints !== null));
  const key = "○ detection, ✕ prediction. Both can bias you.";
  $("hint-note").hidden = hints === null;
  $("hint-note").textContent = hints ? [key, ...hints.notes].join("\n") : "";
  paint();
}

// Saving

function saving() {
  $("saved").textContent = "Saving …";
}

function saved() {
  $("saved").textContent = "Saved";
  $("saved").className = "";
  if (!alertAsks()) warn("");
}

function broken(text) {
  $("saved").textContent = "Not saved";
  $("saved").className = "broken";
  const count = saver.unsaved;
  warn(`${text} ${count === 1 ? "One change is" : `${count} changes are`} not saved yet; this ` +
    "page keeps trying, and takes no new labels until then. If 'tooltip label' was stopped, start " +
    "it again: it opens a page with all that was saved.");
}

function conflict(place, mine, theirs) {
  changed(place);
  const by = theirs ? `${words(theirs)}, by ${theirs.labeler}` : "not labelled";
  warn(`Frame ${place + 1} was changed elsewhere in the meantime: ${by}. Yours was not saved: ` +
    `${words(mine)}.`, [
    ["Keep theirs", () => {}],
    ["Use mine", () => { go(place); set(mine); }],
  ]);
}

function alertAsks() {
  return $("alert-buttons").childElementCount > 0;
}

function warn(text, choices = []) {
  $("alert").hidden = !text;
  $("alert-text").textContent = text;
  $("alert-buttons").replaceChildren(...choices.map(([name, act]) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.addEventListener("click", () => {
      warn("");
      canvas.focus();
      act();
    });
    return button;
  }));
}

// Another tab or program may have changed labels while this one was out of sight.
async function refresh() {
  if (!saver.idle) return;
  const answer = await fetch("state").catch(() => null);
  if (!answer?.ok || !saver.idle) return;
  (await answer.json()).frames.forEach(({ revision, label }, place) => {
    const differs = !same(frames[place].label, label);
    Object.assign(frames[place], { revision, label });
    if (differs) changed(place);
  });
}

// Mouse

function at(event) {
  const box = canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

canvas.addEventListener("pointerdown", (event) => {
  if (event.button === 2) return;
  event.preventDefault();
  canvas.focus({ focusVisible: false });
  canvas.setPointerCapture(event.pointerId);
  cursor = at(event);
  dragged = event.button === 1 || space ? "image" : "point";
});
canvas.addEventListener("pointermove", (event) => {
  const before = cursor;
  cursor = at(event);
  if (dragged === "image" && before) view.pan(cursor[0] - before[0], cursor[1] - before[1]);
  focus = view.toImage(cursor);
  paint();
});
canvas.addEventListener("pointerup", (event) => {
  cursor = at(event);
  const pixel = view.toImage(cursor);
  if (dragged === "point" && view.contains(pixel)) put(pixel);
  dragged = null;
});
canvas.addEventListener("pointercancel", () => { dragged = null; });
canvas.addEventListener("pointerleave", () => {
  cursor = null;
  focus = placed(frames[current].label) ?? focus;
  paint();
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
  const step = Math.min(Math.max(event.deltaY * lines, -240), 240);
  view.zoomAt(at(event), Math.exp(-step * (event.ctrlKey ? 0.01 : 0.002)));
  paint();
}, { passive: false });

// Keys and buttons

function grab(down) {
  space = down;
  canvas.classList.toggle("grab", down);
}

document.addEventListener("keydown", (event) => {
  if (event.key !== " " || $("help").open || event.target.closest("button")) return;
  event.preventDefault();
  grab(true);
});
document.addEventListener("keyup", (event) => {
  if (event.key === " ") grab(false);
  if (event.key.toLowerCase() === "s" || event.code === "KeyS") unflash();
});
addEventListener("blur", () => { grab(false); unflash(); });
addEventListener("focus", refresh);
listen(actions, $("help"));
for (const button of document.querySelectorAll("button[data-action]")) {
  button.addEventListener("click", (event) => actions[button.dataset.action](event));
}
// the mouse takes the focus to no button, so that keys go on meaning what they mean on the image
document.querySelector("aside").addEventListener("mousedown", (event) => event.preventDefault());

$("name").textContent = state.name;
$("labeler").textContent = `by ${state.labeler}`;
$("saved").textContent = "Saved";
$("saved").title = state.file;
document.querySelector("[data-action=hints]").hidden = !state.hints;
labelButtons();
fillHelp($("help-keys"));
view.fit();
const asked = Number(window.location.hash.slice(1)) - 1;
go(frames[asked] ? asked : labels.unlabelled(frames.length - 1) ?? 0);
canvas.focus({ focusVisible: false });
