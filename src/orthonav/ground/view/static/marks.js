// Truth, fixes and ellipses of all views on one canvas, redrawn when the map moves: a Leaflet shape
// for each of many thousand views would be too slow.

import { L, at } from "./map.js";
import { Squares, colour, drawMark } from "./look.js";

const BOUND_95 = Math.sqrt(-2 * Math.log(0.05)); // chi-square, two degrees of freedom
const MOST_ELLIPSES = 120;
const TOUCH_PX = 22;
const PAD = 0.15;
const MANY = 800;
const SQUARE_PX = 2;

export const Marks = L.Layer.extend({
  initialize(store) { this._store = store; },

  onAdd(map) {
    this._canvas = L.DomUtil.create("canvas", "leaflet-zoom-animated", map.getPane("overlayPane"));
    this._canvas.style.pointerEvents = "none";
    map.on("moveend zoomend viewreset resize zoom", this.later, this);
    map.on("move", this._moved, this);
    if (map.options.zoomAnimation) map.on("zoomanim", this._animate, this);
    this.later();
  },

  onRemove(map) {
    this._canvas.remove();
    map.off("moveend zoomend viewreset resize zoom", this.later, this);
    map.off("move", this._moved, this);
    map.off("zoomanim", this._animate, this);
  },

  /** Draws before the next frame. */
  later() {
    this._asked ??= requestAnimationFrame(() => { this._asked = null; this._draw(); });
  },

  /** While the map is dragged the canvas moves with it; it extends a little beyond the map. */
  _moved() {
    if (!this._bounds?.contains(this._map.getBounds())) this.later();
  },

  _animate({ zoom, center }) {
    const scale = this._map.getZoomScale(zoom, this._zoom);
    const offset = this._map._latLngBoundsToNewLayerBounds(this._bounds, zoom, center).min;
    L.DomUtil.setTransform(this._canvas, offset, scale);
  },

  _draw() {
    const map = this._map;
    if (!map || map._animatingZoom) return;
    const size = map.getSize();
    const ratio = devicePixelRatio || 1;
    const pad = size.multiplyBy(PAD).round();
    const [width, height] = [size.x + 2 * pad.x, size.y + 2 * pad.y];
    const canvas = this._canvas;
    if (canvas.width !== width * ratio || canvas.height !== height * ratio) {
      [canvas.width, canvas.height] = [width * ratio, height * ratio];
      [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
    }
    const corner = map.containerPointToLayerPoint(pad.multiplyBy(-1));
    L.DomUtil.setTransform(canvas, corner, 1);
    this._zoom = map.getZoom();
    this._bounds = L.latLngBounds(
      map.layerPointToLatLng(corner), map.layerPointToLatLng(corner.add([width, height])),
    );
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const origin = map.latLngToLayerPoint(at(0, 0)).subtract(corner);
    const scale = map.getZoomScale(this._zoom, 0);
    this._paint(context, { x: origin.x, y: origin.y, scale, width, height });
  },

  _paint(context, view) {
    const { columns: c, count } = this._store;
    if (!count) return;
    this._line(context, view, c.tx, c.ty, "truth");
    if (this._store.stats.withGnss) this._line(context, view, c.gx, c.gy, "gnss");
    this._ellipses(context, view);
    if (c.x2) this._second(context, view);
    const size = count > 4000 ? 2.2 : count > MANY ? 3 : 4;
    const rings = new Path2D(); // drawn together on top: one by one is slower
    for (const faded of [true, false]) {
      context.globalAlpha = faded ? 0.22 : 1;
      let last = "";
      const drawn = new Squares(view.width, view.height, SQUARE_PX);
      for (let i = 0; i < count; i++) {
        if (this._store.isShown[i] === faded) continue;
        const [x, y] = [view.x + c.x[i] * view.scale, view.y + c.y[i] * view.scale];
        if (!(x > -9 && y > -9 && x < view.width + 9 && y < view.height + 9)) continue;
        const [state, trust] = [this._store.state(i), this._store.trust(i)];
        const ringed = c.wrong[i] && !faded;
        if (count > MANY && !ringed && drawn.has(x, y, trust, state)) continue;
        if (trust !== last) context.fillStyle = context.strokeStyle = colour(trust);
        last = trust;
        drawMark(context, state, x, y, size);
        if (ringed) this._ring(rings, view, i, x, y, size);
      }
    }
    context.globalAlpha = 1;
    [context.lineWidth, context.strokeStyle] = [1.8, colour("wrong")];
    context.stroke(rings);
  },

  /** The path by truth or GNSS, with gaps where it is unknown. */
  _line(context, view, xs, ys, paint) {
    const path = new Path2D();
    let [before, lastX, lastY] = [false, 0, 0];
    for (let i = 0; i < xs.length; i++) {
      const known = !Number.isNaN(xs[i]);
      const [x, y] = [view.x + xs[i] * view.scale, view.y + ys[i] * view.scale];
      if (known && before && Math.abs(x - lastX) + Math.abs(y - lastY) < 1.5) continue; // indistinguishable
      if (known && before) path.lineTo(x, y);
      else if (known) path.moveTo(x, y);
      [before, lastX, lastY] = [known, x, y];
    }
    for (const [width, name, alpha] of [[4.5, "paper", 0.65], [1.6, paint, 1]]) {
      [context.lineWidth, context.strokeStyle, context.globalAlpha] = [width, colour(name), alpha];
      context.stroke(path);
    }
    context.globalAlpha = 1;
  },

  /** The fixes of the second run, squares behind the marks; those of low confidence are faint. */
  _second(context, view) {
    const { columns: c, isShown } = this._store;
    context.fillStyle = colour("second");
    for (let i = 0; i < c.x2.length; i++) {
      const [x, y] = [view.x + c.x2[i] * view.scale, view.y + c.y2[i] * view.scale];
      if (!(x > 0 && y > 0 && x < view.width && y < view.height)) continue;
      context.globalAlpha = isShown[i] ? (c.confident2[i] ? 1 : 0.5) : 0.15;
      context.fillRect(x - 5, y - 5, 10, 10);
    }
    context.globalAlpha = 1;
  },

  /** A false fix: a ring, and a line to the true position. */
  _ring(rings, view, i, x, y, size) {
    const c = this._store.columns;
    rings.moveTo(x + size + 3.5, y);
    rings.arc(x, y, size + 3.5, 0, 2 * Math.PI);
    rings.moveTo(x, y);
    rings.lineTo(view.x + c.tx[i] * view.scale, view.y + c.ty[i] * view.scale);
  },

  /** 95 % ellipses of visible views, thinned out where there are many. */
  _ellipses(context, view) {
    const { columns: c, shown, run } = this._store;
    const inside = shown.filter((i) => {
      const [x, y] = [view.x + c.x[i] * view.scale, view.y + c.y[i] * view.scale];
      return x > 0 && y > 0 && x < view.width && y < view.height && c.a[i] > 0;
    });
    const every = Math.ceil(inside.length / MOST_ELLIPSES);
    const perMetre = (BOUND_95 * view.scale) / run.sheet.gsd_m;
    context.lineWidth = 1;
    for (let k = 0; k < inside.length; k += every) {
      const i = inside[k];
      const [a, b] = [c.a[i] * perMetre, c.b[i] * perMetre];
      if (a < 3 || a > view.width) continue;
      context.strokeStyle = colour(this._store.trust(i));
      context.globalAlpha = 0.75;
      context.beginPath();
      context.ellipse(view.x + c.x[i] * view.scale, view.y + c.y[i] * view.scale, a, b,
        (-c.turn[i] * Math.PI) / 180, 0, 2 * Math.PI);
      context.stroke();
    }
    context.globalAlpha = 1;
  },

  /** The shown view nearest to a point of the map's container, -1 if none is near. */
  nearest(point) {
    const { columns: c, shown } = this._store;
    const origin = this._map.latLngToContainerPoint(at(0, 0));
    const scale = this._map.getZoomScale(this._map.getZoom(), 0);
    let [best, found] = [TOUCH_PX ** 2, -1];
    for (const i of shown) {
      for (const [px, py] of [[c.x[i], c.y[i]], [c.tx[i], c.ty[i]]]) {
        const far = (origin.x + px * scale - point.x) ** 2 + (origin.y + py * scale - point.y) ** 2;
        if (far < best) [best, found] = [far, i];
      }
    }
    return found;
  },
});

/** The selected view on the map: fix, 95 % ellipse, true position. */
export class Chosen {
  constructor(map, store) {
    this.store = store;
    this.group = L.layerGroup().addTo(map);
  }

  draw() {
    const { columns: c, selected: i, run } = this.store;
    this.group.clearLayers();
    if (i < 0) return;
    const [fix, truth] = [[c.x[i], c.y[i]], [c.tx[i], c.ty[i]]];
    const known = (place) => place.every(Number.isFinite);
    const add = (shape) => shape.addTo(this.group);
    const line = (latLngs, style) => {
      add(L.polyline(latLngs, { color: "#fff", weight: style.weight + 3, opacity: 0.8, interactive: false }));
      add(L.polyline(latLngs, { ...style, interactive: false }));
    };
    if (known(fix) && known(truth)) line([at(...fix), at(...truth)], { color: colour("wrong"), weight: 2 });
    if (known(truth)) add(ring(truth, 7, colour("truth")));
    if (!known(fix)) return;
    if (c.a[i] > 0) line(ellipse(fix, c.a[i], c.b[i], c.turn[i], run.sheet.gsd_m), { color: colour("strong"), weight: 2 });
    const level = c.level[i] / BOUND_95; // a circle
    if (level > 0) line(ellipse(fix, level, level, 0, run.sheet.gsd_m), { color: colour("strong"), weight: 1.5, dashArray: "6 5" });
    add(ring(fix, 10, "#ffffff", 6));
    add(ring(fix, 10, colour("strong"), 3));
  }
}

const ring = ([x, y], radius, color, weight = 2.5) => L.circleMarker(at(x, y),
  { radius, color, weight, fill: false, interactive: false });

function ellipse([x, y], a, b, turnDeg, gsdM) {
  const turn = (turnDeg * Math.PI) / 180;
  const points = [];
  for (let k = 0; k <= 48; k++) {
    const angle = (k * Math.PI) / 24;
    const [u, v] = [(BOUND_95 * a * Math.cos(angle)) / gsdM, (BOUND_95 * b * Math.sin(angle)) / gsdM];
    points.push(at(x + u * Math.cos(turn) - v * Math.sin(turn), y - (u * Math.sin(turn) + v * Math.cos(turn))));
  }
  return points;
}
