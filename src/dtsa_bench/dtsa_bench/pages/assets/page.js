"use strict";
/* What all pages share: elements, light and dark, and boxes that say what is out of sight. */

/* An element: el("div", {class: "a", onclick: f}, child, "text"). Text is never read as HTML. */
function el(name, attributes, ...children) {
  const svg = ["svg", "g", "path", "line", "rect", "text", "polyline", "circle"].includes(name);
  const node = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes || {})) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(key, value);
  }
  for (const child of children.flat()) if (child !== null && child !== undefined) node.append(child);
  return node;
}

/* ---- theme ---- */
const theme = {
  set(name) { document.documentElement.dataset.theme = name; this.cache = {}; },
  color(name) {
    this.cache[name] ??= getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
    return this.cache[name];
  },
  get dark() { return document.documentElement.dataset.theme === "dark"; },
  cache: {},
  changed() {}, // what a page draws again
};
theme.set(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
function setTheme(name) { theme.set(name); theme.changed(); }
function themeButton() {
  const name = () => theme.dark ? "Light" : "Dark", button = el("button", {type: "button", onclick: () => { setTheme(name().toLowerCase()); button.textContent = name(); }}, name());
  return button;
}
const printButton = () => el("button", {type: "button", onclick: () => print()}, "Print");
let beforePrint = null;
addEventListener("beforeprint", () => { beforePrint = document.documentElement.dataset.theme; setTheme("light"); });
addEventListener("afterprint", () => { if (beforePrint) setTheme(beforePrint); });

/* ---- boxes that scroll ---- */
/* A line above the box counts the columns and rows to the right and below that are out of sight. */
function watchScroll(box) {
  const hint = el("p", {class: "hint"}), count = (number, name) => `${number} more ${name}${number === 1 ? "" : "s"}`;
  const tell = () => {
    const view = box.getBoundingClientRect(), table = box.querySelector("table"), right = box.scrollWidth - box.clientWidth - box.scrollLeft > 1, below = box.scrollHeight - box.clientHeight - box.scrollTop > 1;
    const beyond = (cells, edge) => table ? [...cells].filter(cell => cell.getBoundingClientRect()[edge] > view[edge] + 2).length : 0;
    const columns = right && table ? beyond(table.rows[0].cells, "right") : 0, rows = below && table ? beyond(table.rows, "bottom") : 0;
    hint.textContent = [right && (columns ? `${count(columns, "column")} →` : "more →"), below && (rows ? `${count(rows, "row")} ↓` : "more ↓")].filter(Boolean).join("   ");
    hint.hidden = box.scrollWidth <= box.clientWidth + 1 && box.scrollHeight <= box.clientHeight + 1;
  };
  box.before(hint);
  box.addEventListener("scroll", tell, {passive: true});
  new ResizeObserver(tell).observe(box);
  tell();
}
