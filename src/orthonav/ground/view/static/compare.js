// The selected view beside the map at its fix and at its true position, and overlaid on both to
// compare by eye: faded, or blinking; rectified, or as its camera saw it.

import { getJson, mapUrl, rawUrl, viewUrl } from "./api.js";
import { L, at } from "./map.js";
import { clock, metres, number } from "./format.js";
import { described } from "./look.js";

const BLINK_MS = 600; // slower than three flashes a second
const WAIT_MS = 90; // while stepping fast, images are not requested

export class Compare {
  constructor(map, store, root) {
    Object.assign(this, { map, store });
    this.find = (id) => root.getElementById(id);
    map.createPane("views").style.zIndex = 350; // above tiles, below marks
    this.over = null;
    this.visible = true;
    this.asked = 0;
    this.find("opacity").addEventListener("input", () => this.#fade());
    this.find("on-map").addEventListener("change", () => this.#fade());
    this.find("blink").addEventListener("click", () => this.blink());
    this.find("enlarge").addEventListener("click", () => this.enlarge());
    this.find("perspective").addEventListener("click", () => this.perspective());
    this.find("copy").addEventListener("click", () => this.#copy());
  }

  /** Makes images and map of the selected view larger, or as large as before. */
  enlarge() {
    const on = this.find("enlarge").getAttribute("aria-pressed") !== "true";
    this.find("enlarge").setAttribute("aria-pressed", String(on));
    this.find("main").classList.toggle("enlarged", on);
    this.map.invalidateSize();
  }

  /** Shows the view as recorded beside the map as seen from the fix, or both rectified. */
  perspective() {
    const on = this.find("perspective").getAttribute("aria-pressed") !== "true";
    this.find("perspective").setAttribute("aria-pressed", String(on));
    this.show();
  }

  /** Copies the coordinates of the fix. */
  async #copy() {
    let said = this.copied;
    try {
      await navigator.clipboard.writeText(said);
      said = `Copied: ${said}`;
    } catch { // not allowed: they are shown to be copied by hand
    }
    this.find("ground").textContent = said;
  }

  #offer(text) {
    this.copied = text;
    this.find("copy").hidden = !text;
  }

  /** Shows the selected view. */
  show() {
    const i = this.store.selected;
    if (i < 0) return;
    this.find("chosen-name").textContent = `${i + 1} of ${this.store.count}: ${this.store.columns.frame[i]}`;
    clearTimeout(this.timer);
    const soon = performance.now() - (this.changed ?? 0) < 250;
    this.changed = performance.now();
    this.timer = setTimeout(() => this.#load(i), soon ? WAIT_MS : 0);
  }

  async #load(i) {
    const asked = ++this.asked;
    let detail;
    try {
      detail = await getJson(`api/views/${i}`);
    } catch (error) {
      detail = { why_no_window: error.message };
    }
    if (asked !== this.asked) return; // another was selected meanwhile
    this.detail = detail;
    this.#offer("lat_deg" in detail ? place(detail.lat_deg, detail.lon_deg) : "");
    this.#pictures(i, detail);
    this.#known(detail);
  }

  #pictures(i, detail) {
    this.find("ground").textContent = "";
    const { columns: c } = this.store;
    const { window } = detail;
    const [placed, taken] = [Number.isFinite(c.x[i]), Number.isFinite(c.tx[i])];
    this.find("compare").hidden = !window;
    this.find("no-compare").hidden = Boolean(window);
    this.find("overlay").hidden = !window || !(placed || taken);
    this.over?.remove();
    this.over = null;
    if (!window) {
      this.find("no-compare").querySelector("p").textContent = `Cannot be rectified: ${detail.why_no_window}.`;
      this.#raw(i, detail);
      return;
    }
    const name = c.frame[i];
    const seen = placed && this.find("perspective").getAttribute("aria-pressed") === "true";
    this.find("compare").classList.toggle("perspective", seen);
    const [url, how, where, at] = seen ? [rawUrl, "as recorded", "seen from the fix", "in-view"]
      : [viewUrl, "rectified, north up", "at the fix", "fix"];
    this.#image("img-view", url(i), `View ${name}, ${how}`, `view, ${how}`);
    this.find("figure-fix").hidden = !placed;
    // Near the fix it would show the same.
    const apart = taken && !seen && !(c.err[i] <= this.store.run.radius_m);
    this.find("figure-truth").hidden = !apart;
    if (placed) {
      this.#image("img-fix", mapUrl(i, at), `Map ${where}`, `map ${where}`);
      this.#image("img-over", url(i), "");
    }
    if (apart) this.#image("img-truth", mapUrl(i, "truth"), "Map at the true position");
    this.#crosses(i, window);
    this.#layOver(placed ? [c.x[i], c.y[i]] : [c.tx[i], c.ty[i]], window, viewUrl(i), placed || taken);
  }

  #image(id, url, alt, caption) {
    const image = this.find(id);
    if (caption) image.parentElement.querySelector("figcaption").textContent = caption;
    image.alt = alt;
    image.src = url;
  }

  /** The image as recorded, where it cannot be rectified. */
  #raw(i, detail) {
    const image = this.find("img-raw");
    image.hidden = !("telemetry" in detail);
    if (image.hidden) return;
    image.onerror = () => { image.hidden = true; };
    image.alt = "The view as recorded";
    image.src = rawUrl(i);
  }

  /** Marks the points below the camera, which a tilt moves off the middle. */
  #crosses(i, window) {
    const { columns: c, run } = this.store;
    const [east, north] = window.offset_en_m.map((value) => value / window.side_m);
    const pixels = window.side_m / run.sheet.gsd_m;
    const [right, down] = [(c.tx[i] - c.x[i]) / pixels, (c.ty[i] - c.y[i]) / pixels];
    this.#cross("put", 0.5 - east, 0.5 + north);
    this.#cross("ring", 0.5 - east + right, 0.5 + north + down);
    this.#cross("taken", 0.5 - east, 0.5 + north);
  }

  /** Puts a mark at a position of its image, given as shares of its side. */
  #cross(id, x, y) {
    const cross = this.find(id);
    cross.hidden = !(x > 0 && x < 1 && y > 0 && y < 1);
    cross.style.left = `${100 * x}%`;
    // The image is square and as wide as its figure; the caption below it is not counted.
    cross.style.top = `${100 * y}cqw`;
  }

  #layOver([x, y], window, url, known) {
    if (!known) return;
    const { gsd_m: gsd } = this.store.run.sheet;
    const [col, row] = [x + window.offset_en_m[0] / gsd, y - window.offset_en_m[1] / gsd];
    const half = window.side_m / gsd / 2;
    const bounds = L.latLngBounds(at(col - half, row - half), at(col + half, row + half));
    this.over = L.imageOverlay(url, bounds, { pane: "views", alt: "" });
    this.#fade();
  }

  #fade() {
    const share = this.visible ? this.find("opacity").value / 100 : 0;
    this.find("img-over").style.opacity = share;
    this.find("opacity").setAttribute("aria-valuetext", `${this.find("opacity").value} percent`);
    if (!this.over) return;
    if (this.find("on-map").checked) this.over.addTo(this.map).setOpacity(share);
    else this.over.remove();
  }

  /** Changes the opacity of the overlay by some percent. */
  fadeBy(percent) {
    this.find("opacity").value = Number(this.find("opacity").value) + percent;
    this.#fade();
  }

  /** Overlays the view on the large map, or removes it. */
  toggleOnMap() {
    this.find("on-map").click();
  }

  /** Starts or stops blinking. */
  blink() {
    const button = this.find("blink");
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    clearInterval(this.blinking);
    this.visible = true;
    if (on) {
      if (this.find("opacity").value < 60) this.find("opacity").value = 100;
      this.blinking = setInterval(() => { this.visible = !this.visible; this.#fade(); }, BLINK_MS);
    }
    this.#fade();
  }

  /** Moves the map to the selected view, closely. */
  zoomTo() {
    const { columns: c, selected: i, run } = this.store;
    const side = this.detail?.window?.side_m ?? 400;
    const place = Number.isFinite(c.x[i]) ? [c.x[i], c.y[i]] : [c.tx[i], c.ty[i]];
    if (!place.every(Number.isFinite)) return;
    const half = (0.75 * side) / run.sheet.gsd_m;
    this.map.fitBounds(L.latLngBounds(at(place[0] - half, place[1] - half), at(place[0] + half, place[1] + half)));
  }

  #known(detail) {
    const rows = [["time", detail.time_s && `${detail.time_s} s`], ["state", detail.state]];
    if ("lat_deg" in detail) rows.push(["position", place(detail.lat_deg, detail.lon_deg)]);
    if ("true_lat_deg" in detail) rows.push(["true position", place(detail.true_lat_deg, detail.true_lon_deg)]);
    if ("second_lat_deg" in detail) rows.push(["second run", place(detail.second_lat_deg, detail.second_lon_deg)]);
    if (detail.reason) rows.push(["no fix", `${detail.reason}: ${detail.detail}`]);
    for (const [name, value] of Object.entries(detail.telemetry ?? {})) rows.push([`reported ${name}`, number(value ?? NaN, 3)]);
    for (const [name, value] of Object.entries(detail.evidence ?? {})) {
      rows.push([name, value === null ? "–" : String(Number(value.toPrecision(5)))]);
    }
    this.find("known").replaceChildren(...rows.filter(([, text]) => text).flatMap(([name, text]) => {
      const [term, value] = [document.createElement("dt"), document.createElement("dd")];
      [term.textContent, value.textContent] = [name, text];
      return [term, value];
    }));
  }
}

const place = (lat, lon) => `${lat.toFixed(7)}, ${lon.toFixed(7)}`;

/** The selected view in a sentence, also for screen readers. */
export function sentence(store, i) {
  const c = store.columns;
  const parts = [store.rising ? clock(c.t[i]) : `view ${i + 1}`];
  const health = healthAt(store, i);
  if (c.reason[i]) parts.push(`no fix: ${c.reason[i]}`);
  else parts.push(described(store, i));
  if (Number.isFinite(c.err[i])) parts.push(`error ${metres(c.err[i])}`);
  if (c.wrong[i]) parts.push("FALSE FIX");
  if (Number.isFinite(c.conf[i])) parts.push(`confidence ${number(c.conf[i], 3)} within ${metres(c.radius[i])}`);
  if (Number.isFinite(c.level[i])) parts.push(`protection level ${metres(c.level[i])} at a risk of ${c.risk[i]}`);
  if (Number.isFinite(c.a[i])) parts.push(`σ ${metres(c.a[i])}`);
  if (Number.isFinite(c.head[i])) parts.push(`heading ${number(c.head[i], 1)}°, ${metres(c.agl[i])} above ground`);
  if (Number.isFinite(c.ms[i])) parts.push(`localized in ${number(c.ms[i], 0)} ms`);
  if (health && health.level !== "OK") parts.push(`health ${health.level}: ${health.reasons.join(", ")}`);
  if (c.err2) parts.push(`second run: ${second(store, i)}`);
  return parts.join(", ");
}

/** Error and confidence of the second run. */
export function second(store, i) {
  const { x2, err2, confident2 } = store.columns;
  if (!Number.isFinite(x2[i])) return "no fix";
  const error = Number.isFinite(err2[i]) ? metres(err2[i]) : "fix";
  return confident2[i] ? error : `${error}, low confidence`;
}

/** The health at the time of a view, undefined without one. */
export function healthAt(store, i) {
  let found;
  for (const line of store.health) {
    if (line.view > i) break;
    found = line;
  }
  return found;
}
