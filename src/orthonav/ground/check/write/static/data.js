// What the check found, from the JSON in the page, and the selected place. The scripts of a page
// are joined into one, so that later ones use what earlier ones declare.

const data = JSON.parse(document.getElementById("check-data").textContent);
const { cells, drawn } = data;
const route = data.route?.points;
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
  const stops = drawn.colours;
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
  const [knee, shade] = drawn.knee; // most of the scale is for what is likely
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
