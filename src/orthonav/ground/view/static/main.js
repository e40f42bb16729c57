// The page: creates its parts and connects them.

import { getJson } from "./api.js";
import { metres, ratio } from "./format.js";
import { Course } from "./course.js";
import { Compare, sentence } from "./compare.js";
import { HealthPart } from "./health.js";
import { listen } from "./keys.js";
import { List } from "./list.js";
import { MARKS, NAMES, TRUST, watchColours } from "./look.js";
import { L, at, fitRun, makeMap, nearSheet, showCursor } from "./map.js";
import { Chosen, Marks } from "./marks.js";
import { Store } from "./store.js";

const PLAY_MS = 120;
const find = (id) => document.getElementById(id);

async function begin() {
  const [run, views] = await Promise.all([getJson("api/run"), getJson("api/views")]);
  const store = new Store(run, views);
  document.title = `${run.name} – orthonav view`;
  find("run-name").textContent = run.second ? `${run.name} / ${run.second}` : run.name;
  find("about").textContent = about(run);
  const map = makeMap("map", run.sheet);
  const marks = new Marks(store).addTo(map);
  const parts = {
    store, map, marks,
    chosen: new Chosen(map, store),
    compare: new Compare(map, store, document),
    course: new Course(store, find("chart")),
    list: new List(store, document),
    health: new HealthPart(store, document),
  };
  watchColours(() => { marks.later(); parts.chosen.draw(); parts.course.draw(); drawLegend(store); });
  showCursor(map, run.sheet, store, find("cursor"));
  map.on("click", ({ containerPoint }) => {
    const found = marks.nearest(containerPoint);
    if (found >= 0) store.select(found, "map");
  });
  tie(parts);
  const play = makePlay(store);
  steps(parts, play);
  drawProblems(views.problems);
  find("scrub").max = store.count - 1;
  parts.course.draw();
  parts.list.drawChoices();
  parts.list.draw();
  parts.health.draw();
  drawFigures(store);
  drawLegend(store);
  fitRun(map, store);
  store.select(0);
}

/** Redraws the parts that an event of the store affects. */
function tie({ store, map, marks, chosen, compare, course, list }) {
  store.addEventListener("filter", () => { marks.later(); course.draw(); list.draw(); });
  store.addEventListener("select", ({ detail }) => {
    const i = store.selected;
    chosen.draw();
    compare.show();
    course.drawCursor();
    list.mark(true);
    find("scrub").value = i;
    find("scrub").setAttribute("aria-valuetext", `view ${i + 1}: ${sentence(store, i)}`);
    say(sentence(store, i));
    if (detail.by) bringIntoSight(map, store);
  });
}

let pause = 0;
/** Shows the sentence at once; screen readers get it when stepping pauses. */
function say(text) {
  find("sentence").setAttribute("aria-busy", "true");
  find("sentence").textContent = text;
  clearTimeout(pause);
  pause = setTimeout(() => find("sentence").setAttribute("aria-busy", "false"), 400);
}

/** Moves the map until it shows the fix and the true position of the selected view. */
function bringIntoSight(map, { columns: c, selected: i, run }) {
  const places = [[c.x[i], c.y[i]], [c.tx[i], c.ty[i]]].filter(([x, y]) => nearSheet(x, y, run.sheet));
  if (!places.length) return;
  const both = L.latLngBounds(places.map((place) => at(...place)));
  if (map.getBounds().pad(-0.08).contains(both)) return;
  const zoom = Math.min(map.getZoom(), map.getBoundsZoom(both.pad(0.2)));
  map.setView(both.getCenter(), zoom, { animate: false });
}

function makePlay(store) {
  let timer = 0;
  const button = find("play");
  return (on = !timer) => {
    clearInterval(timer);
    timer = 0;
    if (on) {
      timer = setInterval(() => {
        const before = store.selected;
        store.step(1);
        if (store.selected === before) { clearInterval(timer); timer = 0; button.setAttribute("aria-pressed", "false"); }
      }, PLAY_MS);
    }
    button.setAttribute("aria-pressed", String(on));
  };
}

function steps({ store, map, compare, course }, play) {
  const click = (id, action) => find(id).addEventListener("click", action);
  click("first", () => store.step(-store.count));
  click("before", () => store.step(-1));
  click("after", () => store.step(1));
  click("last", () => store.step(store.count));
  click("play", () => play());
  click("zoom-in", () => course.zoom(0.5));
  click("zoom-out", () => course.zoom(2));
  click("help-open", () => find("help").showModal());
  find("scrub").addEventListener("input", () => store.select(Number(find("scrub").value), "scrub"));
  listen(store, {
    play: () => play(),
    blink: () => compare.blink(),
    fade: (percent) => compare.fadeBy(percent),
    enlarge: () => compare.enlarge(),
    perspective: () => compare.perspective(),
    onMap: () => compare.toggleOnMap(),
    zoom: () => compare.zoomTo(),
    whole: () => fitRun(map, store),
    help: () => find("help").showModal(),
  }, document);
}

function drawProblems(problems) {
  find("problems").hidden = !problems.length;
  find("problems").textContent = problems.join("  ·  ");
}

function drawFigures(store) {
  const { stats, count, run } = store;
  const sorted = (values = []) => values.filter((v) => v >= 0).sort((p, q) => p - q);
  const both = ["", "2"].filter((run) => store.columns[`err${run}`]) // confident ones, as in reports
    .map((run) => sorted(store.columns[`err${run}`].filter((_, i) => store.columns[`confident${run}`][i])));
  const quantile = (errors, part) => { // interpolated, as in reports
    const at = part * (errors.length - 1), low = Math.floor(at);
    return errors.length ? errors[low] + (at - low) * (errors[Math.ceil(at)] - errors[low]) : NaN;
  };
  const rows = [["views", count], ["confident", ratio(stats.confident, count)]];
  rows.push(["low confidence", ratio(stats.fixes - stats.confident, count)], ["no fix", ratio(count - stats.fixes, count)]);
  if (stats.withTruth) {
    rows.push([`within ${metres(run.radius_m)}`, ratio(stats.right, stats.withTruth)]);
    for (const [name, part] of [["CEP50 of confident fixes", 0.5], ["CEP95 of confident fixes", 0.95]]) {
      rows.push([name, both.map((errors) => metres(quantile(errors, part))).join(" / ")]);
    }
    rows.push(["false fixes", stats.wrong]);
  }
  if (stats.withGnss || stats.gnssAlarms) rows.push(["GNSS alarms", stats.gnssAlarms]);
  find("figures").replaceChildren(...rows.map(([name, value]) => {
    const [part, term, figure] = ["div", "dt", "dd"].map((tag) => document.createElement(tag));
    [term.textContent, figure.textContent] = [name, value];
    part.append(term, figure);
    return part;
  }));
}

function drawLegend(store) {
  const [states, trusts] = [new Set(), new Set()];
  for (let i = 0; i < store.count; i++) {
    states.add(store.state(i));
    trusts.add(store.trust(i));
  }
  const rows = ["confident", "low"].filter((trust) => trusts.has(trust))
    .map((trust) => ["●", TRUST[trust], `var(--${trust})`]);
  for (const state of store.run.states) {
    if (states.has(state)) rows.push([MARKS[state], NAMES[state], "var(--ink)"]);
  }
  if (store.stats.withTruth) rows.push(["—", "ground truth", "var(--truth)"], ["◯", "false fix", "var(--wrong)"]);
  if (store.stats.withGnss) rows.push(["—", "GNSS", "var(--gnss)"]);
  if (store.run.second) rows.push(["■", `second run: ${store.run.second}`, "var(--second)"]);
  find("legend").replaceChildren(...rows.map(([mark, name, paint]) => {
    const [part, sign] = [document.createElement("span"), document.createElement("i")];
    [sign.textContent, sign.style.color] = [mark, paint];
    part.append(sign, name);
    return part;
  }));
}

function about(run) {
  const parts = [`orthonav ${run.version}`, `map ${run.map_name}`];
  parts.push(run.images ? `images ${run.images}` : "no images (--flight)");
  parts.push(run.truth ? `ground truth ${run.truth}` : "no ground truth (--truth)");
  return parts.join(", ");
}

begin().catch((error) => {
  find("problems").hidden = false;
  find("problems").textContent = `The run cannot be shown: ${error.message}`;
});
