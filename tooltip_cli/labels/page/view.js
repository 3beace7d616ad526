// The image on its canvas: zoom, position, marks, and the loupe.
// Pixels (u, v) have their centres at integers: the image reaches from -0.5 to width - 0.5.

const MAX_SCALE = 64; // screen pixels an image pixel
const SMOOTH_BELOW = 2;
const LOUPE = 8;

export class View {
  #box; // width and height, CSS pixels

  constructor(canvas, size, changed) {
    this.canvas = canvas;
    [this.width, this.height] = size;
    this.scale = 1;
    this.left = 0; // of the image's corner on the canvas, CSS pixels
    this.top = 0;
    this.fitted = true;
    this.#measure();
    const resized = () => {
      this.#measure();
      if (this.fitted) this.fit();
      else this.#keepInside();
      changed();
    };
    new ResizeObserver(resized).observe(canvas);
    addEventListener("resize", resized); // the browser's zoom changes pixels, not always sizes
  }

  #measure() {
    const { width, height } = this.canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    this.#box = [width, height];
    this.canvas.width = Math.max(Math.round(width * ratio), 1);
    this.canvas.height = Math.max(Math.round(height * ratio), 1);
  }

  get #least() {
    const [width, height] = this.#box;
    return Math.min(width / this.width, height / this.height) || 1;
  }

  toImage([x, y]) {
    return [(x - this.left) / this.scale - 0.5, (y - this.top) / this.scale - 0.5];
  }

  toScreen([u, v]) {
    return [this.left + (u + 0.5) * this.scale, this.top + (v + 0.5) * this.scale];
  }

  contains([u, v]) {
    return u >= -0.5 && v >= -0.5 && u <= this.width - 0.5 && v <= this.height - 0.5;
  }

  // The nearest pixel position inside the image, to a hundredth.
  clamped([u, v]) {
    const limit = (value, length) => Math.min(Math.max(value, -0.5), length - 0.5);
    return [limit(u, this.width), limit(v, this.height)].map((value) => Math.round(value * 100) / 100);
  }

  get middle() {
    const [width, height] = this.#box;
    return [width / 2, height / 2];
  }

  fit() {
    this.scale = this.#least;
    this.fitted = true;
    this.#keepInside();
  }

  // Zoom so that what lies under a point of the canvas stays under it.
  zoomAt([x, y], factor) {
    const scale = Math.min(Math.max(this.scale * factor, this.#least), Math.max(MAX_SCALE, this.#least));
    this.left = x - (x - this.left) * (scale / this.scale);
    this.top = y - (y - this.top) * (scale / this.scale);
    this.scale = scale;
    this.fitted = scale === this.#least;
    this.#keepInside();
  }

  pan(dx, dy) {
    this.left += dx;
    this.top += dy;
    this.#keepInside();
  }

  // Move as little as needed for a pixel to be seen well inside the canvas.
  reveal(pixel) {
    const margin = 48;
    const [width, height] = this.#box;
    const [x, y] = this.toScreen(pixel);
    const into = (value, length) => {
      const inner = Math.min(margin, length / 2);
      return Math.min(Math.max(value, inner), length - inner) - value;
    };
    this.pan(into(x, width), into(y, height));
  }

  #keepInside() {
    const [width, height] = this.#box;
    const place = (offset, length, room) =>
      length <= room ? (room - length) / 2 : Math.min(Math.max(offset, room - length), 0);
    this.left = place(this.left, this.width * this.scale, width);
    this.top = place(this.top, this.height * this.scale, height);
  }

  paint(bitmap, marks) {
    const pen = this.canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1;
    // browsers lay a canvas on whole pixels of the screen, so nothing is stretched to its box
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    if (!bitmap) return;
    pen.imageSmoothingEnabled = this.scale < SMOOTH_BELOW;
    pen.drawImage(bitmap, this.left, this.top, this.width * this.scale, this.height * this.scale);
    for (const { kind, pixel } of marks) MARKS[kind](pen, ...this.toScreen(pixel));
  }
}

export function paintLoupe(canvas, bitmap, centre, marks) {
  const ratio = window.devicePixelRatio || 1;
  const side = canvas.clientWidth;
  canvas.width = canvas.height = Math.round(side * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, side, side);
  if (!bitmap || !centre) return;
  const span = side / LOUPE;
  const [left, top] = centre.map((value) => value + 0.5 - span / 2);
  pen.imageSmoothingEnabled = false;
  pen.drawImage(bitmap, -left * LOUPE, -top * LOUPE, bitmap.width * LOUPE, bitmap.height * LOUPE);
  for (const { kind, pixel: [u, v] } of marks) {
    MARKS[kind](pen, (u + 0.5 - left) * LOUPE, (v + 0.5 - top) * LOUPE);
  }
  const middle = side / 2;
  outlined(pen, "#fff", 1, () => {
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(middle + 6 * dx, middle + 6 * dy);
      pen.lineTo(middle + middle * dx, middle + middle * dy);
    }
  });
}

// A line that is seen on dark and on bright images alike.
function outlined(pen, color, width, draw) {
  for (const [style, extra] of [["rgb(0 0 0 / 75%)", 2], [color, 0]]) {
    pen.beginPath();
    pen.strokeStyle = style;
    pen.lineWidth = width + extra;
    draw();
    pen.stroke();
  }
}

const MARKS = {
  // four strokes that leave the tip itself open
  label(pen, x, y) {
    outlined(pen, "#fff", 1.5, () => {
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        pen.moveTo(x + 5 * dx, y + 5 * dy);
        pen.lineTo(x + 16 * dx, y + 16 * dy);
      }
    });
  },
  detection(pen, x, y) {
    for (const [color, radius] of [["#fff", 8.5], ["#000", 7]]) {
      pen.beginPath();
      pen.strokeStyle = color;
      pen.lineWidth = 1.5;
      pen.arc(x, y, radius, 0, 2 * Math.PI);
      pen.stroke();
    }
  },
  prediction(pen, x, y) {
    outlined(pen, "#3ddc84", 1.5, () => {
      for (const [dx, dy] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
        pen.moveTo(x + 3.5 * dx, y + 3.5 * dy);
        pen.lineTo(x + 11 * dx, y + 11 * dy);
      }
    });
  },
};
