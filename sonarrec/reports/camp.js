// The start page: for each log what the browser keeps of its page, else what a saved table says.
"use strict";
const logs = JSON.parse(document.getElementById("data").textContent), tables = new Map();
const part = (id) => document.getElementById(id);

/** The decisions that the page of a log keeps in this browser; null if there are none. */
function kept({ key }) {
  try {
    return JSON.parse(localStorage.getItem(`sonarrec review ${key}`))?.counts ?? null;
  } catch { return null; }
}

/** The cells of each line; one in quotes may hold commas, quotes and line ends. */
function cellsOf(text) {
  const lines = [[]];
  for (const [, quoted, plain, end] of text.matchAll(/(?:"((?:[^"]|"")*)"|([^,\r\n]*))(,|\r?\n|$)/g)) {
    lines.at(-1).push(quoted?.replaceAll('""', '"') ?? plain);
    if (end !== ",") lines.push([]);
  }
  return lines.filter((cells) => cells.length > 1);
}

/** Of a saved table: its rows, and its passes that are decided and left. */
function countsOf(text) {
  const [header, ...rows] = cellsOf(text), column = (name) => header.indexOf(name);
  const passes = [true, false].map((isOpen) => {
    const of = rows.filter((cells) => Boolean(cells[column("source")]) === isOpen);
    return new Set(of.map((cells) => `${cells[column("landmark")]} ${cells[column("track")]}`)).size;
  });
  return { open: passes[0], decided: passes[1], passes: passes[0] + passes[1], rows: rows.length };
}

function show() {
  let done = 0, met = 0;
  logs.forEach((log, n) => {
    const row = document.querySelector(`[data-log="${n}"]`), table = tables.get(log.gt_name);
    const counts = kept(log) ?? table, cell = (name) => row.querySelector(`.${name}`);
    for (const name of ["passes", "decided", "open", "unseen"]) if (counts) cell(name).textContent = counts[name] ?? "?";
    cell("saved").textContent = table ? `${table.rows} rows read` : counts?.saved ? "saved" : "";
    row.classList.toggle("done", cell("open").textContent === "0");
    done += cell("open").textContent === "0";
    met += Boolean(counts);
  });
  part("left").textContent = `${done} of ${logs.length} logs have no pass left`;
  const why = "Nothing is known here of the pages: none was opened, or this browser shares no storage between pages";
  part("where").textContent = met ? "" : `${why} from a disk. Then choose the saved tables.`;
}

async function read(files) {
  const unknown = [];
  for (const file of files) {
    const name = file.name.replace(/ ?\(\d+\)(?=\.csv$)/, ""); // of a second download
    if (logs.some((log) => log.gt_name === name)) tables.set(name, countsOf(await file.text()));
    else unknown.push(file.name);
  }
  show();
  if (unknown.length) part("where").textContent = `Of none of these logs: ${unknown.join(", ")}.`;
}

part("files").addEventListener("change", (event) => read(event.target.files));
for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => {
  event.preventDefault();
  if (kind === "drop") read(event.dataTransfer.files);
});
for (const kind of ["storage", "focus", "pageshow"]) addEventListener(kind, show);
show();
