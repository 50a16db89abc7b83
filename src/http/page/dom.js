// Elements, numbers as people read them, and what is told to screen readers.

export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && !key.startsWith("aria") && key !== "list" && key !== "role") element[key] = value;
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((c) => c !== null && c !== undefined && c !== false));
  return element;
}

const live = () => document.getElementById("live");
let told = "";

/** Tells screen readers something, once. */
export function announce(text) {
  if (text === told || !live()) return;
  told = text;
  live().textContent = text;
}

export const count = (n) => Number(n).toLocaleString("en");

export function bytes(n) {
  for (const [unit, size] of [["GB", 1e9], ["MB", 1e6], ["kB", 1e3]]) if (n >= size) return `${significant(n / size)} ${unit}`;
  return `${count(n)} bytes`;
}

export function significant(n, digits = 3) {
  if (!Number.isFinite(n)) return "–";
  if (n !== 0 && (Math.abs(n) < 1e-3 || Math.abs(n) >= 1e7)) return n.toExponential(digits - 1);
  return Number(n.toPrecision(digits)).toLocaleString("en", { maximumSignificantDigits: digits });
}

export const percent = (fraction, digits = 1) => `${(100 * fraction).toLocaleString("en", { maximumFractionDigits: digits })} %`;

export const megapixels = (n) => (n >= 1e6 ? `${significant(n / 1e6)} MP` : `${count(n)} px`);

/** One of several buttons that exclude each other. */
export function segments(name, choices, chosen, onchange) {
  const buttons = choices.map(([value, label]) => h("button", { type: "button", "aria-pressed": String(value === chosen), "data-value": value,
    onclick: () => { mark(value); onchange(value); } }, label));
  const mark = (value) => buttons.forEach((b) => b.setAttribute("aria-pressed", String(b.dataset.value === value)));
  const element = h("div", { className: "seg", role: "group", "aria-label": name }, buttons);
  element.choose = mark;
  return element;
}

/** A list to choose from, with its name above it. */
export function choice(name, choices, chosen, onchange) {
  const id = `choice-${name.toLowerCase().replace(/\W+/g, "-")}`;
  const select = h("select", { id, onchange: () => onchange(select.value) });
  const fill = (list, value) => {
    select.replaceChildren(...list.map(([key, label]) => h("option", { value: key, selected: key === value }, label)));
  };
  fill(choices, chosen);
  const element = h("div", { className: "group" }, h("label", { className: "small", htmlFor: id }, name), select);
  element.fill = fill;
  element.select = select;
  return element;
}

export function check(name, checked, onchange, title) {
  const box = h("input", { type: "checkbox", checked, onchange: () => onchange(box.checked) });
  return h("label", { title }, box, name);
}
