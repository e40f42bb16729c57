// Health of the flight: the current level in the header, changes in a list.

const LEVELS = { OK: "good", DEGRADED: "warn", FAILED: "bad" };
const MOST = 200;

export class HealthPart {
  constructor(store, root) {
    this.store = store;
    this.find = (id) => root.getElementById(id);
    this.find("health-list").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) store.select(Number(button.dataset.view), "health");
    });
  }

  draw() {
    const lines = this.store.health;
    this.find("health-none").hidden = lines.length > 0;
    if (!lines.length) return;
    const last = lines.at(-1);
    const badge = this.find("health-now");
    badge.hidden = false;
    badge.className = `badge ${LEVELS[last.level] ?? ""}`;
    badge.textContent = [`health ${last.level}`, last.reasons.join(", ")].filter(Boolean).join(": ");
    this.#last(last);
    const changes = lines.filter((line, k) => !k || key(line) !== key(lines[k - 1]));
    this.find("health-list").replaceChildren(...changes.slice(-MOST).reverse().map((line) => this.#row(line)));
  }

  #last(last) {
    const rows = [];
    for (const name of ["sent", "withheld", "counts", "log_lost"]) {
      const parts = Object.entries(last[name] ?? {}).map(([key, value]) => `${key} ${value}`);
      if (parts.length) rows.push([name.replace("_", " "), parts.join(", ")]);
    }
    if ("age_p95_ms" in last) rows.push(["age", `${last.age_p50_ms} ms median, ${last.age_p95_ms} ms p95`]);
    this.find("health-last").replaceChildren(...rows.flatMap(([name, text]) => {
      const [term, value] = [document.createElement("dt"), document.createElement("dd")];
      [term.textContent, value.textContent] = [name, text];
      return [term, value];
    }));
  }

  #row(line) {
    const [item, button, level] = ["li", "button", "b"].map((name) => document.createElement(name));
    button.type = "button";
    button.dataset.view = line.view;
    level.className = LEVELS[line.level] ?? "";
    level.textContent = line.level;
    button.append(`view ${Math.min(line.view + 1, this.store.count)}: `, level, line.reasons.length ? ` ${line.reasons.join(", ")}` : "");
    item.append(button);
    return item;
  }
}

const key = (line) => [line.level, ...line.reasons].join();
