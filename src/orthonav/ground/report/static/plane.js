// The map of all pages, in the plane of a sheet, so that nothing is projected; and the inverse of
// `orthonav.core.geo.frames.LocalFrame`, an azimuthal-equidistant plane on WGS84 in closed form
// (Bomford, Geodesy, 2.1; Bowring 1976).

const A_M = 6378137;
const F = 1 / 298.257223563;
const E2 = F * (2 - F);

/** Earth-centred metres [x, y, z] of a place on the ellipsoid, angles in radians. */
function ecef(lat, lon) {
  const prime = A_M / Math.sqrt(1 - E2 * Math.sin(lat) ** 2);
  return [
    prime * Math.cos(lat) * Math.cos(lon),
    prime * Math.cos(lat) * Math.sin(lon),
    prime * (1 - E2) * Math.sin(lat),
  ];
}

/** Metres [east, north] in the plane of a pixel [column, row] of the sheet. */
export function enFromPx(sheet, col, row) {
  return [sheet.west_m + col * sheet.gsd_m, sheet.north_m - row * sheet.gsd_m];
}

/** Latitude and longitude in degrees of metres east and north in the plane of the sheet. */
export function latLonFromEn(sheet, east, north) {
  const lat = (sheet.origin_lat_deg * Math.PI) / 180;
  const lon = (sheet.origin_lon_deg * Math.PI) / 180;
  const [sinLat, cosLat, sinLon, cosLon] = [Math.sin(lat), Math.cos(lat), Math.sin(lon), Math.cos(lon)];
  const prime = A_M / Math.sqrt(1 - E2 * sinLat ** 2);
  const meridian = (prime * (1 - E2)) / (1 - E2 * sinLat ** 2);
  const distance = Math.hypot(east, north);
  const azimuth = Math.atan2(east, north);
  const diameter = 2 / (Math.cos(azimuth) ** 2 / meridian + Math.sin(azimuth) ** 2 / prime);
  const dip = distance / diameter;
  const chord = diameter * Math.sin(dip);
  const level = chord * Math.cos(dip);
  const [e, n, u] = [level * Math.sin(azimuth), level * Math.cos(azimuth), -chord * Math.sin(dip)];
  const [x0, y0, z0] = ecef(lat, lon);
  const x = x0 - sinLon * e - sinLat * cosLon * n + cosLat * cosLon * u;
  const y = y0 + cosLon * e - sinLat * sinLon * n + cosLat * sinLon * u;
  const z = z0 + cosLat * n + sinLat * u;
  return latLonFromEcef(x, y, z);
}

function latLonFromEcef(x, y, z) {
  const polar = A_M * (1 - F);
  const axis = Math.hypot(x, y);
  const reduced = Math.atan2(z * A_M, axis * polar);
  const lat = Math.atan2(
    z + (E2 / (1 - E2)) * polar * Math.sin(reduced) ** 3,
    axis - E2 * A_M * Math.cos(reduced) ** 3,
  );
  return [(lat * 180) / Math.PI, (Math.atan2(y, x) * 180) / Math.PI];
}

/** A Leaflet map (`L`) of a plane whose unit is `unitM` metres long, showing `bounds`. */
export function planeMap(L, id, unitM, bounds, options) {
  const distance = (p, q) => Math.hypot(p.lat - q.lat, p.lng - q.lng) * unitM; // a true scale bar
  const crs = L.extend({}, L.CRS.Simple, { distance });
  const map = L.map(id, { crs, zoomDelta: 1, attributionControl: false, ...options });
  L.control.scale({ imperial: false, maxWidth: 150 }).addTo(map);
  map.fitBounds(bounds);
  return map;
}
