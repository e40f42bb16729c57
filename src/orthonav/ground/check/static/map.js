// The map, in metres of the sheet's plane: a Leaflet "latitude" is north, a "longitude" east.

const at = ([east, north]) => L.latLng(north, east);
const NEAR_PX = 14;
const FINEST = 3;

function boundsOf([west, south, east, north]) {
  return L.latLngBounds(at([west, south]), at([east, north]));
}

function makeMap() {
  const whole = boundsOf(drawn.box);
  const map = planeMap(L, "map", 1, whole, {
    maxZoom: FINEST, minZoom: -12, zoomSnap: 0.25, scrollWheelZoom: false, keyboardPanDelta: 60,
  });
  map.setMinZoom(Math.floor(map.getZoom()) - 1);
  map.setMaxBounds(whole.pad(0.6));
  for (const [name, order] of [["image", 200], ["cells", 250]]) map.createPane(name).style.zIndex = order;
  const image = document.getElementById("check-image");
  L.imageOverlay(image.src, whole, { pane: "image", alt: "" }).addTo(map);
  const north = L.control({ position: "topright" });
  north.onAdd = () => {
    const arrow = make("div", "N");
    arrow.className = "north";
    arrow.setAttribute("role", "img");
    arrow.setAttribute("aria-label", "North is up");
    return arrow;
  };
  north.addTo(map);
  map.on("focus", () => map.scrollWheelZoom.enable()); // otherwise the wheel scrolls the page
  map.on("blur", () => map.scrollWheelZoom.disable());
  document.getElementById("whole").addEventListener("click", () => map.fitBounds(whole));
  for (const [event, width] of [["beforeprint", "680px"], ["afterprint", ""]]) {
    addEventListener(event, () => { // the map fits the paper
      map.getContainer().style.width = width;
      map.invalidateSize({ animate: false });
      map.fitBounds(whole, { animate: false });
    });
  }
  return map;
}

/** An image of a layer, one pixel per cell; unknown cells are transparent. */
function pictureOf(name) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [cells.cols, cells.rows];
  const context = canvas.getContext("2d");
  const picture = context.createImageData(cells.cols, cells.rows);
  for (let i = 0; i < cells.cols * cells.rows; i++) {
    const value = grids[name][i];
    if (Number.isNaN(value)) continue;
    picture.data.set([...colourAt(shadeOf(name, value)), 255], 4 * i);
  }
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL();
}

function addCells(map) {
  const { west_m: west, north_m: north, side_m: side, rows, cols } = cells;
  const bounds = boundsOf([west, north - rows * side, west + cols * side, north]);
  const [choice, opacity] = [document.getElementById("layer"), document.getElementById("opacity")];
  const overlay = L.imageOverlay(pictureOf(choice.value || "probability"), bounds, {
    pane: "cells", className: "cells-picture", alt: "",
  }).addTo(map);
  const change = () => {
    overlay.setOpacity(choice.value ? opacity.value / 100 : 0);
    if (choice.value) overlay.setUrl(pictureOf(choice.value));
    showLegend(choice.value, choice.selectedOptions[0].text);
  };
  choice.addEventListener("change", change);
  opacity.addEventListener("input", () => overlay.setOpacity(choice.value ? opacity.value / 100 : 0));
  change();
}

function numbered(place, text, kind, description, chosen) {
  const side = text.length > 2 ? 30 : 25;
  const icon = L.divIcon({ className: `mark ${kind}`, html: make("span", text), iconSize: [side, side] });
  const above = kind === "lost" ? 1000 : 0;
  const marker = L.marker(at(place), { icon, title: description, alt: description, riseOnHover: true, zIndexOffset: above });
  marker.on("click", () => chosen());
  marker.on("add", () => {
    const element = marker.getElement();
    element.setAttribute("aria-label", description);
    element.addEventListener("keydown", (event) => {
      if (!["Enter", " "].includes(event.key)) return;
      event.preventDefault();
      chosen();
    });
  });
  return marker;
}

function addRoute(map) {
  const group = L.layerGroup().addTo(map);
  const quiet = { interactive: false, lineCap: "round", lineJoin: "round" };
  const line = drawn.route.map(at);
  for (const [risk, first, last] of segments) {
    const { edge, width } = RISKS[risk];
    L.polyline(line.slice(first, last + 1), { ...quiet, color: edge, weight: width + EDGE_PX }).addTo(group);
  }
  for (const [risk, first, last] of segments) {
    const { colour, width, dash } = RISKS[risk];
    const style = { ...quiet, color: colour, weight: width, dashArray: dash.length ? dash.join(" ") : null };
    L.polyline(line.slice(first, last + 1), { ...style, lineCap: "butt" }).addTo(group);
  }
  for (const place of drawn.waypoints) {
    L.circleMarker(at(place), { ...quiet, radius: 4, color: "#1a1a1a", weight: 2, fillColor: "#fff", fillOpacity: 1 }).addTo(group);
  }
  data.stretches.forEach((outage) => {
    const inside = (_, k) => route.distance_m[k] >= outage.start_m && route.distance_m[k] <= outage.end_m;
    L.polyline(line.filter(inside), { ...quiet, color: "#1a1a1a", weight: 2.5 }).addTo(group);
    const middle = nearestAlong((outage.start_m + outage.end_m) / 2);
    const description = `Outage ${outage.number}: ${metres(outage.length_m)}, probability of a fix ${percent(outage.probability)}, available ${percent(outage.available)}.`;
    numbered(drawn.route[middle], String(outage.number), "lost", description, () => {
      selectAlong(middle, false);
      announce(description);
    }).addTo(group);
  });
  return group;
}

function toggle(id, map, group) {
  document.getElementById(id)?.addEventListener("change", (event) => {
    if (event.target.checked) group.addTo(map);
    else group.remove();
  });
}

/** The point of the route near a place on the screen, -1 if none is. */
function routeNear(map, { lat, lng }) {
  if (!route) return -1;
  const metresPerPx = 1 / map.getZoomScale(map.getZoom(), 0);
  let [best, least] = [-1, (NEAR_PX * metresPerPx) ** 2];
  drawn.route.forEach(([east, north], i) => {
    const far = (east - lng) ** 2 + (north - lat) ** 2;
    if (far < least) [best, least] = [i, far];
  });
  return best;
}

function selectFromMap(map) {
  const choose = (latlng) => {
    const index = routeNear(map, latlng);
    if (index >= 0) selectAlong(index);
    else select(latlng.lng, latlng.lat);
  };
  map.on("click", ({ latlng }) => choose(latlng));
  map.on("mousemove", ({ latlng }) => {
    const index = routeNear(map, latlng);
    if (index >= 0) selectAlong(index, false);
  });
  map.getContainer().addEventListener("keydown", (event) => {
    if (event.target !== map.getContainer() || !["Enter", " "].includes(event.key)) return;
    event.preventDefault();
    choose(map.getCenter());
  });
}

function showSelected(map) {
  const side = cells.side_m;
  const edges = [["#fff", 3], ["#000", 1.2]].map(([color, weight]) => L.rectangle(
    boundsOf([0, 0, side, side]), { color, weight, fill: false, interactive: false },
  ));
  const dot = L.circleMarker([0, 0], { radius: 7, color: "#fff", weight: 3, fillColor: "#1a1a1a", fillOpacity: 1, interactive: false });
  listeners.push(({ east, north, index }) => {
    const cell = cellAt(east, north);
    for (const each of edges) {
      if (cell < 0) each.remove();
      else {
        const west = cells.west_m + (cell % cells.cols) * side;
        const top = cells.north_m - Math.floor(cell / cells.cols) * side;
        each.setBounds(boundsOf([west, top - side, west + side, top])).addTo(map);
      }
    }
    if (index < 0) dot.remove();
    else dot.setLatLng(at([east, north])).addTo(map);
    if (index >= 0 && !map.getBounds().contains(at([east, north]))) map.panTo(at([east, north]), { animate: false });
  });
}
