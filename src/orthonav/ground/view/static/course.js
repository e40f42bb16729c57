// The run over time: error with the stated standard deviation, confidence, state, health. The slider
// below it does the same for keyboards and screen readers.

import { Chart, LEFT, roundStep } from "./chart.js";
import { clock, metres } from "./format.js";
import { Squares, colour } from "./look.js";
import { CONFIDENT } from "./store.js";

const MANY = 800;
const BAND = 9;
const GAP = 5;
const NAME = 14; // height of the line above a panel that names it
const HEIGHTS = { tracking: 1, alone: 1, searching: 0.75, coasting: 0.5, lost: 0.25, none: 0.15 };
const FLOOR_M = 0.1; // a log axis has no zero
const TIME_STEPS_S = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200];
const LEVELS = { OK: "good", DEGRADED: "warn", FAILED: "bad" };

export class Course extends Chart {
  constructor(store, box) {
    super(box, { colour, zoom: true, pick: (time) => store.select(this.#nearest(time), "chart") });
    this.store = store;
    this.start();
  }

  range() {
    const { store } = this;
    if (!store?.count) return [0, 1];
    return [store.time(0), store.time(store.count - 1)];
  }

  /** Shows `factor` times as much time, about the selected view. */
  zoom(factor) {
    const [first, last] = this.range();
    const { selected } = this.store;
    this.zoomBy(factor, last > first ? (this.store.time(selected) - first) / (last - first) : 0.5);
  }

  /** The shown view nearest to a time. */
  #nearest(time) {
    const { shown } = this.store;
    let [low, high] = [0, shown.length - 1];
    if (high < 0) return this.store.selected;
    const off = (k) => this.store.time(shown[k]) - time;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (off(middle) < 0) low = middle;
      else high = middle;
    }
    return Math.abs(off(low)) <= Math.abs(off(high)) ? shown[low] : shown[high];
  }

  paint(context) {
    const { store } = this;
    if (!store.count) return;
    const times = store.rising ? store.columns.t : Array.from({ length: store.count }, (_, i) => i);
    this.places = this.xs(times);
    const bands = store.health.length ? 2 : 1;
    this.#alarms(context);
    const ground = this.box.clientHeight - 16 - bands * (BAND + 2) - GAP;
    const split = NAME + Math.round((ground - 2 * NAME - GAP) * 0.62);
    this.#errors(context, NAME, split);
    this.#confidence(context, split + GAP + NAME, ground);
    this.#states(context, ground + GAP);
    if (bands > 1) this.#health(context, ground + GAP + BAND + 2);
    this.#axis(context);
  }

  /** A point for every view that has a value; views that are filtered out are faint. */
  #points(context, values, y, kindOf) {
    const { count, isShown } = this.store;
    const side = count > MANY ? 2.6 : 4;
    for (const shown of [false, true]) {
      const drawn = new Squares(this.box.clientWidth, this.box.clientHeight, 1);
      context.globalAlpha = shown ? 1 : 0.15;
      let last = "";
      for (let i = 0; i < count; i++) {
        const x = this.places[i];
        if (isShown[i] !== shown || !(values[i] >= 0) || x < LEFT - 2 || x > this.right + 2) continue;
        const [at, kind] = [y(values[i]), kindOf(i)];
        if (drawn.has(x, at, kind)) continue;
        if (kind !== last) context.fillStyle = colour(kind);
        last = kind;
        context.fillRect(x - side / 2, at - side / 2, side, side);
      }
    }
    context.globalAlpha = 1;
  }

  /** Shades the views with a fault of GNSS. */
  #alarms(context) {
    const { count, columns } = this.store;
    context.globalAlpha = 0.18;
    for (let from = 0, i = 1; i <= count; i++) {
      if (i < count && columns.gfault[i] === columns.gfault[from]) continue;
      const until = i < count ? this.places[i] : this.places[i - 1] + 2;
      if (columns.gfault[from]) this.span(context, this.places[from], until, 0, this.box.clientHeight, colour("gnss"));
      from = i;
    }
    context.globalAlpha = 1;
  }

  #errors(context, top, bottom) {
    const c = this.store.columns;
    const { withTruth, withGnss } = this.store.stats;
    const gnss = withTruth ? c.gerr : c.gdiff;
    let [low, high] = [this.store.run.radius_m / 10, this.store.run.radius_m * 2];
    for (const values of withTruth ? [c.err, c.a, gnss, c.err2 ?? []] : [c.a, gnss]) {
      for (const v of values) {
        if (v > 0) [low, high] = [Math.min(low, Math.max(v, FLOOR_M)), Math.max(high, v)];
      }
    }
    [low, high] = [Math.log(low), Math.log(high * 1.2)];
    const share = (v) => (Math.log(Math.max(v, FLOOR_M)) - low) / (high - low);
    const y = (v) => bottom - Math.max(share(v), 0) * (bottom - top);
    this.rules(context, [this.store.run.radius_m], y, colour("wrong"));
    const decades = [0.1, 1, 10, 100, 1000, 10000].filter((v) => share(v) >= 0 && share(v) <= 1);
    const close = y(1) - y(10) < NAME; // texts would touch
    this.rules(context, decades, y, colour("line"), { text: (v) => (close && Math.log10(v) % 2 ? "" : metres(v)) });
    const positive = c.a.map((v) => (v > 0 ? v : NaN));
    this.area(context, this.places, null, positive, y, colour("shade"), bottom);
    if (withGnss) this.#points(context, gnss, (v) => Math.max(y(v), top), () => "gnss");
    if (c.err2) this.#points(context, c.err2, (v) => Math.max(y(v), top), () => "second");
    this.#points(context, c.err, (v) => Math.max(y(v), top), (i) => (c.wrong[i] ? "wrong" : this.store.trust(i)));
    const text = withTruth ? `error; shaded: stated 1 σ; line: ${metres(this.store.run.radius_m)}` : "stated 1 σ";
    const more = withTruth ? "; green: error of GNSS" : "; green: GNSS from the map";
    this.label(context, withGnss ? text + more : text, LEFT + 5, top - 4);
  }

  #confidence(context, top, bottom) {
    const y = (v) => bottom - v * (bottom - top);
    this.rules(context, [0, 1], y, colour("line"));
    this.rules(context, [CONFIDENT], y, colour("soft"), { dash: [4, 3], text: String });
    this.#points(context, this.store.columns.conf, y, (i) => this.store.trust(i));
    this.label(context, "confidence", LEFT + 5, top - 4);
  }

  #states(context, top) {
    this.label(context, "state", 2, top + BAND);
    const { store, places } = this;
    for (let from = 0, i = 1; i <= store.count; i++) {
      const [state, trust] = [store.state(from), store.trust(from)];
      if (i < store.count && store.state(i) === state && store.trust(i) === trust) continue;
      const end = i < store.count ? places[i] : places[i - 1] + 2;
      this.#bar(context, places[from], end, top, trust, BAND * HEIGHTS[state]);
      from = i;
    }
  }

  /** A part of a band; its height differs too, so that colour is not the only mark. */
  #bar(context, from, until, top, name, height) {
    this.span(context, from, until, top + BAND - height, height, colour(name));
  }

  #health(context, top) {
    this.label(context, "health", 2, top + BAND);
    const { health, count } = this.store;
    const place = (line) => this.places[Math.min(line.view, count - 1)];
    for (let from = 0, k = 1; k <= health.length; k++) {
      if (k < health.length && health[k].level === health[from].level) continue;
      const name = LEVELS[health[from].level] ?? "soft";
      const height = { good: BAND / 3, warn: (2 * BAND) / 3 }[name] ?? BAND;
      const until = k < health.length ? place(health[k]) : this.right;
      this.#bar(context, place(health[from]), until, top, name, height);
      from = k;
    }
  }

  #axis(context) {
    const { rising } = this.store;
    const wanted = ((this.valueAt(this.right) - this.valueAt(LEFT)) / this.width) * 80;
    if (!(wanted > 0)) return;
    const seconds = rising && wanted > 0.5 ? TIME_STEPS_S.find((step) => step >= wanted) : undefined;
    const text = (v) => (rising ? clock(v).replace(/\.0$/, "") : String(Math.round(v) + 1));
    this.ticks(context, seconds ?? roundStep(wanted), 1, this.box.clientHeight - 1, text);
  }

  /** The selected view; the rest is not drawn again. */
  drawCursor() {
    const { selected, count } = this.store;
    if (selected < 0 || !count || !this.width) this.cleared(this.over);
    else if (!this.reveal(this.store.time(selected))) {
      this.cursorAt(this.store.time(selected), this.box.clientHeight - 14);
    }
  }
}
