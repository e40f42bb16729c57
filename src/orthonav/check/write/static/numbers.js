// What was found, from the JSON of the page, and figures as text. The files of this folder become one
// script: what one declares the next ones use.

const data = JSON.parse(document.getElementById("check-data").textContent);
const cells = data.cells;
const route = data.route;
const grids = {};

function bytesOf(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}
for (const [name, text] of Object.entries(cells.shares)) {
  const bytes = bytesOf(text);
  grids[name] = (i) => (bytes[i] === 255 ? NaN : bytes[i] / cells.steps);
}
for (const [name, text] of Object.entries(cells.words)) {
  const bytes = bytesOf(text);
  const part = name === "error_m" ? 10 : 1;
  grids[name] = (i) => {
    const word = bytes[2 * i] + 256 * bytes[2 * i + 1];
    return word === 65535 ? NaN : word / part;
  };
}

/** Number of the cell at a place in metres, -1 where there is none. */
function cellAt(east, north) {
  const col = Math.floor((east - cells.west_m) / cells.side_m);
  const row = Math.floor((cells.north_m - north) / cells.side_m);
  return row >= 0 && row < cells.rows && col >= 0 && col < cells.cols ? row * cells.cols + col : -1;
}

/** Latitude and longitude in degrees of a place in metres. */
function latLonOf(east, north) {
  const { middle, half, powers, lat, lon } = data.place;
  const [u, v] = [(east - middle[0]) / half, (north - middle[1]) / half];
  const sum = (factors) => powers.reduce((all, [i, j], k) => all + factors[k] * u ** i * v ** j, 0);
  return [sum(lat), sum(lon)];
}

/** Red, green and blue of 0 to 1. */
function colourAt(share) {
  const stops = data.colours;
  const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(at), stops.length - 2);
  const part = (k, of) => parseInt(stops[of].slice(k, k + 2), 16);
  return [1, 3, 5].map((k) => Math.round(part(k, low) + (at - low) * (part(k, low + 1) - part(k, low))));
}

/** Where a figure of a layer lies on the scale of colours: light is good. */
function shadeOf(name, value) {
  const most = cells.most[name];
  return most ? 1 - value / most : value;
}

const known = (value) => value !== null && Number.isFinite(value);
const percent = (value) => {
  if (!known(value)) return "–";
  const whole = Math.round(100 * value);
  return `${whole === 100 && value < 0.9995 ? 99 : whole} %`;
};
const metres = (value) => {
  if (!known(value)) return "–";
  return Math.abs(value) >= 10000 ? `${(value / 1000).toFixed(1)} km` : `${value.toFixed(value < 10 ? 1 : 0)} m`;
};
const minutes = (seconds) =>
  `${Math.floor(seconds / 60)}:${String(Math.floor(seconds) % 60).padStart(2, "0")} min`;

function make(kind, text = "", parent = null) {
  const element = document.createElement(kind);
  element.textContent = text;
  parent?.append(element);
  return element;
}
const SVG = "http://www.w3.org/2000/svg";
function draw(kind, attributes, parent = null) {
  const element = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  parent?.append(element);
  return element;
}

// The place that is looked at: its listeners are told whenever it changes.
const listeners = [];
/** Looks at a place; `index` is the point of the route or -1, `said` whether to tell it aloud. */
function look(east, north, index = -1, said = true) {
  for (const listener of listeners) listener({ east, north, index, said });
}
/** Looks at a point of the route. */
function lookAlong(index, said = true) {
  const [east, north] = route.en[index];
  look(east, north, index, said);
}
