// Numbers as text, the same on all pages; an unknown one is a dash.

export const known = (value) => value !== null && Number.isFinite(value);

/** A length in metres, as `metres_text` of `orthonav.ground.report` writes it. */
export function metres(value) {
  if (!known(value)) return "–";
  const size = Math.abs(value);
  if (size >= 10000) return `${(value / 1000).toFixed(1)} km`;
  return `${value.toFixed(size < 100 ? 1 : 0).replace(/\.0$/, "")} m`;
}

export const number = (value, digits) => (known(value) ? value.toFixed(digits) : "–");
export const ratio = (part, whole) => (whole ? `${((100 * part) / whole).toFixed(1)} %` : "–");

/** A probability in whole percent, 100 % only if it really is. */
export function percent(value) {
  if (!known(value)) return "–";
  const whole = Math.round(100 * value);
  return `${whole === 100 && value < 0.9995 ? 99 : whole} %`;
}

/** Seconds as 1:02:03.4. */
export function clock(seconds) {
  if (!known(seconds)) return "–";
  const sign = seconds < 0 ? "-" : "";
  const all = Math.abs(seconds);
  const [h, m, s] = [Math.floor(all / 3600), Math.floor(all / 60) % 60, (all % 60).toFixed(1)];
  const tail = s.padStart(4, "0");
  return h ? `${sign}${h}:${String(m).padStart(2, "0")}:${tail}` : `${sign}${m}:${tail}`;
}
