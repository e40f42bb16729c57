// The course along the route: probability above, how far the position may be off below.

const LEFT = 46;
const RIGHT = 12;

/** The least of 1, 2, 5 times a power of ten that is not below a value. */
function stepOf(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= value * (1 - 1e-9));
}

class Profile {
  constructor(box, slider) {
    Object.assign(this, { box, slider, index: -1 });
    this.length = route.distance_m.length;
    this.first = route.distance_m[0];
    this.span = route.distance_m[this.length - 1] - this.first;
    new ResizeObserver(() => this.#draw()).observe(box);
    for (const kind of ["pointermove", "pointerdown"]) {
      box.addEventListener(kind, (event) => this.#look(event, kind === "pointerdown"));
    }
    slider.addEventListener("input", () => lookAlong(Number(slider.value)));
    listeners.push(({ index }) => this.#point(index));
  }

  #look(event, said) {
    const x = event.clientX - this.box.getBoundingClientRect().left;
    const share = Math.min(Math.max((x - LEFT) / this.width, 0), 1);
    lookAlong(nearestAlong(this.first + share * this.span), said);
  }

  #x = (i) => LEFT + ((route.distance_m[i] - this.first) / this.span) * this.width;
  #at = (distance) => LEFT + ((distance - this.first) / this.span) * this.width;

  #draw() {
    const { clientWidth: width, clientHeight: height } = this.box;
    this.width = width - LEFT - RIGHT;
    if (this.width < 50) return;
    this.box.replaceChildren();
    const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, "aria-hidden": "true" }, this.box);
    this.svg = svg;
    this.above = { top: 8, bottom: Math.round(height * 0.52) };
    this.below = { top: this.above.bottom + 16, bottom: height - 40 };
    this.#blind(svg);
    this.#probability(svg);
    this.#drift(svg);
    this.#axes(svg, height);
    this.cursor = draw("g", { visibility: "hidden" }, svg);
    this.#point(this.index);
  }

  #blind(svg) {
    let free = 0; // up to here numbers are written
    for (const { number, start_m: start, end_m: end, bearable } of data.blind) {
      const [from, to] = [this.#at(start), this.#at(end)];
      const kind = bearable ? "blind" : "lost";
      draw("rect", { x: from, y: this.above.top, width: Math.max(to - from, 1), height: this.below.bottom - this.above.top, class: kind }, svg);
      const [middle, half] = [(from + to) / 2, 4 * String(number).length + 1];
      if (middle - half < free) continue;
      free = middle + half;
      draw("text", { x: middle, y: this.above.bottom + 13, "text-anchor": "middle", class: "number" }, svg).textContent = number;
    }
  }

  #probability(svg) {
    const { top, bottom } = this.above;
    const y = (v) => bottom - v * (bottom - top);
    this.yProbability = y;
    for (const v of [0, 0.5, 0.9, 1]) this.#line(svg, y(v), v === 0.9 ? "sure" : "grid", String(v));
    this.#area(svg, route.low, route.high, y);
    this.#path(svg, route.across_low, y, "low");
    this.#path(svg, route.probability, y, "line");
  }

  #drift(svg) {
    const { top, bottom } = this.below;
    const most = Math.max(1, ...[...route.drift_m, ...route.error_m].filter(known)) * 1.08;
    const y = (v) => bottom - (v / most) * (bottom - top);
    this.yDrift = y;
    const step = stepOf(most / 3);
    for (let v = 0; v <= most; v += step) this.#line(svg, y(v), "grid", `${v} m`);
    this.#path(svg, route.error_m, y, "error");
    this.#path(svg, route.drift_m, y, "drift");
  }

  #line(svg, y, kind, said) {
    draw("line", { x1: LEFT, x2: LEFT + this.width, y1: y, y2: y, class: kind }, svg);
    draw("text", { x: LEFT - 5, y: y + 4, "text-anchor": "end" }, svg).textContent = said;
  }

  /** Runs of points that are known: [first, last] of each. */
  #runs(...columns) {
    const runs = [];
    for (let i = 0; i < this.length; i++) {
      if (!columns.every((column) => known(column[i]))) continue;
      if (runs.length && runs[runs.length - 1][1] === i - 1) runs[runs.length - 1][1] = i;
      else runs.push([i, i]);
    }
    return runs;
  }

  #path(svg, values, y, kind) {
    let d = "";
    for (const [first, last] of this.#runs(values)) {
      for (let i = first; i <= last; i++) d += `${i === first ? "M" : "L"}${this.#x(i).toFixed(1)} ${y(values[i]).toFixed(1)}`;
    }
    draw("path", { d, class: kind }, svg);
  }

  #area(svg, low, high, y) {
    let d = "";
    for (const [first, last] of this.#runs(low, high)) {
      for (let i = first; i <= last; i++) d += `${i === first ? "M" : "L"}${this.#x(i).toFixed(1)} ${y(high[i]).toFixed(1)}`;
      for (let i = last; i >= first; i--) d += `L${this.#x(i).toFixed(1)} ${y(low[i]).toFixed(1)}`;
      d += "Z";
    }
    draw("path", { d, class: "area" }, svg);
  }

  #axes(svg, height) {
    const ticks = (step, unit, y, at, name) => {
      draw("text", { x: LEFT - 14, y, "text-anchor": "end" }, svg).textContent = name;
      for (let v = Math.ceil((this.first * unit) / step) * step; at(v) <= LEFT + this.width + 0.5; v += step) {
        draw("text", { x: at(v), y, "text-anchor": "middle" }, svg).textContent = String(Number(v.toPrecision(6)));
      }
    };
    const wanted = (this.span / this.width) * 90;
    ticks(stepOf(wanted / 1000), 1 / 1000, height - 22, (km) => this.#at(km * 1000), "km");
    const perMinute = 60 * data.speed_mps;
    ticks(stepOf(wanted / perMinute), 1 / perMinute, height - 6, (m) => this.#at(m * perMinute), "min");
  }

  #point(index) {
    this.index = index;
    if (!this.cursor) return;
    this.cursor.setAttribute("visibility", index < 0 ? "hidden" : "visible");
    if (index < 0) return;
    const x = this.#x(index);
    this.cursor.replaceChildren();
    draw("line", { x1: x, x2: x, y1: this.above.top, y2: this.below.bottom, class: "cursor" }, this.cursor);
    for (const [value, y] of [[route.probability[index], this.yProbability], [route.drift_m[index], this.yDrift]]) {
      if (known(value)) draw("circle", { cx: x, cy: y(value), r: 4, class: "dot" }, this.cursor);
    }
    this.slider.value = index;
    const far = `${(route.distance_m[index] / 1000).toFixed(2)} km, probability ${percent(route.probability[index])}`;
    this.slider.setAttribute("aria-valuetext", far);
  }
}
