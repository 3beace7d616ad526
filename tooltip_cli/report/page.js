"use strict";

// Turning rays: an orthographic view of the hand frame, the panels of one tool turned together.
function turnable(box) {
  const scene = JSON.parse(box.querySelector("script").textContent);
  const view = { basis: scene.basis.slice(), zoom: 1, end: -1 };
  const panels = document.createElement("div");
  panels.className = "panels";
  const canvases = scene.panels.map((panel) => {
    const holder = document.createElement("div");
    const title = document.createElement("p");
    title.textContent = panel.title;
    const canvas = document.createElement("canvas");
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label",
      panel.title + ": " + box.querySelector("svg").getAttribute("aria-label") +
      " Arrow keys turn it, plus and minus zoom.");
    holder.append(title, canvas);
    panels.append(holder);
    return canvas;
  });
  const tools = document.createElement("p");
  tools.className = "tools";
  const button = (text, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.addEventListener("click", () => { act(); draw(); });
    tools.append(made);
    return made;
  };
  button("Turn left", () => turn(-0.2, 0));
  button("Turn right", () => turn(0.2, 0));
  button("Tilt", () => turn(0, 0.2));
  button("Nearer", () => { view.zoom *= 1.25; });
  button("Farther", () => { view.zoom /= 1.25; });
  button("Reset", () => { view.basis = scene.basis.slice(); view.zoom = 1; });
  const chosen = document.createElement("div");
  chosen.className = "chosen";
  chosen.setAttribute("role", "status");
  const choices = scene.ends.map((end, i) => {
    const made = button("End " + (i + 1), () => choose(i));
    made.setAttribute("aria-pressed", "false");
    return made;
  });
  box.append(panels, tools, chosen);
  box.classList.add("live");

  // The basis has the rows right, up, towards the viewer; screen axes turn it.
  function turn(aboutUp, aboutRight) {
    const [r, u, t] = [0, 3, 6].map((start) => view.basis.slice(start, start + 3));
    const mix = (a, b, angle) => [
      a.map((value, i) => value * Math.cos(angle) - b[i] * Math.sin(angle)),
      a.map((value, i) => value * Math.sin(angle) + b[i] * Math.cos(angle)),
    ];
    const [r1, t1] = mix(r, t, -aboutUp);
    const [u1, t2] = mix(u, t1, aboutRight);
    view.basis = [...r1, ...u1, ...t2];
  }

  // Of several ends, shows what is known of one and the command that takes it.
  function choose(index) {
    view.end = index;
    choices.forEach((made, i) => made.setAttribute("aria-pressed", String(i === index)));
    const text = document.createElement("p");
    text.textContent = "End " + (index + 1) + ": " + scene.ends[index].text + ". To take it:";
    const line = document.createElement("p");
    const command = document.createElement("code");
    command.textContent = scene.ends[index].command;
    line.append(command);
    if (navigator.clipboard) {
      const copy = document.createElement("button");
      copy.type = "button";
      copy.textContent = "Copy";
      copy.addEventListener("click", () => navigator.clipboard.writeText(command.textContent)
        .then(() => { copy.textContent = "Copied"; }, () => {
          getSelection().selectAllChildren(command);
          copy.textContent = "Selected";
        }));
      line.append(copy);
    }
    chosen.replaceChildren(text, line);
  }

  // The end drawn under a place of the canvas, or -1.
  function endAt(canvas, event) {
    const side = canvas.clientWidth;
    const at = projection(scene, view, side);
    const edge = canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - edge.left - canvas.clientLeft,
      event.clientY - edge.top - canvas.clientTop];
    const away = scene.ends.map((end) => {
      const [u, v] = at(end.at, 0);
      return Math.hypot(u - x, v - y);
    });
    const least = Math.min(...away);
    return least < 22 ? away.indexOf(least) : -1;
  }

  function draw() {
    canvases.forEach((canvas, index) => paint(canvas, scene, scene.panels[index], view));
  }

  canvases.forEach((canvas, index) => {
    const pointers = new Map();
    let pressed = null;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pressed = [event.clientX, event.clientY];
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const others = [...pointers].filter(([id]) => id !== event.pointerId);
      const now = [event.clientX, event.clientY];
      if (others.length) {
        const from = others[0][1];
        const before = Math.hypot(last[0] - from[0], last[1] - from[1]);
        view.zoom *= Math.hypot(now[0] - from[0], now[1] - from[1]) / Math.max(before, 1);
      } else {
        turn((now[0] - last[0]) / 120, (now[1] - last[1]) / 120);
      }
      pointers.set(event.pointerId, now);
      draw();
    });
    const release = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", (event) => {
      release(event);
      const still = pressed &&
        Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 5;
      const end = still && scene.panels[index].ends ? endAt(canvas, event) : -1;
      if (end >= 0) {
        choose(end);
        draw();
      }
    });
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return;
      event.preventDefault();
      view.zoom *= Math.exp(-event.deltaY / 500);
      draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = {
        ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0),
        ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
        "+": () => { view.zoom *= 1.15; }, "=": () => { view.zoom *= 1.15; },
        "-": () => { view.zoom /= 1.15; },
      };
      if (!steps[event.key]) return;
      event.preventDefault();
      steps[event.key]();
      draw();
    });
  });
  new ResizeObserver(draw).observe(panels);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
}

// Where a point of a list of millimetres is drawn on a canvas of this side.
function projection(scene, view, side) {
  const scale = (side / 2 / scene.radius) * view.zoom;
  const b = view.basis;
  return (list, i) => {
    const [x, y, z] = [list[i], list[i + 1], list[i + 2]];
    return [
      side / 2 + scale * (b[0] * x + b[1] * y + b[2] * z),
      side / 2 - scale * (b[3] * x + b[4] * y + b[5] * z),
    ];
  };
}

function paint(canvas, scene, panel, view) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue("--" + name).trim();
  const side = canvas.clientWidth;
  if (!side) return;
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.height = Math.round(side * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  const scale = (side / 2 / scene.radius) * view.zoom;
  const at = projection(scene, view, side);
  const line = (points, close) => {
    pen.beginPath();
    points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    if (close) pen.closePath();
    pen.stroke();
  };
  const ring = ([x, y], radius) => {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
  };

  pen.globalAlpha = 0.3;
  pen.strokeStyle = color("muted");
  pen.lineWidth = 0.6;
  for (let i = 0; i < panel.rays.length; i += 6) line([at(panel.rays, i), at(panel.rays, i + 3)]);
  pen.globalAlpha = 1;
  pen.lineWidth = 1.2;
  for (const sphere of scene.spheres) {
    ring(at(sphere, 0), sphere[3] * scale);
    pen.stroke();
  }
  const colors = panel.shades ? [color("ink")] : [color("detector"), ...scene.colors.slice(1)];
  panel.clusters.forEach((cluster, i) => {
    pen.fillStyle = colors[cluster % colors.length];
    pen.globalAlpha = panel.shades ? panel.shades[i] / 100 : 1;
    ring(at(panel.points, 3 * i), 1.5);
    pen.fill();
  });
  pen.globalAlpha = 1;
  pen.fillStyle = pen.strokeStyle = color("ink");
  pen.font = "12px sans-serif";
  scene.axes.forEach((end, i) => {
    line([at(scene.origin, 0), at(end, 0)]);
    const [x, y] = at(end, 0);
    pen.fillText("xyz"[i], x + 3, y - 3);
  });
  if (panel.axis) {
    pen.strokeStyle = color("detector");
    pen.setLineDash([6, 3]);
    line([at(panel.axis, 0), at(panel.axis, 3)]);
    pen.setLineDash([]);
  }
  pen.strokeStyle = color("baseline");
  for (const loop of panel.region) {
    const points = [];
    for (let i = 0; i < loop.length; i += 3) points.push(at(loop, i));
    line(points, true);
  }
  pen.strokeStyle = color(panel.ends ? "ink" : "muted");
  for (const other of panel.others) {
    ring(at(other, 0), panel.ends ? 7 : 4);
    pen.stroke();
  }
  if (scene.truth) {
    const [x, y] = at(scene.truth, 0);
    pen.fillStyle = color("truth");
    pen.beginPath();
    pen.moveTo(x, y - 5); pen.lineTo(x + 5, y); pen.lineTo(x, y + 5); pen.lineTo(x - 5, y);
    pen.fill();
  }
  if (panel.tip) {
    const [x, y] = at(panel.tip, 0);
    pen.strokeStyle = color("ink");
    pen.lineWidth = 2;
    ring([x, y], 8);
    pen.stroke();
    pen.lineWidth = 1;
    line([[x - 11, y], [x + 11, y]]);
    line([[x, y - 11], [x, y + 11]]);
  }
  if (panel.ends) {
    pen.font = "600 13px sans-serif";
    pen.lineWidth = 3;
    scene.ends.forEach((end, i) => {
      const [x, y] = at(end.at, 0);
      pen.strokeStyle = color("paper");
      pen.fillStyle = color("ink");
      pen.strokeText(i + 1, x + 12, y - 6);
      pen.fillText(i + 1, x + 12, y - 6);
      if (i === view.end) {
        pen.strokeStyle = color("link");
        ring([x, y], 14);
        pen.stroke();
      }
    });
    pen.font = "12px sans-serif";
  }
  scaleBar(pen, side, scale, color("ink"));
}

function scaleBar(pen, side, scale, color) {
  const length = [10, 20, 50, 100, 200].find((mm) => mm * scale > side / 8) || 500;
  pen.strokeStyle = pen.fillStyle = color;
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(12, side - 12);
  pen.lineTo(12 + length * scale, side - 12);
  pen.stroke();
  pen.fillText(length + " mm", 12, side - 18);
}

document.querySelectorAll(".turn").forEach(turnable);

// Pictures of the audit table, enlarged; links of the strip open the table first.
const viewer = document.getElementById("viewer");
document.addEventListener("click", (event) => {
  const picture = event.target.closest(".picture");
  if (!picture) return;
  const row = picture.closest("tr");
  document.getElementById("viewer-title").textContent =
    "Frame " + row.querySelector("th").firstChild.textContent;
  document.getElementById("viewer-picture").replaceChildren(
    picture.querySelector("svg").cloneNode(true));
  viewer.showModal();
});
function openTarget() {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  const details = target && target.closest("details");
  if (!details) return;
  details.open = true;
  target.scrollIntoView({ block: "center" });
}
addEventListener("hashchange", openTarget);
openTarget();
