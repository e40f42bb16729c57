// What the check found, from the JSON in the page, and the selected place. The scripts of a page
// are joined into one, so that later ones use what earlier ones declare.

const data = JSON.parse(document.getElementById("check-data").textContent);
const { cells, drawn } = data;
const route = data.route?.points;
const CIVIDIS = ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838"];
// Ten equal steps from 0 to 1 of cividis (Nunez et al. 2018, doi 10.1371/journal.pone.0199239).
const KNEE = [0.5, 0.2]; // a probability and its place on the scale: most of it is for what is likely
// Classes of places along the route differ in colour (of the middle of their range), width and dash.
const EDGE_PX = 3;
const [DARK, LIGHT] = ["#1a1a1a", "#ffffff"];
const RISKS = [
  { name: "confident", least: 0.9, colour: "#ead34c", edge: DARK, width: 4, dash: [], range: "0.9 or more" },
  { name: "likely", least: 0.7, colour: "#a99f73", edge: DARK, width: 2.5, dash: [], range: "0.7 to 0.9" },
  { name: "doubtful", least: 0.5, colour: "#5e626e", edge: LIGHT, width: 5, dash: [9, 4], range: "0.5 to 0.7" },
  { name: "unlikely", least: 0, colour: "#083370", edge: LIGHT, width: 6.5, dash: [], range: "below 0.5" },
  { name: "unknown", colour: "#ffffff", edge: DARK, width: 4, dash: [4, 6], range: "unknown" },
];

/** The route in segments of one class, [class, first point, last point]: the worse of two points. */
function segmentsOf(probability) {
  const classes = probability.map((p) => (known(p) ? RISKS.findIndex(({ least }) => p >= least) : RISKS.length - 1));
  const found = [];
  for (let i = 1; i < classes.length; i++) {
    const here = Math.max(classes[i - 1], classes[i]);
    if (found.at(-1)?.[0] === here) found.at(-1)[2] = i;
    else found.push([here, i - 1, i]);
  }
  return found;
}

const segments = route ? segmentsOf(route.probability) : [];
const grids = {};
for (const name of drawn.values) {
  grids[name] = new Array(cells.rows * cells.cols).fill(name === "trials" ? 0 : NaN);
  cells.known.forEach((cell, i) => { grids[name][cell] = cells[name][i] ?? NaN; });
}

/** Number of the cell at a place in metres, -1 outside. */
function cellAt(east, north) {
  const col = Math.floor((east - cells.west_m) / cells.side_m);
  const row = Math.floor((cells.north_m - north) / cells.side_m);
  return row >= 0 && row < cells.rows && col >= 0 && col < cells.cols ? row * cells.cols + col : -1;
}

/** Red, green and blue of 0 to 1. */
function colourAt(share) {
  const stops = CIVIDIS;
  const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(at), stops.length - 2);
  const part = (k, of) => parseInt(stops[of].slice(k, k + 2), 16);
  return [1, 3, 5].map((k) => Math.round(part(k, low) + (at - low) * (part(k, low + 1) - part(k, low))));
}

/** Position of a value on the colour scale: light is good. */
function shadeOf(name, value) {
  const most = drawn.most[name];
  if (most) return 1 - value / most;
  if (name !== "probability" && name !== "low") return value;
  const [knee, shade] = KNEE;
  return value < knee ? (value / knee) * shade : shade + ((value - knee) / (1 - knee)) * (1 - shade);
}

function make(kind, text = "", parent = null) {
  const element = document.createElement(kind);
  element.textContent = text;
  parent?.append(element);
  return element;
}

/** Reads a sentence to users of screen readers. */
function announce(sentence) {
  document.getElementById("announcement").textContent = sentence;
}

const listeners = [];
/** Selects a place; `index` is the point of the route or -1, `aloud` whether to announce it. */
function select(east, north, index = -1, aloud = true) {
  for (const listener of listeners) listener({ east, north, index, aloud });
}
/** Selects a point of the route. */
function selectAlong(index, aloud = true) {
  const [east, north] = drawn.route[index];
  select(east, north, index, aloud);
}

/** The point of the route nearest to a distance from its start. */
function nearestAlong(distance) {
  let [low, high] = [0, route.distance_m.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (route.distance_m[middle] < distance) low = middle;
    else high = middle;
  }
  return distance - route.distance_m[low] < route.distance_m[high] - distance ? low : high;
}
