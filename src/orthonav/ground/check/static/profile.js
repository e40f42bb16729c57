// The profile along the route: probability above, protection level below.

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const COLOURS = { strong: "ink", mark: "mark", soft: "soft", line: "line", paper: "paper" };

class Profile extends Chart {
  constructor(box, slider) {
    super(box, {
      colour: (name) => css(COLOURS[name]),
      hover: true,
      pick: (distance, pressed) => selectAlong(nearestAlong(distance), pressed),
    });
    Object.assign(this, { slider, index: -1 });
    slider.addEventListener("input", () => selectAlong(Number(slider.value)));
    listeners.push(({ index }) => { this.index = index; this.drawCursor(); });
    for (const look of ["(prefers-color-scheme: dark)", "print"]) {
      matchMedia(look).addEventListener("change", () => this.draw());
    }
    this.start();
  }

  range() {
    return [route.distance_m[0], route.distance_m.at(-1)];
  }

  paint(context) {
    const height = this.box.clientHeight;
    const split = Math.round(height * 0.52);
    const [top, bottom] = [split + 16, height - 40];
    const xs = this.xs(route.distance_m);
    this.#outages(context, split, bottom);
    this.probabilityY = (v) => split - v * (split - 8);
    this.rules(context, [0, 0.5, 1], this.probabilityY, this.colour("line"), { text: String });
    this.rules(context, [RISKS[0].least], this.probabilityY, this.colour("soft"), { text: String, dash: [5, 4] });
    this.area(context, xs, route.low, route.high, this.probabilityY, "rgb(0 114 178 / 22%)", split);
    this.line(context, xs, route.across_low, this.probabilityY, this.colour("soft"), { width: 1 });
    this.line(context, xs, route.probability, this.probabilityY, this.colour("mark"));
    const limit = data.conditions.alert_limit_m;
    const highest = Math.max(...route.protection_high_m.filter(known), 0);
    // The limit stays visible, and every median that is finite.
    const most = Math.max(1.6 * limit, Math.min(1.08 * highest, 4 * limit), 1.1 * Math.max(...route.protection_m.filter(known), 0));
    this.levelY = (v) => bottom - (Math.min(v, most) / most) * (bottom - top);
    const step = roundStep(most / 3);
    const levels = Array.from({ length: Math.floor(most / step) + 1 }, (_, k) => k * step);
    this.rules(context, levels, this.levelY, this.colour("line"), { text: (v) => `${v} m` });
    const [middle, high] = [route.protection_m, route.protection_high_m].map(
      (column) => column.map((v) => v ?? Number.MAX_VALUE), // infinite: along the upper edge
    );
    this.area(context, xs, middle, high, this.levelY, "rgb(213 94 0 / 22%)", bottom);
    this.rules(context, [limit], this.levelY, this.colour("strong"), { dash: [5, 3] });
    this.line(context, xs, middle, this.levelY, "#d55e00");
    this.label(context, `alert limit ${metres(limit)}`, this.right - 4, this.levelY(limit) - 5, "right");
    this.#axes(context, height);
  }

  #outages(context, split, bottom) {
    let free = 0; // numbers are written up to here
    for (const { number: name, start_m: start, end_m: end } of data.stretches) {
      const [from, to] = [this.x(start), this.x(end)];
      this.span(context, from, to, 8, bottom - 8, "rgb(128 128 128 / 28%)");
      const [middle, half] = [(from + to) / 2, 4 * String(name).length + 1];
      if (middle - half < free) continue;
      free = middle + half;
      this.label(context, String(name), middle, split + 13, "center");
    }
  }

  #axes(context, height) {
    const [first, last] = this.range();
    const wanted = ((last - first) / this.width) * 90;
    const perMinute = 60 * data.conditions.speed_mps;
    for (const [name, unit, y] of [["km", 1000, height - 22], ["min", perMinute, height - 6]]) {
      this.label(context, name, LEFT - 14, y, "right");
      if (wanted > 0) this.ticks(context, roundStep(wanted / unit), unit, y, (v) => String(Number(v.toPrecision(6))));
    }
  }

  drawCursor() {
    if (this.index < 0 || !this.probabilityY) {
      this.cleared(this.over);
      return;
    }
    const { index } = this;
    const context = this.cursorAt(route.distance_m[index], this.box.clientHeight - 40);
    for (const [value, y] of [[route.probability[index], this.probabilityY], [route.protection_m[index], this.levelY]]) {
      if (!known(value)) continue;
      context.beginPath();
      context.arc(this.x(route.distance_m[index]), y(value), 4, 0, 2 * Math.PI);
      context.fill();
    }
    this.slider.value = index;
    const far = `${(route.distance_m[index] / 1000).toFixed(2)} km, probability ${percent(route.probability[index])}`;
    this.slider.setAttribute("aria-valuetext", far);
  }
}
