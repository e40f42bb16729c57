// Single keys. They are off in text fields, and can be turned off in the help, because they conflict
// with speech input.

const TYPES = "input:not([type=range]):not([type=checkbox]), textarea, select";
const MOVED_BY_KEYS = "#map, #opacity"; // the slider of the course acts like the course
const STORED = "orthonav-keys";

export function listen(store, actions, root) {
  const box = root.getElementById("keys-on");
  box.checked = localStorage.getItem(STORED) !== "off";
  box.addEventListener("change", () => localStorage.setItem(STORED, box.checked ? "on" : "off"));
  const leap = () => Math.max(1, Math.round(store.shown.length / 20));
  const keys = {
    ArrowLeft: () => store.step(-1),
    ArrowRight: () => store.step(1),
    PageUp: () => store.step(-leap()),
    PageDown: () => store.step(leap()),
    Home: () => store.step(-store.count),
    End: () => store.step(store.count),
    n: () => store.stepList(1),
    p: () => store.stepList(-1),
    " ": actions.play,
    b: actions.blink,
    "[": () => actions.fade(-10),
    "]": () => actions.fade(10),
    o: actions.onMap,
    c: actions.perspective,
    e: actions.enlarge,
    z: actions.zoom,
    a: actions.whole,
    "?": actions.help,
  };
  root.addEventListener("keydown", (event) => {
    if (!(event.target instanceof Element)) return;
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    if (root.querySelector("dialog[open]") || event.target.closest(TYPES)) return;
    const moves = event.key.length > 1;
    if (moves && event.target.closest(MOVED_BY_KEYS)) return;
    if (!moves && !box.checked) return;
    if (event.key === " " && event.target.closest("button, summary, input")) return;
    const action = keys[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });
}
