// Helpers that make elements, and save and open files.

/** Makes an element: el("div.a.b", {title: "..."}, child, "text"). */
export function el(kind, props = {}, ...children) {
  const [tag, ...classes] = kind.split(".");
  const element = document.createElement(tag);
  element.className = classes.join(" ");
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(element.style, value);
    else if (name in element && name !== "list") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** An icon of strokes in a box of 24 x 24. */
export function icon(path) {
  const namespace = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(namespace, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  const stroke = document.createElementNS(namespace, "path");
  stroke.setAttribute("d", path);
  svg.append(stroke);
  return svg;
}

export const ICONS = {
  orbit: "M12 4a8 8 0 1 0 8 8M20 4v5h-5M12 9.5v5M9.5 12h5",
  pan: "M12 3v18M3 12h18M9 6l3-3 3 3M9 18l3 3 3-3M6 9l-3 3 3 3M18 9l3 3-3 3",
  fly: "M3 13l18-8-6 16-3.5-6.5z",
  window: "M12 3a9 9 0 1 0 0 18V3zM12 3a9 9 0 0 1 0 18",
  home: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5",
  ortho: "M4 8l8-4 8 4v8l-8 4-8-4zM4 8l8 4 8-4M12 12v8",
  camera: "M4 8h4l2-3h4l2 3h4v11H4zM12 16.5a3.5 3.5 0 1 0 0-7 3.5 3.5 0 0 0 0 7z",
  redo: "M15 7l5 5-5 5M20 12H10a6 6 0 0 0-6 6",
  slices: "M4 4h7v7H4zM13 4h7v7h-7zM4 13h7v7H4zM13 16.5l3.5-2 3.5 2v3l-3.5 2-3.5-2z",
  play: "M8 5l11 7-11 7z",
  stop: "M7 6v12M17 6v12",
  undo: "M9 7L4 12l5 5M4 12h10a6 6 0 0 1 6 6",
  save: "M12 4v11M8 11l4 4 4-4M4 20h16",
  open: "M12 15V4M8 8l4-4 4 4M4 20h16",
  panel: "M4 5h16v14H4zM15 5v14",
};

/** A button with an icon. */
export function iconButton(name, title, onclick) {
  const button = el("button.gv-icon", { title, onclick, type: "button", ariaLabel: title });
  button.append(icon(ICONS[name]));
  return button;
}

/** A small button with a text. */
export const textButton = (text, title, onclick) => el("button.gv-small", { type: "button", title, onclick }, text);

/** A menu of options, each shown as `name(option)`; `choose` takes the one that is chosen. */
export function menu(options, name, current, choose, title = "") {
  const select = el("select", { title, onchange: () => choose(options[select.selectedIndex]) }, ...options.map((option) => el("option", {}, name(option))));
  select.selectedIndex = Math.max(0, options.indexOf(current));
  return select;
}

/** Saves a file that the page made. */
export function saveFile(name, content, type) {
  const url = URL.createObjectURL(new Blob([content], { type }));
  el("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

/** Asks for a file; passes its name and text to `handler`. */
export function openText(accept, handler, fail) {
  const input = el("input", { type: "file", accept });
  input.onchange = async () => {
    try {
      handler(input.files[0].name, await input.files[0].text());
    } catch (error) {
      fail(`${input.files[0].name}: ${error.message}`);
    }
  };
  input.click();
}

/** Asks for a JSON file; passes its content to `handler`. */
export const openJson = (handler, fail) => openText(".json,application/json", (_, text) => handler(JSON.parse(text)), fail);
