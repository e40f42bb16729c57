// Colours and marks, the same on map, course and list, and figures as text.

const NAMES = ["tracking", "searching", "lost", "alone", "none", "truth", "wrong", "ink", "soft", "line",
  "paper", "shade", "strong", "good", "warn", "bad"];
let colours = {};

/** The colours of style.css as they are now, by name. */
export function colour(name) {
  return colours[name];
}

/** Reads the colours, and again whenever the scheme changes; then calls `changed`. */
export function watchColours(changed) {
  const read = () => {
    const style = getComputedStyle(document.documentElement);
    colours = Object.fromEntries(NAMES.map((n) => [n, style.getPropertyValue(`--${n}`).trim()]));
  };
  read();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { read(); changed(); });
}

export const MARKS = { tracking: "●", alone: "●", searching: "▲", lost: "✕", none: "–" };
export const SAID = { tracking: "tracking", alone: "fix", searching: "searching", lost: "lost", none: "no fix" };

/** Draws the mark of a state at a point; every state has a shape of its own. */
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
  } else if (size < 2.5) {
    context.fillRect(x - size, y - size, 2 * size, 2 * size); // too small to be seen as round
  } else {
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.fill();
  }
}

const KINDS = [...Object.keys(MARKS), "wrong", "ink"];

/** Of many thousand marks most lie on others that look the same: one in a small square is enough. */
export class Squares {
  constructor(width, height, side) {
    Object.assign(this, { side, across: Math.ceil(width / side) + 1 });
    this.last = new Uint8Array(this.across * (Math.ceil(height / side) + 1));
  }

  /** Whether the last mark in the square of a point was of this kind; it is from now on. */
  has(x, y, kind) {
    const square = Math.floor(y / this.side) * this.across + Math.floor(x / this.side);
    const code = KINDS.indexOf(kind) + 1;
    if (this.last[square] === code) return true;
    this.last[square] = code; // outside it is ignored
    return false;
  }
}

/** A length in metres with as many digits as say something. */
export function metres(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 10000) return `${(value / 1000).toFixed(1)} km`;
  return `${value.toFixed(size < 100 ? 1 : 0)} m`;
}

export const share = (part, whole) => (whole ? `${((100 * part) / whole).toFixed(1)} %` : "–");
export const number = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits) : "–");

/** Seconds as 1:02:03.4. */
export function clock(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  const sign = seconds < 0 ? "-" : "";
  const all = Math.abs(seconds);
  const [h, m, s] = [Math.floor(all / 3600), Math.floor(all / 60) % 60, (all % 60).toFixed(1)];
  const tail = s.padStart(4, "0");
  return h ? `${sign}${h}:${String(m).padStart(2, "0")}:${tail}` : `${sign}${m}:${tail}`;
}

/** The least usual step of an axis that is not below `value`: of seconds where `isTime`. */
export function stepOf(value, isTime) {
  const times = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200];
  const found = isTime && value > 0.5 ? times.find((step) => step >= value) : undefined;
  if (found) return found;
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= value * (1 - 1e-9));
}
