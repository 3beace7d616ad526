"use strict";

// Turning rays: an orthographic view of the hand frame, the panels of one tool turned together.
function turnable(box) {
  const scene = JSON.parse(box.querySelector("script").textContent);
  const view = { basis: scene.basis.slice(), zoom: 1 };
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
  const button = (text, label, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", () => { act(); draw(); });
    tools.append(made);
  };
  button("Turn left", "Turn left", () => turn(-0.2, 0));
  button("Turn right", "Turn right", () => turn(0.2, 0));
  button("Tilt", "Tilt", () => turn(0, 0.2));
  button("Nearer", "Zoom in", () => { view.zoom *= 1.25; });
  button("Farther", "Zoom out", () => { view.zoom /= 1.25; });
  button("Reset", "Reset the view", () => { view.basis = scene.basis.slice(); view.zoom = 1; });
  box.append(panels, tools);
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

  function draw() {
    canvases.forEach((canvas, index) => paint(canvas, scene, scene.panels[index], view));
  }

  canvases.forEach((canvas) => {
    const pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
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
    canvas.addEventListener("pointerup", release);
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
  const b = view.basis;
  const at = (list, i) => {
    const [x, y, z] = [list[i], list[i + 1], list[i + 2]];
    return [
      side / 2 + scale * (b[0] * x + b[1] * y + b[2] * z),
      side / 2 - scale * (b[3] * x + b[4] * y + b[5] * z),
    ];
  };
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
  const colors = scene.colors.slice();
  colors[0] = color("detector");
  panel.clusters.forEach((cluster, i) => {
    pen.fillStyle = colors[cluster % colors.length];
    ring(at(panel.points, 3 * i), 1.5);
    pen.fill();
  });
  pen.fillStyle = pen.strokeStyle = color("ink");
  pen.font = "12px sans-serif";
  scene.axes.forEach((end, i) => {
    line([at(scene.origin, 0), at(end, 0)]);
    const [x, y] = at(end, 0);
    pen.fillText("xyz"[i], x + 3, y - 3);
  });
  pen.strokeStyle = color("baseline");
  for (const loop of panel.region) {
    const points = [];
    for (let i = 0; i < loop.length; i += 3) points.push(at(loop, i));
    line(points, true);
  }
  pen.strokeStyle = color("muted");
  for (const other of panel.others) {
    ring(at(other, 0), 4);
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
