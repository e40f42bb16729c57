// The map: the grey imagery of the map file as tiles, in pixels of the sheet, so that nothing is
// projected. A Leaflet "latitude" is minus the row, a "longitude" the column.

import * as L from "../leaflet/leaflet-src.esm.js";
import { enFromPx, latLonFromEn, planeMap } from "./plane.js";
import { metres } from "./format.js";

export { L };
export const at = (col, row) => L.latLng(-row, col);
export const pixel = (latLng) => [latLng.lng, -latLng.lat];
const FINEST_ZOOM = 6;
const MIN_M = 300; // visible width, however short the run

/** Chunks of the registration layer as stored: a tile of zoom -L is a chunk of level L. Those at
    the south and east borders may be smaller than a tile, so each lies in a box of the full size. */
const Chunks = L.GridLayer.extend({
  createTile({ x, y, z }, done) {
    const { side_px: side, levels } = this.options.sheet.tiles;
    const box = L.DomUtil.create("div");
    const level = -z;
    const [rows, cols] = levels[level] ?? [0, 0];
    const [width, height] = [Math.min(side, cols - x * side), Math.min(side, rows - y * side)];
    if (x < 0 || y < 0 || width <= 0 || height <= 0) {
      setTimeout(() => done(null, box));
      return box;
    }
    const part = L.DomUtil.create("img", "tile-part", box);
    part.alt = "";
    // One pixel more, or gaps between tiles are visible at fractional zooms.
    part.style.width = `calc(${(100 * width) / side}% + 1px)`;
    part.style.height = `calc(${(100 * height) / side}% + 1px)`;
    part.onload = () => done(null, box);
    part.onerror = () => { part.remove(); done(null, box); }; // no imagery here
    part.src = `tiles/${level}/${x}/${y}?v=${this.options.sheet.id}`;
    return box;
  },
});

/** The map in the element `id`. */
export function makeMap(id, sheet) {
  const bounds = L.latLngBounds(at(0, 0), at(sheet.width_px, sheet.height_px));
  const coarsest = sheet.tiles ? sheet.tiles.levels.length - 1 : Math.log2(sheet.width_px / 256);
  const map = planeMap(L, id, sheet.gsd_m, bounds, {
    minZoom: -Math.ceil(Math.max(coarsest, 1)) - 1, maxZoom: FINEST_ZOOM, zoomSnap: 0.5,
  });
  if (sheet.tiles) {
    new Chunks({
      sheet,
      tileSize: sheet.tiles.side_px,
      minNativeZoom: 1 - sheet.tiles.levels.length,
      maxNativeZoom: 0,
      minZoom: map.getMinZoom(),
      maxZoom: FINEST_ZOOM,
      noWrap: true,
      bounds,
    }).addTo(map);
  } else {
    L.imageOverlay(`preview.jpg?v=${sheet.id}`, bounds, { alt: "" }).addTo(map);
  }
  return map;
}

/** Shows the position of the pointer and its distance from the selected view. */
export function showCursor(map, sheet, store, element) {
  map.on("mousemove click", ({ latlng }) => {
    const [col, row] = pixel(latlng);
    const [lat, lon] = latLonFromEn(sheet, ...enFromPx(sheet, col, row));
    const [x, y] = [store.columns.x?.[store.selected], store.columns.y?.[store.selected]];
    const far = Math.hypot(col - x, row - y) * sheet.gsd_m;
    const text = Number.isFinite(far) ? ` · ${metres(far)} from the view` : "";
    element.textContent = `${lat.toFixed(6)}, ${lon.toFixed(6)}${text}`;
  });
  map.on("mouseout", () => { element.textContent = ""; });
}

/** Moves the map to the whole run: true positions and fixes, far outliers excluded. */
export function fitRun(map, store) {
  const c = store.columns;
  const known = [];
  for (let i = 0; i < store.count; i++) {
    if (!Number.isNaN(c.tx[i])) known.push([c.tx[i], c.ty[i]]);
    else if (nearSheet(c.x[i], c.y[i], store.run.sheet)) known.push([c.x[i], c.y[i]]);
  }
  if (!known.length) return;
  const [xs, ys] = [known.map((p) => p[0]), known.map((p) => p[1])];
  const low = at(min(xs), min(ys));
  const high = at(-min(xs.map((v) => -v)), -min(ys.map((v) => -v)));
  const bounds = L.latLngBounds(low, high).pad(0.08);
  const least = MIN_M / 2 / store.run.sheet.gsd_m;
  const { lat, lng } = bounds.getCenter();
  bounds.extend([lat - least, lng - least]).extend([lat + least, lng + least]);
  map.fitBounds(bounds);
}

const min = (values) => values.reduce((p, q) => Math.min(p, q), Infinity);
/** Whether a place is known and no farther from the sheet than its own size. */
export const nearSheet = (x, y, sheet) => x > -sheet.width_px && x < 2 * sheet.width_px
  && y > -sheet.height_px && y < 2 * sheet.height_px;
