// Charts of all pages: panels over one x axis on a canvas, and a cursor on a second canvas, which is
// redrawn alone. A subclass gives `range()` (first and last x), `paint(context)` and `drawCursor()`.

export const LEFT = 52;
const RIGHT = 10;
const FONT = "11px system-ui, sans-serif";
const MIN_SPAN = 1e-4;

export class Chart {
  /** `colour(name)` gives CSS colours; `pick(value, pressed)` is called for the pointer: while it is
      down, and where `hover` is set also when it passes. The wheel zooms where `zoom` is set. */
  constructor(box, { colour, pick, hover = false, zoom = false }) {
    Object.assign(this, { box, colour, from: 0, to: 1 }); // the visible part of the range
    [this.main, this.over] = box.querySelectorAll("canvas");
    this.#listen(pick, hover, zoom);
  }

  /** Draws now and whenever the size of the box changes. */
  start() {
    new ResizeObserver(() => this.draw()).observe(this.box);
  }

  #listen(pick, hover, zoom) {
    let down = false;
    const offset = (event) => event.clientX - this.box.getBoundingClientRect().left;
    this.box.addEventListener("pointerdown", (event) => {
      down = true;
      this.box.setPointerCapture(event.pointerId);
      pick(this.valueAt(offset(event)), true);
    });
    this.box.addEventListener("pointermove", (event) => {
      if (down || hover) pick(this.valueAt(offset(event)), down);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      this.box.addEventListener(name, () => { down = false; });
    }
    if (!zoom) return;
    this.box.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(event.deltaY < 0 ? 0.7 : 1 / 0.7, this.#share(this.valueAt(offset(event))));
    }, { passive: false });
  }

  /** Shows `factor` times as much of the range, about a place given as a share of it. */
  zoomBy(factor, about) {
    const span = Math.min((this.to - this.from) * factor, 1);
    if (span < MIN_SPAN) return;
    const share = Math.min(Math.max((about - this.from) / (this.to - this.from), 0), 1);
    this.from = Math.min(Math.max(about - share * span, 0), 1 - span);
    this.to = this.from + span;
    this.draw();
  }

  /** Moves the visible part until it holds a value; whether it had to. */
  reveal(value) {
    const [share, span] = [this.#share(value), this.to - this.from];
    if (span >= 1 || (share >= this.from && share <= this.to)) return false;
    this.from = Math.min(Math.max(share - span / 2, 0), 1 - span);
    this.to = this.from + span;
    this.draw();
    return true;
  }

  #share(value) {
    const [first, last] = this.range();
    return last > first ? (value - first) / (last - first) : 0.5;
  }

  /** The value at a distance in pixels from the left edge of the box. */
  valueAt(px) {
    const [first, last] = this.range();
    return first + (this.from + ((px - LEFT) / this.width) * (this.to - this.from)) * (last - first);
  }

  x(value) {
    return LEFT + ((this.#share(value) - this.from) / (this.to - this.from)) * this.width;
  }

  /** Places of many values, worked out with one scale. */
  xs(values) {
    const [first, last] = this.range();
    const start = this.x(first);
    const scale = last > first ? (this.x(last) - start) / (last - first) : 0;
    return Float64Array.from(values, (value) => start + (value - first) * scale);
  }

  get right() {
    return LEFT + this.width;
  }

  /** A cleared context of a canvas at the resolution of the screen. */
  cleared(canvas) {
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.box;
    const size = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = FONT;
    return context;
  }

  draw() {
    const context = this.cleared(this.main);
    this.width = this.box.clientWidth - LEFT - RIGHT;
    if (this.width < 20) return;
    this.paint(context);
    this.drawCursor();
  }

  /** Horizontal lines at values, each with its text in front where `text` gives one. */
  rules(context, values, y, stroke, { dash = [], text = null } = {}) {
    context.setLineDash(dash);
    [context.strokeStyle, context.lineWidth, context.textAlign] = [stroke, 1, "right"];
    for (const value of values) {
      const at = Math.round(y(value)) + 0.5;
      context.beginPath();
      context.moveTo(LEFT, at);
      context.lineTo(this.right, at);
      context.stroke();
      context.fillStyle = this.colour("soft");
      if (text) context.fillText(text(value), LEFT - 4, at + 4);
    }
    context.setLineDash([]);
  }

  /** A line through the known values; it has gaps where values are not finite numbers. */
  line(context, xs, values, y, stroke, { width = 2, dash = [] } = {}) {
    [context.strokeStyle, context.lineWidth] = [stroke, width];
    context.setLineDash(dash);
    context.beginPath();
    let drawing = false;
    for (let i = 0; i < xs.length; i++) {
      const known = values[i] !== null && Number.isFinite(values[i]);
      if (known && drawing) context.lineTo(xs[i], y(values[i]));
      else if (known) context.moveTo(xs[i], y(values[i]));
      drawing = known;
    }
    context.stroke();
    context.setLineDash([]);
  }

  /** The area between two columns, or below one (`low` null) down to the pixel `bottom`. */
  area(context, xs, low, high, y, fill, bottom) {
    const known = [];
    for (let i = 0; i < xs.length; i++) if (high[i] !== null && Number.isFinite(high[i])) known.push(i);
    if (!known.length) return;
    context.fillStyle = fill;
    context.beginPath();
    const at = (i) => Math.min(Math.max(xs[i], LEFT), this.right);
    for (const i of known) context.lineTo(at(i), Math.min(y(high[i]), bottom));
    for (const i of known.reverse()) context.lineTo(at(i), low ? y(low[i]) : bottom);
    context.fill();
  }

  /** A filled box from one x to another in pixels, cut at the edges of the chart. */
  span(context, from, to, top, height, fill) {
    const [left, right] = [Math.max(from, LEFT), Math.min(to, this.right)];
    if (right < left) return;
    context.fillStyle = fill;
    context.fillRect(left, top, Math.max(right - left, 1), height);
  }

  /** Text with a halo, readable on lines. */
  label(context, text, x, y, align = "left") {
    context.textAlign = align;
    [context.strokeStyle, context.lineWidth] = [this.colour("paper"), 3];
    context.strokeText(text, x, y);
    context.fillStyle = this.colour("soft");
    context.fillText(text, x, y);
  }

  /** Ticks along x at multiples of `step` in units of `unit`, with text at the pixel `y`. */
  ticks(context, step, unit, y, text) {
    const [low, high] = [this.valueAt(LEFT) / unit, this.valueAt(this.right) / unit];
    [context.fillStyle, context.textAlign] = [this.colour("soft"), "center"];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) {
      const x = this.x(k * step * unit);
      context.fillRect(x, y - 13, 1, 3);
      context.fillText(text(k * step), Math.min(Math.max(x, LEFT + 8), this.right - 14), y);
    }
  }

  /** A vertical line at a value on the cleared cursor canvas; its context, to add dots. */
  cursorAt(value, bottom) {
    const context = this.cleared(this.over);
    context.fillStyle = this.colour("strong");
    context.fillRect(this.x(value) - 1, 0, 2, bottom);
    return context;
  }
}

/** The least of 1, 2, 5 times a power of ten that is not below a value. */
export function roundStep(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= value * (1 - 1e-9));
}
