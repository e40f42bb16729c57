// Panel, legend and start. If a script fails, the tables stay visible.

/** A probability with its interval, if known. */
function between(value, low, high) {
  const interval = known(low) && known(high) ? ` (${percent(low)} to ${percent(high)})` : "";
  return percent(value) + interval;
}

function rowsOf(east, north, index) {
  const [lat, lon] = latLonFromEn(data.plane, east, north);
  const cell = cellAt(east, north);
  const rows = [["place", `${lat.toFixed(5)}, ${lon.toFixed(5)}`]];
  if (index >= 0) {
    const far = route.distance_m[index];
    rows.push(["along the route", `${(far / 1000).toFixed(2)} km, after ${clock(far / data.conditions.speed_mps)}`]);
    rows.push(["probability", between(route.probability[index], route.low[index], route.high[index])]);
    rows.push(["lowest across the band", percent(route.across_low[index])]);
    rows.push(["error of a fix", metres(route.error_m[index])]);
    rows.push(["protection level", metres(route.protection_m[index])]);
    rows.push(["available", percent(route.available[index])]);
    const outage = data.stretches.find(({ start_m: start, end_m: end }) => far >= start && far <= end);
    if (outage) rows.push(["outage", String(outage.number)]);
  }
  if (cell < 0) return [...rows, ["cell", "not checked"]];
  const here = (name) => grids[name][cell];
  if (index < 0) {
    if (Number.isNaN(here("probability"))) return [...rows, ["probability", "unknown"]];
    rows.push(["probability", between(here("probability"), here("low"), here("high"))]);
    rows.push(["error of a fix", metres(here("error_m"))]);
  }
  rows.push(["rate of false fixes", percent(here("wrong"))]);
  rows.push(["expected persistence", percent(here("persistence"))]);
  rows.push(["views tried", known(here("trials")) ? String(here("trials")) : "–"]);
  return rows;
}

function showFigures({ east, north, index, aloud }) {
  const rows = rowsOf(east, north, index);
  document.getElementById("hint").hidden = true;
  const list = document.getElementById("figures");
  list.replaceChildren();
  for (const [name, value] of rows) {
    make("dt", name, list);
    make("dd", value, list);
  }
  if (aloud) announce(rows.map(([name, value]) => `${name}: ${value}`).join("; "));
}

/** The legend of a layer, whose `title` the page has in its choice of layers. */
function showLegend(name, title) {
  const legend = document.getElementById("legend");
  legend.replaceChildren();
  if (name) {
    make("b", title, legend);
    const scale = make("canvas", "", legend);
    [scale.width, scale.height] = [100, 1];
    const context = scale.getContext("2d");
    const most = drawn.most[name] ?? 1;
    for (let x = 0; x < 100; x++) {
      context.fillStyle = `rgb(${colourAt(shadeOf(name, (x / 99) * most)).join(" ")})`;
      context.fillRect(x, 0, 1, 1);
    }
    const ends = make("div", "", legend);
    ends.className = "ends";
    const text = name === "error_m" ? metres : percent;
    for (const part of [0, 0.25, 0.5, 0.75, 1]) {
      make("span", text(part * most) + (part === 1 && drawn.most[name] ? " +" : ""), ends);
    }
  }
  if (!route) return;
  make("b", "probability along the route", legend);
  const used = new Set(segments.map(([risk]) => risk));
  RISKS.forEach(({ name: risk, colour, edge, width, dash, range }, i) => {
    if (!used.has(i)) return;
    const row = make("div", "", legend);
    row.className = "risk";
    const sample = make("canvas", "", row);
    [sample.width, sample.height] = [34, 10];
    const context = sample.getContext("2d");
    for (const [paint, thick, dashes] of [[edge, width + EDGE_PX, []], [colour, width, dash]]) {
      [context.strokeStyle, context.lineWidth] = [paint, thick];
      context.setLineDash(dashes);
      context.beginPath();
      context.moveTo(0, 5);
      context.lineTo(34, 5);
      context.stroke();
    }
    make("span", `${risk}, ${range}`, row);
  });
}

function start() {
  document.documentElement.classList.add("live"); // the map needs its size
  listeners.push(showFigures);
  const map = makeMap();
  addCells(map);
  if (route) toggle("show-route", map, addRoute(map));
  selectFromMap(map);
  showSelected(map);
  const box = document.getElementById("profile");
  if (box) new Profile(box, document.getElementById("along"));
}

try {
  start();
} catch (error) {
  document.documentElement.classList.remove("live");
  throw error;
}
