// The list of views, filtered and ordered, one page at a time.

import { clock, metres, number } from "./format.js";
import { second } from "./compare.js";
import { MARKS, described } from "./look.js";

const PAGE = 40;

export class List {
  constructor(store, root) {
    this.store = store;
    this.find = (id) => root.getElementById(id);
    this.first = 0; // of the current page of the list
    const [which, order, named] = ["which", "order", "named"].map(this.find);
    which.addEventListener("change", () => this.#ask({ which: which.value }));
    order.addEventListener("change", () => this.#ask({ order: order.value }));
    named.addEventListener("input", () => this.#ask({ named: named.value.trim() }));
    this.find("list").addEventListener("keydown", (event) => this.#arrows(event));
    this.find("list-before").addEventListener("click", () => this.#turn(-PAGE));
    this.find("list-after").addEventListener("click", () => this.#turn(PAGE));
    this.find("list").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) store.select(Number(button.dataset.view), "list");
    });
  }

  /** One row of the list is a stop of Tab; the arrow keys go from row to row. */
  #arrows(event) {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step || !event.target.closest("#list")) return;
    event.preventDefault();
    this.store.stepList(step);
    this.find("list").querySelector("[aria-current]")?.focus();
  }

  #turn(by) {
    this.first = Math.max(this.first + by, 0);
    this.draw();
    this.find("list").querySelector(by > 0 ? "button" : "li:last-child button")?.focus();
  }

  #ask(what) {
    this.first = 0;
    this.store.show(what);
    if (this.store.listed.length) this.store.select(this.store.listed[0], "list");
  }

  /** Choices of the filter; empty ones are not offered unless chosen. */
  drawChoices() {
    const { store } = this;
    const many = (rule) => { let n = 0; for (let i = 0; i < store.count; i++) n += rule(i) ? 1 : 0; return n; };
    const c = store.columns;
    const choices = [["all", "all views", store.count], ["confident", "confident", store.stats.confident]];
    if (store.stats.withTruth) {
      choices.push(["wrong", "false fixes", store.stats.wrong]);
      choices.push(["far", `error above ${metres(store.run.radius_m)}`, many((i) => c.err[i] > store.run.radius_m)]);
    }
    choices.push(["doubt", "low confidence: best guesses", store.stats.fixes - store.stats.confident]);
    for (const state of store.run.states) {
      choices.push([`state:${state}`, state, many((i) => store.state(i) === state)]);
    }
    choices.push(["none", "no fix", store.count - store.stats.fixes]);
    for (const [reason, count] of store.reasons) choices.push([`reason:${reason}`, `no fix: ${reason}`, count]);
    const offered = choices.filter(([value, , count]) => count || ["all", "wrong", store.which].includes(value));
    const key = JSON.stringify(offered);
    if (key === this.key) return;
    this.key = key;
    this.find("which").replaceChildren(...offered.map(([value, text, count]) => new Option(`${text} (${count})`, value)));
    this.find("which").value = store.which;
    this.find("order").querySelector("[value=error]").disabled = !store.stats.withTruth;
  }

  draw() {
    const { store } = this;
    if (this.first >= store.listed.length) this.first = 0;
    const views = store.listed.slice(this.first, this.first + PAGE);
    this.find("shown-count").textContent = store.listed.length === store.count
      ? `${store.count} views` : `${store.listed.length} of ${store.count} views`;
    this.find("list").replaceChildren(...views.map((i) => this.#row(i)));
    this.find("list-before").hidden = !this.first;
    this.find("list-after").hidden = store.listed.length <= this.first + PAGE;
    this.mark();
  }

  #row(i) {
    const c = this.store.columns;
    const button = document.createElement("button");
    button.type = "button";
    button.dataset.view = i;
    button.tabIndex = -1;
    const error = c.reason[i] || (Number.isFinite(c.err[i]) ? metres(c.err[i]) : `σ ${metres(c.a[i])}`);
    const name = this.store.rising ? `${clock(c.t[i])}  ${c.frame[i]}` : c.frame[i];
    const parts = [
      [`mark ${this.store.trust(i)}`, MARKS[this.store.state(i)]],
      ["name", name],
      [c.wrong[i] ? "bad" : "", c.wrong[i] ? `${error} confident!` : error],
      ...(c.err2 ? [["second", second(this.store, i).replace(", low confidence", "?")]] : []),
      ["soft", Number.isFinite(c.conf[i]) ? number(c.conf[i], 2) : ""],
    ];
    for (const [kind, text] of parts) {
      const part = document.createElement("span");
      [part.className, part.textContent] = [kind, text];
      button.append(part);
    }
    button.firstChild.setAttribute("role", "img"); // a shape, and a word for screen readers
    button.firstChild.setAttribute("aria-label", described(this.store, i));
    const item = document.createElement("li");
    item.append(button);
    return item;
  }

  /** Marks the selected view in the list; `reveal` shows its page and scrolls to it. */
  mark(reveal = false) {
    const list = this.find("list");
    list.querySelector("[aria-current]")?.removeAttribute("aria-current");
    let button = list.querySelector(`[data-view="${this.store.selected}"]`);
    const at = button || !reveal ? -1 : this.store.listed.indexOf(this.store.selected);
    if (at >= 0) {
      this.first = at - (at % PAGE);
      this.draw();
      button = list.querySelector(`[data-view="${this.store.selected}"]`);
    }
    button?.setAttribute("aria-current", "true");
    for (const stop of list.querySelectorAll("[tabindex='0']")) stop.tabIndex = -1;
    const stop = button ?? list.querySelector("button");
    if (stop) stop.tabIndex = 0;
    if (reveal && button) this.#reveal(button);
  }

  /** Scrolls the list, and nothing but the list. */
  #reveal(button) {
    const box = this.find("list-box");
    const [top, bottom] = [button.offsetTop, button.offsetTop + button.offsetHeight];
    if (top < box.scrollTop) box.scrollTop = top;
    else if (bottom > box.scrollTop + box.clientHeight) box.scrollTop = bottom - box.clientHeight;
  }
}
