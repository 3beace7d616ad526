// Images as decoded bitmaps: those that will be wanted next are fetched before they are.

const AT_ONCE = 3;
const BYTES = 160e6;

export class Images {
  #bitmaps = new Map(); // image -> ImageBitmap, least recently used first
  #loading = new Set();
  #failures = new Map(); // image -> why
  #wanted = [];
  #size;
  #changed;

  // changed(image) is called when an image has arrived or failed.
  constructor(size, changed) {
    this.#size = size;
    this.#changed = changed;
  }

  ready(image) {
    const bitmap = this.#bitmaps.get(image);
    if (bitmap) {
      this.#bitmaps.delete(image);
      this.#bitmaps.set(image, bitmap);
    }
    return bitmap;
  }

  failure(image) {
    return this.#failures.get(image);
  }

  // The first of these images is wanted now, the others soon, in this order.
  want(images) {
    this.#failures.delete(images[0]);
    this.#wanted = images;
    this.#fetch();
  }

  #fetch() {
    while (this.#loading.size < AT_ONCE) {
      const next = this.#wanted.find((image) =>
        !this.#bitmaps.has(image) && !this.#loading.has(image) && !this.#failures.has(image));
      if (next === undefined) return;
      this.#load(next);
    }
  }

  async #load(image) {
    this.#loading.add(image);
    try {
      const answer = await fetch(`image/${image}`);
      if (!answer.ok) throw new Error((await answer.json()).error);
      const parts = withoutExif(await answer.arrayBuffer());
      const bitmap = await createImageBitmap(new Blob(parts), { colorSpaceConversion: "none" });
      const [width, height] = this.#size;
      if (bitmap.width !== width || bitmap.height !== height) {
        throw new Error(`it measures ${bitmap.width}x${bitmap.height}, not ${width}x${height}`);
      }
      this.#bitmaps.set(image, bitmap);
      this.#forget();
    } catch (error) {
      this.#failures.set(image, error.message);
    }
    this.#loading.delete(image);
    this.#fetch();
    this.#changed(image);
  }

  #forget() {
    const [width, height] = this.#size;
    const limit = Math.max(8, Math.floor(BYTES / (4 * width * height)));
    for (const [image, bitmap] of this.#bitmaps) {
      if (this.#bitmaps.size <= limit) return;
      if (this.#wanted.includes(image)) continue;
      bitmap.close();
      this.#bitmaps.delete(image);
    }
  }
}

// The parts of a JPEG file but for its EXIF segments: browsers turn images as those say, whatever
// they are asked to do, and labels count pixels as they are stored.
function withoutExif(buffer) {
  const bytes = new DataView(buffer);
  const parts = [];
  let kept = 0; // start of the part that is kept
  let at = 2;
  if (bytes.byteLength < 4 || bytes.getUint16(0) !== 0xffd8) return [buffer];
  while (at + 4 <= bytes.byteLength && bytes.getUint8(at) === 0xff) {
    const marker = bytes.getUint8(at + 1);
    if (marker === 0xda) break; // the image itself
    const end = at + 2 + bytes.getUint16(at + 2);
    if (marker === 0xe1) {
      parts.push(buffer.slice(kept, at));
      kept = end;
    }
    at = end;
  }
  return [...parts, buffer.slice(kept)];
}
