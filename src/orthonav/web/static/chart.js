// The course of the run: error beside what the fixes say of themselves, confidence, state, health,
// over time. The slider below it is the same for keyboards and screen readers.

import { Squares, clock, colour, metres, stepOf } from "./look.js";
import { CONFIDENT } from "./store.js";

const LEFT = 52;
const MANY = 800;
const BAND = 9;
const GAP = 5;
const FLOOR_M = 0.1; // a log axis has no zero
const LEVELS = { OK: "good", DEGRADED: "warn", FAILED: "bad" };

export class Chart {
  constructor(store, box) {
    this.store = store;
    this.box = box;
    [this.all, this.now] = box.querySelectorAll("canvas");
    this.from = 0; // the part of the time that is seen
    this.to = 1;
    new ResizeObserver(() => this.draw()).observe(box);
    this.#listen();
  }

  #listen() {
    let down = false;
    const choose = (event) => {
      const { left } = this.box.getBoundingClientRect();
      this.store.select(this.#nearest(event.clientX - left), "chart");
    };
    this.box.addEventListener("pointerdown", (event) => {
      down = true;
      this.box.setPointerCapture(event.pointerId);
      choose(event);
    });
    this.box.addEventListener("pointermove", (event) => { if (down) choose(event); });
    for (const name of ["pointerup", "pointercancel"]) {
      this.box.addEventListener(name, () => { down = false; });
    }
    this.box.addEventListener("wheel", (event) => {
      event.preventDefault();
      const { left } = this.box.getBoundingClientRect();
      const about = this.from + ((event.clientX - left - LEFT) / this.width) * (this.to - this.from);
      this.zoom(event.deltaY < 0 ? 0.7 : 1 / 0.7, about);
    }, { passive: false });
  }

  /** Shows `factor` times as much time, about a place (0 to 1 of the run) or the selected view. */
  zoom(factor, about = this.#place(this.store.selected)) {
    const span = Math.min((this.to - this.from) * factor, 1);
    if (span < 1e-4) return;
    const share = (about - this.from) / (this.to - this.from);
    const from = Math.min(Math.max(about - Math.min(Math.max(share, 0), 1) * span, 0), 1 - span);
    [this.from, this.to] = [from, from + span];
    this.draw();
  }

  /** Where a view lies, 0 to 1 of the time of the run. */
  #place(i) {
    const { store } = this;
    const [first, last] = [store.time(0), store.time(store.count - 1)];
    return last > first ? (store.time(i) - first) / (last - first) : 0.5;
  }

  #x(i) {
    return LEFT + ((this.#place(i) - this.from) / (this.to - this.from)) * this.width;
  }

  /** The same for all views, worked out once for a drawing. */
  #allX() {
    const { store } = this;
    const values = store.rising ? store.columns.t : null;
    const first = store.time(0);
    const per = this.#x(store.count - 1) - this.#x(0);
    const [span, left] = [store.time(store.count - 1) - first, this.#x(0)];
    const xs = new Float64Array(store.count);
    for (let i = 0; i < xs.length; i++) {
      xs[i] = span > 0 ? left + (((values ? values[i] : i) - first) / span) * per : left;
    }
    return xs;
  }

  /** The shown view nearest to a place on the screen. */
  #nearest(x) {
    const { shown } = this.store;
    let [low, high] = [0, shown.length - 1];
    if (high < 0) return this.store.selected;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.#x(shown[middle]) < x) low = middle;
      else high = middle;
    }
    return Math.abs(this.#x(shown[low]) - x) <= Math.abs(this.#x(shown[high]) - x) ? shown[low] : shown[high];
  }

  #canvas(canvas) {
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.box;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "11px system-ui, sans-serif";
    return context;
  }

  draw() {
    const { store } = this;
    const context = this.#canvas(this.all);
    this.width = this.box.clientWidth - LEFT - 8;
    if (!store.count || this.width < 20) return;
    this.xs = this.#allX();
    const bands = store.health.length ? 2 : 1;
    const ground = this.box.clientHeight - 16 - bands * (BAND + 2) - GAP;
    const split = Math.round(ground * 0.62);
    this.#errors(context, 4, split);
    this.#confidence(context, split + GAP + 4, ground);
    this.#states(context, ground + GAP);
    if (bands > 1) this.#health(context, ground + GAP + BAND + 2);
    this.#axis(context);
    this.drawNow();
  }

  /** A point for every view that has a value, those that are not shown first, and faint. */
  #points(context, values, y, kindOf) {
    const { count, isShown } = this.store;
    const side = count > MANY ? 2.6 : 4;
    for (const shown of [false, true]) {
      const drawn = new Squares(this.box.clientWidth, this.box.clientHeight, 1);
      context.globalAlpha = shown ? 1 : 0.15;
      let last = "";
      for (let i = 0; i < count; i++) {
        const x = this.xs[i];
        if (isShown[i] !== shown || !(values[i] >= 0) || x < LEFT - 2 || x > LEFT + this.width + 2) continue;
        const [at, kind] = [y(values[i]), kindOf(i)];
        if (drawn.has(x, at, kind)) continue;
        if (kind !== last) context.fillStyle = colour(kind);
        last = kind;
        context.fillRect(x - side / 2, at - side / 2, side, side);
      }
    }
    context.globalAlpha = 1;
  }

  #errors(context, top, bottom) {
    const c = this.store.columns;
    const withTruth = this.store.stats.withTruth > 0;
    let [low, high] = [this.store.run.radius_m / 10, this.store.run.radius_m * 2];
    for (const values of withTruth ? [c.err, c.a] : [c.a]) {
      for (const v of values) {
        if (v > 0) [low, high] = [Math.min(low, Math.max(v, FLOOR_M)), Math.max(high, v)];
      }
    }
    [low, high] = [Math.log(low), Math.log(high * 1.2)];
    const share = (v) => (Math.log(Math.max(v, FLOOR_M)) - low) / (high - low);
    const y = (v) => bottom - Math.max(share(v), 0) * (bottom - top);
    this.#lines(context, [this.store.run.radius_m], y, colour("wrong"), []);
    this.#lines(context, [0.1, 1, 10, 100, 1000, 10000].filter((v) => share(v) >= 0 && share(v) <= 1),
      y, colour("line"), [], metres);
    this.#area(context, c.a, y, bottom);
    this.#points(context, c.err, (v) => Math.max(y(v), top), (i) => (c.wrong[i] ? "wrong" : "ink"));
    this.#label(context, withTruth ? "error; shaded: 1 σ as stated" : "1 σ as stated", top + 10, LEFT + 5);
  }

  /** What the fixes say of themselves, one standard deviation, as a shade below a line. */
  #area(context, values, y, bottom) {
    context.fillStyle = colour("shade");
    context.beginPath();
    let last = NaN;
    for (let i = 0; i < values.length; i++) {
      if (!(values[i] > 0)) continue;
      const x = Math.min(Math.max(this.xs[i], LEFT), LEFT + this.width);
      if (Number.isNaN(last)) context.moveTo(x, bottom);
      context.lineTo(x, Math.min(y(values[i]), bottom));
      last = x;
    }
    context.lineTo(last, bottom);
    context.fill();
  }

  #confidence(context, top, bottom) {
    const c = this.store.columns;
    const y = (v) => bottom - v * (bottom - top);
    this.#lines(context, [0, 1], y, colour("line"), []);
    this.#lines(context, [CONFIDENT], y, colour("soft"), [4, 3], () => "0.9");
    this.#points(context, c.conf, y, (i) => this.store.state(i));
    this.#label(context, "confidence", bottom - 3, LEFT + 5);
  }

  #states(context, top) {
    this.#label(context, "state", top + BAND);
    const { store } = this;
    for (let from = 0, i = 1; i <= store.count; i++) {
      const state = store.state(from);
      if (i < store.count && store.state(i) === state) continue;
      const end = i < store.count ? this.#x(i) : this.#x(i - 1) + 2;
      this.#bar(context, this.#x(from), end, top, state, state === "none" ? BAND / 3 : BAND);
      from = i;
    }
  }

  /** A piece of a band between two places, of a height of its own so that not only colour tells. */
  #bar(context, from, until, top, name, height) {
    const [left, right] = [Math.max(from, LEFT), Math.min(until, LEFT + this.width)];
    if (right < left) return;
    context.fillStyle = colour(name);
    context.fillRect(left, top + BAND - height, Math.max(right - left, 1), height);
  }

  #health(context, top) {
    this.#label(context, "health", top + BAND);
    const { health, count } = this.store;
    const place = (line) => this.#x(Math.min(line.view, count - 1));
    for (let from = 0, k = 1; k <= health.length; k++) {
      if (k < health.length && health[k].level === health[from].level) continue;
      const name = LEVELS[health[from].level] ?? "soft";
      const height = { good: BAND / 3, warn: (2 * BAND) / 3 }[name] ?? BAND;
      const until = k < health.length ? place(health[k]) : LEFT + this.width;
      this.#bar(context, place(health[from]), until, top, name, height);
      from = k;
    }
  }

  #lines(context, values, y, stroke, dash, said = null) {
    context.setLineDash(dash);
    [context.strokeStyle, context.lineWidth, context.textAlign] = [stroke, 1, "right"];
    for (const v of values) {
      const at = Math.round(y(v)) + 0.5;
      context.beginPath();
      context.moveTo(LEFT, at);
      context.lineTo(LEFT + this.width, at);
      context.stroke();
      context.fillStyle = colour("soft");
      if (said) context.fillText(said(v).replace(".0 m", " m"), LEFT - 4, at + 4);
    }
    context.setLineDash([]);
  }

  #label(context, text, y, x = 2) {
    context.textAlign = "left";
    [context.strokeStyle, context.lineWidth] = [colour("paper"), 3];
    context.strokeText(text, x, y);
    context.fillStyle = colour("soft");
    context.fillText(text, x, y);
  }

  #axis(context) {
    const { store } = this;
    const [first, last] = [store.time(0), store.time(store.count - 1)];
    const span = (last - first) * (this.to - this.from);
    if (!(span > 0)) return;
    const step = stepOf((span / this.width) * 80, store.rising);
    const begin = first + (last - first) * this.from;
    [context.fillStyle, context.textAlign] = [colour("soft"), "center"];
    for (let v = Math.ceil(begin / step) * step; v <= begin + span; v += step) {
      const x = LEFT + ((v - begin) / span) * this.width;
      context.fillRect(x, this.box.clientHeight - 14, 1, 3);
      const said = store.rising ? clock(v).replace(/\.0$/, "") : String(Math.round(v) + 1);
      context.fillText(said, Math.min(Math.max(x, LEFT + 8), LEFT + this.width - 14), this.box.clientHeight - 1);
    }
  }

  /** The selected view; the rest is not drawn again. */
  drawNow() {
    const context = this.#canvas(this.now);
    const i = this.store.selected;
    if (i < 0 || !this.width) return;
    const span = this.to - this.from;
    const place = this.#place(i);
    if (span < 1 && (place < this.from || place > this.to)) {
      this.from = Math.min(Math.max(place - span / 2, 0), 1 - span);
      this.to = this.from + span;
      this.draw();
      return;
    }
    context.fillStyle = colour("strong");
    context.fillRect(this.#x(i) - 1, 0, 2, this.box.clientHeight - 14);
  }
}
