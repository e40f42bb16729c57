// Panel and legend, and the start of it all. Where anything fails the figures stay as they are.

const NAMES = {
  probability: "probability of a fix", low: "probability, lower end", error_m: "expected error of a fix",
  wrong: "confident and wrong", texture: "lasting structure",
};

/** Says a sentence to who hears the page. */
function tell(sentence) {
  document.getElementById("said").textContent = sentence;
}

/** A probability with its interval, which may not be known. */
function between(value, low, high) {
  const interval = known(low) && known(high) ? ` (${percent(low).replace(" %", "")}–${percent(high)})` : "";
  return percent(value) + interval;
}

function rowsOf(east, north, index) {
  const [lat, lon] = latLonOf(east, north);
  const cell = cellAt(east, north);
  const rows = [["place", `${lat.toFixed(5)}, ${lon.toFixed(5)}`]];
  if (index >= 0) {
    const far = route.distance_m[index];
    rows.push(["along the route", `${(far / 1000).toFixed(2)} km, ${minutes(far / data.speed_mps)}`]);
    rows.push(["probability", between(route.probability[index], route.low[index], route.high[index])]);
    rows.push(["lowest in the band", percent(route.across_low[index])]);
    rows.push(["error of a fix", metres(route.error_m[index])]);
    rows.push(["position off by", metres(route.drift_m[index])]);
    const blind = data.blind.find(({ start_m: start, end_m: end }) => far >= start && far <= end);
    if (blind) rows.push(["blind stretch", `${blind.number}${blind.bearable ? "" : ", lost in it"}`]);
  }
  if (cell < 0) return [...rows, ["cell", "not checked"]];
  const here = (name) => grids[name](cell);
  if (index < 0) {
    if (Number.isNaN(here("probability"))) return [...rows, ["probability", "not known"]];
    rows.push(["probability", between(here("probability"), here("low"), here("high"))]);
    rows.push(["error of a fix", metres(here("error_m"))]);
  }
  rows.push(["confident and wrong", percent(here("wrong"))]);
  rows.push(["lasting structure", percent(here("texture"))]);
  rows.push(["views tried", known(here("trials")) ? String(here("trials")) : "–"]);
  return rows;
}

function showFigures({ east, north, index, said }) {
  const rows = rowsOf(east, north, index);
  document.getElementById("hint").hidden = true;
  const list = document.getElementById("figures");
  list.replaceChildren();
  for (const [name, value] of rows) {
    make("dt", name, list);
    make("dd", value, list);
  }
  if (said) tell(rows.map(([name, value]) => `${name}: ${value}`).join("; "));
}

function showLegend(name) {
  const legend = document.getElementById("legend");
  legend.replaceChildren();
  if (name) {
    make("b", NAMES[name], legend);
    const scale = make("canvas", "", legend);
    [scale.width, scale.height] = [100, 1];
    const context = scale.getContext("2d");
    const most = cells.most[name] ?? 1;
    for (let x = 0; x < 100; x++) {
      context.fillStyle = `rgb(${colourAt(shadeOf(name, (x / 99) * most)).join(" ")})`;
      context.fillRect(x, 0, 1, 1);
    }
    const ends = make("div", "", legend);
    ends.className = "ends";
    const said = name === "error_m" ? metres : percent;
    for (const [value, more] of [[0, ""], [most / 2, ""], [most, cells.most[name] ? " +" : ""]]) make("span", said(value) + more, ends);
  }
  if (!route) return;
  make("b", "probability along the route", legend);
  const used = new Set(route.pieces.map(([risk]) => risk));
  data.risks.forEach(({ name: risk, colour, width, dash, said }, i) => {
    if (!used.has(i)) return;
    const row = make("div", "", legend);
    row.className = "way";
    const sample = draw("svg", { width: 34, height: 10 }, row);
    draw("line", { x1: 0, x2: 34, y1: 5, y2: 5, stroke: colour, "stroke-width": width, "stroke-dasharray": dash.join(" ") || "none" }, sample);
    make("span", `${risk}, ${said}`, row);
  });
}

function start() {
  document.documentElement.classList.add("live"); // the map needs its size
  listeners.push(showFigures);
  const map = makeMap();
  addCells(map);
  if (route) toggle("show-route", map, addRoute(map));
  toggle("show-lookalikes", map, addLookalikes(map));
  lookFromMap(map);
  showLooked(map);
  const box = document.getElementById("profile");
  if (box) new Profile(box, document.getElementById("along"));
}

try {
  start();
} catch (error) {
  document.documentElement.classList.remove("live");
  throw error;
}
