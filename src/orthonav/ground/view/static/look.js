// Colours and marks, the same on map, course and list.

const COLOURS = ["confident", "low", "none", "truth", "wrong", "ink", "soft", "line",
  "paper", "shade", "strong", "good", "warn", "bad", "gnss", "second"];
let colours = {};

/** A colour of style.css, in the current scheme. */
export function colour(name) {
  return colours[name];
}

/** Reads the colours now and whenever the scheme changes; then calls `changed`. */
export function watchColours(changed) {
  const read = () => {
    const style = getComputedStyle(document.documentElement);
    colours = Object.fromEntries(COLOURS.map((n) => [n, style.getPropertyValue(`--${n}`).trim()]));
  };
  read();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { read(); changed(); });
}

export const MARKS = { tracking: "●", coasting: "○", alone: "●", searching: "▲", lost: "✕", none: "–" };
export const NAMES = {
  tracking: "tracking", coasting: "coasting", alone: "fix", searching: "searching", lost: "lost", none: "no fix",
};

export const TRUST = { confident: "confident", low: "low confidence", none: "no fix" };

/** State and confidence of a view in words. */
export function described(store, i) {
  const [state, trust] = [store.state(i), store.trust(i)];
  return trust === "none" || state === "alone" ? TRUST[trust] : `${NAMES[state]}, ${TRUST[trust]}`;
}

/** Draws the mark of a state at a point; each state has its own shape. */
export function drawMark(context, state, x, y, size) {
  if (state === "searching") {
    context.beginPath();
    context.moveTo(x, y - size * 1.2);
    context.lineTo(x + size * 1.1, y + size * 0.9);
    context.lineTo(x - size * 1.1, y + size * 0.9);
    context.fill();
  } else if (state === "lost") {
    context.lineWidth = Math.max(1.6, size * 0.6);
    context.beginPath();
    context.moveTo(x - size, y - size);
    context.lineTo(x + size, y + size);
    context.moveTo(x + size, y - size);
    context.lineTo(x - size, y + size);
    context.stroke();
  } else if (state === "coasting") {
    context.lineWidth = Math.max(1.2, size * 0.5);
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.stroke();
  } else if (size < 2.5) {
    context.fillRect(x - size, y - size, 2 * size, 2 * size); // too small to look round
  } else {
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.fill();
  }
}

const KINDS = [...Object.keys(TRUST), "wrong", "ink", "gnss", "second"];
const SHAPES = Object.keys(MARKS);

/** Of many thousand marks most cover equal ones: one in a small square is enough. */
export class Squares {
  constructor(width, height, side) {
    Object.assign(this, { side, across: Math.ceil(width / side) + 1 });
    this.last = new Uint8Array(this.across * (Math.ceil(height / side) + 1));
  }

  /** Whether the last mark in the square of a point was of this kind and shape; it is from now on. */
  has(x, y, kind, shape = "alone") {
    const square = Math.floor(y / this.side) * this.across + Math.floor(x / this.side);
    const code = SHAPES.indexOf(shape) * KINDS.length + KINDS.indexOf(kind) + 1;
    if (this.last[square] === code) return true;
    this.last[square] = code; // ignored outside
    return false;
  }
}
