// The views of the run, the selected one, and the filter. Events: "select", "filter".

const NUMBERS = ["x", "y", "tx", "ty", "err", "conf", "radius", "level", "a", "b", "turn", "head", "agl", "ms",
  "gx", "gy", "gerr", "gdiff", "x2", "y2", "err2"];
export const CONFIDENT = 0.9;

export class Store extends EventTarget {
  /** `run` and `views`: the responses of api/run and api/views. */
  constructor(run, views) {
    super();
    this.run = run;
    this.which = "all";
    this.order = "time";
    this.named = "";
    this.selected = -1;
    this.count = views.columns.frame.length;
    this.columns = {};
    for (const [name, values] of Object.entries(views.columns)) {
      this.columns[name] = NUMBERS.includes(name) ? values.map((v) => v ?? NaN) : values;
    }
    this.health = views.health;
    this.reasons = new Map();
    this.shown = []; // indices in order of time
    this.listed = []; // the same in the order of the list
    this.isShown = [];
    this.rising = true;
    this.stats = { fixes: 0, confident: 0, wrong: 0, right: 0, withTruth: 0, withGnss: 0, gnssAlarms: 0 };
    for (let i = 0; i < this.count; i++) this.#count(i);
    this.#filter();
  }

  #count(i) {
    const c = this.columns;
    if (c.reason[i]) this.reasons.set(c.reason[i], (this.reasons.get(c.reason[i]) ?? 0) + 1);
    else this.stats.fixes += 1;
    this.stats.confident += c.confident[i];
    this.stats.wrong += c.wrong[i];
    this.stats.right += c.err[i] <= this.run.radius_m ? 1 : 0;
    this.stats.withTruth += Number.isNaN(c.tx[i]) ? 0 : 1;
    this.stats.withGnss += Number.isNaN(c.gx[i]) ? 0 : 1;
    if (c.gfault[i] && !(i && c.gfault[i - 1])) this.stats.gnssAlarms += 1;
    if (i && c.t[i] < c.t[i - 1]) this.rising = false;
  }

  /** The time of a view in seconds, or its number where times do not rise. */
  time(i) {
    return this.rising ? this.columns.t[i] : i;
  }

  /** The state of a view: searching, tracking, coasting, lost, alone (placed without a track) or none. */
  state(i) {
    if (this.columns.reason[i]) return "none";
    const state = this.columns.state[i];
    return state < 0 ? "alone" : this.run.states[state];
  }

  /** The class of a view that its colour shows: `confident`, `low` (a best guess) or `none` (no fix). */
  trust(i) {
    if (this.columns.reason[i]) return "none";
    return this.columns.confident[i] ? "confident" : "low";
  }

  select(i, by = "") {
    if (!this.count) return;
    const index = Math.min(Math.max(i, 0), this.count - 1);
    if (index === this.selected) return;
    this.selected = index;
    this.dispatchEvent(new CustomEvent("select", { detail: { by } }));
  }

  /** Selects the shown view `count` steps later in time, at most the last. */
  step(count) {
    if (!this.shown.length) return;
    let at = this.shown.findIndex((i) => i >= this.selected);
    if (at < 0) at = this.shown.length;
    if (count > 0 && this.shown[at] !== this.selected) at -= 1;
    const next = Math.min(Math.max(at + count, 0), this.shown.length - 1);
    this.select(this.shown[next], "step");
  }

  /** Selects the next (1) or previous (-1) view of the list. */
  stepList(count) {
    if (!this.listed.length) return;
    const at = this.listed.indexOf(this.selected);
    const next = at < 0 ? 0 : Math.min(Math.max(at + count, 0), this.listed.length - 1);
    this.select(this.listed[next], "list");
  }

  show({ which = this.which, order = this.order, named = this.named }) {
    Object.assign(this, { which, order, named });
    this.#filter();
    this.dispatchEvent(new Event("filter"));
  }

  #filter() {
    const keep = this.#rule();
    this.isShown = this.columns.frame.map((_, i) => keep(i));
    this.shown = [...this.isShown.keys()].filter((i) => this.isShown[i]);
    this.listed = this.#ordered();
  }

  #rule() {
    const c = this.columns;
    const [kind, value] = this.which.split(/:(.*)/s);
    const rules = {
      all: () => true,
      none: (i) => Boolean(c.reason[i]),
      wrong: (i) => c.wrong[i] === 1,
      far: (i) => c.err[i] > this.run.radius_m,
      confident: (i) => c.confident[i] === 1,
      doubt: (i) => this.trust(i) === "low",
      state: (i) => this.state(i) === value,
      reason: (i) => c.reason[i] === value,
    };
    const rule = rules[kind] ?? rules.all;
    const named = this.named.toLowerCase();
    return named ? (i) => rule(i) && c.frame[i].toLowerCase().includes(named) : rule;
  }

  #ordered() {
    if (this.order === "time") return this.shown;
    const c = this.columns;
    const key = { error: (i) => -c.err[i], doubt: (i) => c.conf[i], spread: (i) => -c.a[i] }[this.order];
    const values = this.shown.map((i) => [i, key(i)]);
    values.sort((p, q) => (Number.isNaN(p[1]) ? 1 : 0) - (Number.isNaN(q[1]) ? 1 : 0) || p[1] - q[1] || p[0] - q[0]);
    return values.map(([i]) => i);
  }
}
