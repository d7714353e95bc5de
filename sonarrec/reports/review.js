// Truth by eye. A pass is accepted, rejected, given another ID, split; outlines are dragged, placed and
// removed. Each is an entry of `work.done`; `fold` makes the passes from those of the page and these
// entries, so that undo is to leave the last one out, and only entries are kept in the browser.
const data = JSON.parse(document.getElementById("data").textContent);
const { fan, ids } = data;
const part = (id) => document.getElementById(id);
const view = new View(part("marks"), part("image"));
const damaged = new Set(data.damaged), shown = Object.keys(data.images).map(Number);
const last = data.first + data.frames - 1, column = (name) => data.header.indexOf(name);
const STEP_MS = 80, NEAR_PX = 0.5, key = `sonarrec review ${data.key}`;
const empty = () => ({ page: data.page, done: [], undone: [], seen: [] });

let work = empty(); // seen: numbers of frames that were on the screen
let passes = [], lost = 0; // as folded; entries on passes that this page does not have
let now = shown[0], chosen = null, range = "all", placing = null, hidden = false, timer = 0;
let seen = new Set(), refused = false, saved = true, earlier = null;

// Passes

function row(frame, x, y, more) {
  return { frame, x, y, visible: visibleShare(fan, x, y, data.radius_m), cells: null, moved: true, ...more };
}

/** Where something lies in a frame that lay at row a and lies at row b: on a straight line on the
    floor; in the image where the sonar's motion between them is not known. */
function between(a, b, frame) {
  const share = (frame - a.frame) / (b.frame - a.frame), mix = (p, q) => p.map((v, n) => v + share * (q[n] - v));
  const poses = [a.frame, b.frame, frame].map((n) => data.poses[n]);
  const floors = [a, b].map((one) => floorFromPixel(fan, one.x, one.y));
  if (poses.some((pose) => !pose || pose[3] !== poses[0][3]) || floors.flat().some(Number.isNaN)) {
    return mix([a.x, a.y], [b.x, b.y]);
  }
  const turn = ([yaw]) => [Math.cos(yaw * Math.PI / 180), Math.sin(yaw * Math.PI / 180)];
  const [p, q] = floors.map(([right, ahead], n) => {
    const [cos, sin] = turn(poses[n]);
    return [poses[n][1] + right * cos + ahead * sin, poses[n][2] - right * sin + ahead * cos];
  });
  const [x, y] = mix(p, q).map((v, n) => v - poses[2][n + 1]), [cos, sin] = turn(poses[2]);
  return pixelFromFloor(fan, x * cos - y * sin, x * sin + y * cos);
}

/** The rows with a key frame at a pixel, and what lies between it and its neighbours drawn anew. */
function withKey(rows, frame, x, y) {
  const keys = rows.filter((one) => one.key && one.frame !== frame);
  const made = row(frame, x, y, { key: true }), found = new Map(rows.map((one) => [one.frame, one]));
  found.set(frame, made);
  const before = keys.findLast((one) => one.frame < frame), after = keys.find((one) => one.frame > frame);
  for (const [a, b] of [[before, made], [made, after]]) {
    for (let n = a && b ? a.frame + 1 : Infinity; n < b?.frame; n++) {
      if (!damaged.has(n)) found.set(n, row(n, ...between(a, b, n)));
    }
  }
  return [...found.values()].filter((one) => one.visible > 0 || one.key).sort((a, b) => a.frame - b.frame);
}

/** The frames in the page before and after one. */
const around = (frame) => [shown.findLast((n) => n < frame) ?? -Infinity, shown.find((n) => n > frame) ?? Infinity];

/** The rows with one moved to a pixel, and those near it that are not in the page by a part of that. */
function moved(rows, frame, x, y) {
  const from = rows.find((one) => one.frame === frame), [before, after] = around(frame);
  return rows.map((one) => {
    const end = one.frame < frame ? before : after;
    const share = one.frame === frame ? 1 : Number.isFinite(end) ? (one.frame - end) / (frame - end) : 1;
    const taken = !from || share <= 0 || one.frame <= before || one.frame >= after;
    return taken ? one : { ...one, ...row(one.frame, one.x + share * (x - from.x), one.y + share * (y - from.y)), cells: one.cells };
  });
}

/** The part of a pass that an entry is on; the other part becomes a pass of its own. */
function split(made, entry) {
  const pass = made.get(entry.pass), first = entry.from ?? (entry.to === undefined ? undefined : entry.to + 1);
  if (!pass || first === undefined) return pass;
  const [early, late] = [pass.rows.filter((one) => one.frame < first), pass.rows.filter((one) => one.frame >= first)];
  if (!early.length || !late.length) return pass;
  const head = { ...pass, rows: early }, tail = { ...pass, id: `${pass.id}>${first}`, rows: late };
  made.set(head.id, head).set(tail.id, tail);
  return entry.from === undefined ? head : tail;
}

const entries = {
  set(made, entry) {
    const pass = split(made, entry), { state = pass?.state, landmark = pass?.landmark } = entry;
    if (pass) made.set(pass.id, { ...pass, state, landmark });
    return pass;
  },
  add(made, { pass, landmark, frame, x, y }) {
    const rows = withKey([], frame, x, y);
    return made.set(pass, { id: pass, landmark, rows, state: "accepted", origin: "drawn", why: "", drawn: true });
  },
  move(made, { pass, frame, x, y }) {
    const of = made.get(pass);
    if (of) made.set(pass, { ...of, rows: (of.drawn ? withKey : moved)(of.rows, frame, x, y) });
    return of;
  },
  remove(made, { pass, frame }) {
    const of = made.get(pass), [before, after] = around(frame);
    const near = (n) => n > before && n < after && 2 * n > before + frame && 2 * n < after + frame;
    if (of) made.set(pass, { ...of, rows: of.rows.filter((one) => one.frame !== frame && !near(one.frame)) });
    return of;
  },
};

function fold() {
  const made = new Map(data.passes.map((pass) => [pass.id, pass]));
  lost = work.done.filter((entry) => !entries[entry.kind](made, entry)).length;
  passes = [...made.values()].filter((pass) => pass.rows.length);
}

/** Decide: an entry, which is kept; what was undone is gone. */
function decide(entry) {
  work.done.push(entry);
  work.undone = [];
  saved = false;
  keep();
  fold();
  render();
}

// What is kept in the browser, and what is saved

function keep() {
  work.seen = [...seen];
  try {
    localStorage.setItem(key, JSON.stringify(work));
  } catch {
    refused = true;
  }
}

function csv() {
  const name = (cell) => (/[",\r\n]|^ /.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);
  const lines = data.kept.map(([frame, cells]) => [frame ?? Infinity, 0, cells]);
  for (const pass of passes) {
    if (pass.state === "rejected" || (pass.left_out && pass.state === "open")) continue;
    for (const one of pass.rows) {
      const cells = one.cells ? [...one.cells] : data.header.map((head) => (head === "log" ? data.log : ""));
      if (!one.cells) cells[column("frame")] = String(one.frame);
      cells[column("landmark")] = String(pass.landmark);
      if (one.moved) {
        cells[column("x_px")] = one.x.toFixed(2);
        cells[column("y_px")] = one.y.toFixed(2);
        cells[column("visible")] = one.visible.toFixed(3);
      }
      if (one.moved || pass.state === "accepted") cells[column("source")] = "";
      if (one.visible > 0) lines.push([one.frame, pass.landmark, cells]);
    }
  }
  lines.sort((a, b) => (a[0] === b[0] ? 0 : a[0] - b[0]) || a[1] - b[1]);
  return [data.header, ...lines.map((line) => line[2])].map((cells) => cells.map(name).join(",") + "\n").join("");
}

const count = (n, noun, ending = "s") => `${n} ${noun}${n === 1 ? "" : ending}`;
const unseen = () => data.frames - damaged.size - seen.size;

function left() {
  const open = passes.filter((pass) => pass.state === "open"), out = open.filter((pass) => pass.left_out).length;
  const of = open.length ? `${count(open.length, "pass", "es")} open${out ? ` (${out} not saved while open)` : ""}` : "No pass is open";
  return `${of}; ${unseen() ? `${count(unseen(), "frame")} not yet seen` : "all frames seen"}`;
}

// The screen

const say = (text) => { part("say").textContent = text; };
const current = () => passes.find((pass) => pass.id === chosen);
const colour = (landmark) => ids.indexOf(landmark);

function outline(one) {
  const [right, ahead] = floorFromPixel(fan, one.x, one.y), points = [];
  // Nearer than the floor it has the shape of one at the nearest floor.
  const steep = Math.hypot(right, ahead) > 0.32 * fan.depth_m;
  const floor = steep ? [right, ahead] : [0, 0.32 * fan.depth_m];
  const drawn = pixelFromFloor(fan, ...floor);
  for (let n = 0; n < 48; n++) {
    const angle = n * Math.PI / 24, r = data.radius_m;
    const [x, y] = pixelFromFloor(fan, floor[0] + r * Math.cos(angle), floor[1] + r * Math.sin(angle));
    points.push([x + one.x - drawn[0], y + one.y - drawn[1]]);
  }
  return points;
}

const cornersOf = (pass, one) => (!one.moved && pass.corners?.[one.frame]) || outline(one);

function frame() {
  part("title").textContent = `Frame ${now}`;
  part("of").textContent = `of ${data.first} to ${last}` + (placing ? `; placing ID.${placing.landmark}` : "");
  const source = data.images[now];
  if (source) part("image").src = source;
  part("image").style.visibility = source ? "" : "hidden";
  part("grey").hidden = Boolean(source);
  part("grey").textContent = damaged.has(now) ? "This frame cannot be read." : "This frame is not in this page.";
  part("image").alt = `Sonar image, frame ${now}`;
  if (source) seen.add(now);
  view.begin(fan.columns, fan.rows);
  for (const pass of hidden ? [] : passes) {
    const one = pass.rows.find((other) => other.frame === now);
    if (!one) continue;
    const label = `ID.${pass.landmark}${pass.state === "open" ? "?" : ""}`;
    const kind = `declared ${pass.state}${pass.id === chosen ? " chosen" : ""}`;
    view.mark({ corners: cornersOf(pass, one), label, colour: colour(pass.landmark) }, kind);
  }
  strip();
  const pass = current(), of = pass && `${pass.rows[0].frame} to ${pass.rows.at(-1).frame}`;
  part("pass").textContent = pass ? `ID.${pass.landmark}, frames ${of}, ${pass.state}` : "No pass is chosen.";
  part("left").textContent = left();
}

function strip() {
  const svg = part("strip"), add = (x, width, y, height, kind, k) => {
    const rect = document.createElementNS("http://www.w3.org/2000/svg", "rect");
    Object.entries({ x, y, width, height, class: kind, style: k === undefined ? "" : `--c: var(--bright-${k})` })
      .forEach(([name, value]) => rect.setAttribute(name, value));
    svg.append(rect);
  };
  svg.replaceChildren();
  const ends = [];
  for (let n = data.first, from = n; n <= last; n++) {
    const kind = (m) => (damaged.has(m) ? "damaged" : seen.has(m) ? "seen" : data.images[m] ? "unseen" : "absent");
    if (n === last || kind(n + 1) !== kind(n)) {
      add(from, n + 1 - from, 0, 1, kind(n));
      from = n + 1;
    }
  }
  for (const pass of [...passes].sort((a, b) => a.rows[0].frame - b.rows[0].frame)) {
    const [from, to] = [pass.rows[0].frame, pass.rows.at(-1).frame];
    let lane = ends.findIndex((end) => end < from);
    if (lane < 0) lane = ends.length;
    ends[lane] = to;
    add(from, to + 1 - from, 1.6 + lane, 0.7, `pass ${pass.state}${pass.id === chosen ? " chosen" : ""}`, colour(pass.landmark));
  }
  add(now, 1, 0, 1.6 + ends.length, "now");
  svg.setAttribute("viewBox", `${data.first} 0 ${data.frames} ${1.6 + ends.length}`);
  svg.style.height = `${12 * (1.6 + ends.length)}px`;
}

const pictures = new Map();

/** A small picture of a pass, from the frame in the page nearest to its middle. */
function picture(pass) {
  if (pictures.has(pass.id)) return pictures.get(pass.id);
  const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 64 });
  const rows = pass.rows.filter((one) => data.images[one.frame]), one = rows[Math.floor(rows.length / 2)];
  pictures.set(pass.id, canvas);
  if (one) {
    const image = new Image(), size = 2.6 * data.radius_m / fan.metres_per_pixel;
    image.onload = () => canvas.getContext("2d").drawImage(image, one.x - size / 2, one.y - size / 2, size, size, 0, 0, 64, 64);
    image.src = data.images[one.frame];
  }
  return canvas;
}

function list() {
  part("list").replaceChildren(...passes.map((pass) => {
    const item = document.createElement("li"), button = document.createElement("button");
    const text = document.createElement("span"), head = document.createElement("b"), mark = document.createElement("i");
    head.textContent = `ID.${pass.landmark}`;
    mark.style.setProperty("--c", `var(--bright-${colour(pass.landmark)})`);
    const belief = pass.drawn ? "drawn" : `least belief ${pass.belief.toFixed(2)}`;
    const lines = [`frames ${pass.rows[0].frame} to ${pass.rows.at(-1).frame}`, `${pass.origin}${pass.drawn ? "" : `, ${belief}`}`];
    text.append(mark, head, ...[...lines, pass.why].filter(Boolean).flatMap((line, n) => {
      const small = Object.assign(document.createElement("small"), { textContent: line, className: n === 2 ? "why" : "" });
      return [small];
    }));
    const state = Object.assign(document.createElement("em"), { textContent: pass.state });
    button.type = "button";
    button.className = `${pass.state}${pass.id === chosen ? " chosen" : ""}`;
    button.dataset.pass = pass.id;
    button.append(picture(pass), text, state);
    item.append(button);
    return item;
  }));
  part("list").querySelector(".chosen")?.scrollIntoView({ block: "nearest" });
}

function render() {
  if (!current()) chosen = passes[0]?.id ?? null;
  list();
  const states = ["open", "accepted", "rejected"], of = (state) => passes.filter((pass) => pass.state === state).length;
  part("shares").replaceChildren(...states.map((state) => {
    const share = Object.assign(document.createElement("i"), { className: state, title: `${of(state)} ${state}` });
    share.style.flexGrow = of(state);
    return share;
  }));
  for (const name of ["all", "from", "to"]) {
    document.querySelector(`[data-act=${name}]`).setAttribute("aria-pressed", String(range === name));
  }
  document.querySelector("[data-act=undo]").disabled = !work.done.length;
  document.querySelector("[data-act=redo]").disabled = !work.undone.length;
  document.querySelector("[data-act=place]").setAttribute("aria-pressed", String(Boolean(placing)));
  frame();
}

// What a person does

function choose(id, jump = true) {
  chosen = id;
  const rows = current()?.rows ?? [];
  const first = rows.find((one) => data.images[one.frame]) ?? rows[0];
  if (jump && first && !rows.some((one) => one.frame === now)) now = first.frame;
  render();
}

function go(n) {
  now = Math.min(last, Math.max(data.first, n));
  frame();
  keep();
}

/** The next frame in the page, or the next that is grey; by -1 the one before. */
function step(by) {
  let n = now + by;
  while (n > data.first && n < last && !data.images[n] && !damaged.has(n)) n += by;
  go(n);
}

function stop() {
  clearInterval(timer);
  timer = 0;
  document.querySelector("[data-act=play]").setAttribute("aria-pressed", "false");
}

function set(values) {
  const pass = current();
  if (!pass) return say("Choose a pass first.");
  const of = range === "from" ? { from: now } : range === "to" ? { to: now } : {};
  range = "all";
  decide({ kind: "set", pass: pass.id, ...of, ...values });
  say(`ID.${pass.landmark}, frames ${pass.rows[0].frame} to ${pass.rows.at(-1).frame}: ${Object.values(values).join(" as ID.")}.`);
  const order = passes.findIndex((one) => one.id === pass.id), after = [...passes.slice(order + 1), ...passes.slice(0, order)];
  const next = after.find((one) => one.state === "open");
  if (next && values.state !== "open") choose(next.id);
}

const acts = {
  undo() { if (work.done.length) change(work.done, work.undone, "Taken back."); },
  redo() { if (work.undone.length) change(work.undone, work.done, "Decided again."); },
  accept() { set({ state: "accepted" }); },
  reject() { set({ state: "rejected" }); },
  reopen() { set({ state: "open" }); },
  all() { range = "all"; render(); },
  from() { range = range === "from" ? "all" : "from"; render(); },
  to() { range = range === "to" ? "all" : "to"; render(); },
  before(event) { step(event.shiftKey ? -10 : -1); },
  next(event) { step(event.shiftKey ? 10 : 1); },
  hide() { hidden = !hidden; frame(); },
  fit() { Object.assign(view, { zoom: 1, left: 0, top: 0 }); frame(); },
  bigger() { view.scale(1.25); frame(); },
  smaller() { view.scale(0.8); frame(); },
  first() { go(current()?.rows[0].frame ?? data.first); },
  last() { go(current()?.rows.at(-1).frame ?? last); },
  up() { other(-1); },
  down() { other(1); },
  play() {
    if (timer) return stop();
    const rows = current()?.rows ?? [], end = rows.length ? rows.at(-1).frame : last;
    if (rows.length && (now < rows[0].frame || now >= end)) go(rows[0].frame);
    document.querySelector("[data-act=play]").setAttribute("aria-pressed", "true");
    timer = setInterval(() => (now < end ? step(1) : stop()), STEP_MS);
  },
  place() {
    placing = placing ? null : { landmark: current()?.landmark ?? ids[0], pass: null };
    if (placing) chosen = null;
    say(placing ? `Type its ID, or it is ID.${placing.landmark}. Click its centre; then go to another frame and click it there.` : "");
    render();
  },
  done() { if (placing) acts.place(); },
  remove() {
    const pass = current();
    if (!pass?.rows.some((one) => one.frame === now)) return say("The chosen pass has no outline in this frame.");
    decide({ kind: "remove", pass: pass.id, frame: now });
  },
  save() {
    const link = document.createElement("a"), text = csv();
    link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
    link.download = "gt.csv";
    link.click();
    saved = true;
    say(`gt.csv saved, ${count(text.trim().split("\n").length - 1, "row")}. ${left()}.`);
  },
  take() { work = { ...earlier, page: data.page }; begin(); },
  leave() { work = empty(); begin(); keep(); },
};

function change(from, to, text) {
  const entry = from.pop();
  to.push(entry);
  saved = false;
  keep();
  fold();
  say(text);
  if (passes.some((pass) => pass.id === entry.pass)) chosen = entry.pass;
  if (entry.frame !== undefined) now = entry.frame;
  render();
}

function other(by) {
  const order = passes.findIndex((pass) => pass.id === chosen);
  if (passes.length) choose(passes[(order + by + passes.length) % passes.length].id);
}

function name(landmark) {
  if (!placing) return set({ state: "accepted", landmark });
  placing.landmark = landmark;
  if (placing.pass) decide({ kind: "set", pass: placing.pass, landmark });
  else frame();
}

/** A press takes the outline beneath it; where one is placed it places. */
view.press = (x, y) => {
  if (placing) {
    let at = [x, y];
    return {
      move: (...to) => { at = to; },
      end() {
        const pass = placing.pass ?? `d${now}.${work.done.length}`, to = { pass, frame: now, x: at[0], y: at[1] };
        chosen = pass;
        decide(placing.pass ? { kind: "move", ...to } : { kind: "add", landmark: placing.landmark, ...to });
        say(placing.pass ? "Drawn. Enter ends, or click in more frames." : "Now click it in another frame.");
        placing.pass = pass;
      },
    };
  }
  const here = passes.flatMap((pass) => {
    const one = pass.rows.find((each) => each.frame === now);
    return one ? [{ pass, one, points: cornersOf(pass, one) }] : [];
  });
  const inside = ({ points }) => points.reduce((odd, [px, py], n) => {
    const [qx, qy] = points[(n || points.length) - 1];
    return (py > y) !== (qy > y) && x < px + (qx - px) * (y - py) / (qy - py) ? !odd : odd;
  }, false);
  const found = here.filter(inside).sort((a, b) => (b.pass.id === chosen) - (a.pass.id === chosen))[0];
  if (!found || hidden) return null;
  const { pass, one } = found, off = () => Math.hypot(to[0] - one.x, to[1] - one.y) > NEAR_PX;
  let to = [one.x, one.y];
  choose(pass.id, false);
  return {
    move(px, py) {
      if (pass.corners?.[now] && !one.moved) return say("Plates are not dragged.");
      to = [one.x + px - x, one.y + py - y];
      frame();
      view.mark({ corners: outline(row(now, ...to)), label: "", colour: colour(pass.landmark) }, "declared accepted chosen");
    },
    end() { if (off()) decide({ kind: "move", pass: pass.id, frame: now, x: to[0], y: to[1] }); },
  };
};

let typed = "", wait = 0;

/** A digit of an ID: it counts when no longer ID begins with what was typed. */
function digit(key) {
  clearTimeout(wait);
  typed += key;
  const use = () => { const id = Number(typed); typed = ""; if (ids.includes(id)) name(id); else say(`There is no ID.${id}.`); };
  if (ids.some((id) => String(id) !== typed && String(id).startsWith(typed))) wait = setTimeout(use, 700);
  else use();
}

const keys = { ArrowUp: "up", ArrowDown: "down", Home: "first", End: "last", "+": "bigger", "-": "smaller", Enter: "done", Escape: "done" };
for (const button of document.querySelectorAll("[data-keys]")) {
  for (const name of button.dataset.keys.split(" ")) keys[name === "Space" ? " " : name] = button.dataset.act;
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const onButton = event.target.closest("button, summary") && event.target.matches(":focus-visible");
  if (onButton && [" ", "Enter"].includes(event.key)) return;
  const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (act) acts[act](event);
  else if (/^\d$/.test(event.key)) digit(event.key);
  else return;
  event.preventDefault();
});

document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button) return;
  if (event.detail) button.blur(); // so that space plays
  if (button.dataset.act) acts[button.dataset.act](event);
  if (button.dataset.id) name(Number(button.dataset.id));
  if (button.dataset.pass) choose(button.dataset.pass);
});

part("strip").addEventListener("pointerdown", (event) => {
  const to = ({ clientX }) => {
    const box = part("strip").getBoundingClientRect();
    go(data.first + Math.floor((clientX - box.left) / box.width * data.frames));
  };
  part("strip").setPointerCapture(event.pointerId);
  part("strip").onpointermove = to;
  part("strip").onpointerup = () => { part("strip").onpointermove = null; };
  to(event);
});

addEventListener("beforeunload", (event) => { if (refused && !saved) event.preventDefault(); });

function begin() {
  part("offer").hidden = true;
  seen = new Set(work.seen);
  fold();
  if (lost) say(`${count(lost, "earlier decision")} on passes that this page does not have: left out.`);
  choose((passes.find((pass) => pass.state === "open") ?? passes[0])?.id ?? null);
}

try {
  earlier = JSON.parse(localStorage.getItem(key));
} catch {
  refused = true;
}
if (earlier?.page === data.page) work = earlier;
begin();
if (earlier && earlier.page !== data.page && earlier.done.length) {
  part("offer").hidden = false;
  part("offer").querySelector("p").textContent = `This browser holds ${count(earlier.done.length, "decision")} from an earlier page of this log.`;
} else keep();
if (refused) say("This browser keeps nothing of this page: save gt.csv before you leave it.");
