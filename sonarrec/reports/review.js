// Truth by eye. A pass is accepted, rejected, given another ID, split; outlines are dragged, placed and
// removed. Each is an entry of `work.done`; `fold` makes the passes from those of the page and these
// entries, so that undo is to leave the last one out, and only entries are kept in the browser.
const data = JSON.parse(document.getElementById("data").textContent);
const { fan, ids, images, radius_m } = data, last = data.first + data.frames - 1, key = `sonarrec review ${data.key}`;
const damaged = new Set(data.damaged), shown = Object.keys(images).map(Number);
const part = (id) => document.getElementById(id), button = (act) => document.querySelector(`[data-act=${act}]`);
const view = new View(part("marks"), part("image"));
const STEP_MS = 80, NEAR_PX = 0.5, WAIT_MS = 700, FAR = 1e9;
const nothing = () => ({ page: data.page, done: [], undone: [], seen: [] });
let work = nothing(), seen = new Set(); // seen: frames that were on the screen
let passes = [], lost = 0, doubled = ""; // as folded; entries on passes that this page lacks; see onOneSpot
let now = shown[0], chosen = null, range = "all", placing = null, hidden = false;
let saved = true, timer = 0, typed = "", wait = 0;

// The passes
const placed = (frame, x, y, more) => ({ frame, x, y, visible: visibleShare(fan, x, y, radius_m), moved: true, ...more });

/** The pixel in a frame of what lies at a in one frame and at b in another: on a straight line on the
    floor; in the image where the sonar's motion from one to the other is not known. */
function between(a, b, frame) {
  const mix = (p, q) => p.map((v, n) => v + (frame - a.frame) / (b.frame - a.frame) * (q[n] - v));
  const poses = [a.frame, b.frame, frame].map((n) => data.poses[n]), [, , x, y, stretch] = poses[2] ?? [];
  const floors = [a, b].map((one) => floorFromPixel(fan, one.x, one.y));
  const known = stretch !== undefined && poses.every((pose) => pose?.[4] === stretch);
  if (!known || floors.flat().some(Number.isNaN)) return mix([a.x, a.y], [b.x, b.y]);
  const rotated = ([right, ahead], [cos, sin]) => [right * cos + ahead * sin, ahead * cos - right * sin];
  const still = floors.map((floor, n) => rotated(floor, poses[n]).map((v, axis) => v + poses[n][2 + axis]));
  const [east, north] = mix(...still), [cos, sin] = poses[2];
  return pixelFromFloor(fan, ...rotated([east - x, north - y], [cos, -sin]));
}

/** Drawn rows with a key frame at a pixel; those from it to the key frames about it are drawn anew. */
function withKey(rows, frame, x, y) {
  const keys = rows.filter((one) => one.key && one.frame !== frame), made = placed(frame, x, y, { key: true });
  const found = new Map(rows.map((one) => [one.frame, one])).set(frame, made);
  const before = keys.findLast((one) => one.frame < frame), after = keys.find((one) => one.frame > frame);
  for (const [a, b] of [[before, made], [made, after]].filter((pair) => pair[0] && pair[1])) {
    for (let n = a.frame + 1; n < b.frame; n++) if (!damaged.has(n)) found.set(n, placed(n, ...between(a, b, n)));
  }
  return [...found.values()].sort((one, other) => one.frame - other.frame);
}

/** How much a row in frame n follows a change in a frame: 1 there, 0 in the next frames in the page. */
function weight(n, frame) {
  const before = shown.findLast((m) => m < frame) ?? -FAR, after = shown.find((m) => m > frame) ?? FAR;
  return Math.max(0, Math.min((n - before) / (frame - before), (after - n) / (after - frame)));
}

/** Rows with the one in a frame moved to a pixel; those that are not in the page follow it. */
const moved = (rows, frame, x, y, from = rows.find((one) => one.frame === frame) ?? { x, y }) => rows.map((one) => {
  const share = weight(one.frame, frame), to = [one.x + share * (x - from.x), one.y + share * (y - from.y)];
  return share ? { ...one, ...placed(one.frame, ...to) } : one;
});

/** The pass an entry is on, or the part of it; then the other part becomes a pass of its own. */
function partOf(made, { pass: id, from, to }) {
  const pass = made.get(id), first = from ?? to + 1;
  const [early, late] = [true, false].map((before) => pass?.rows.filter((one) => one.frame < first === before));
  if (!early?.length || !late.length) return pass;
  const head = { ...pass, rows: early }, tail = { ...pass, rows: late, id: `${id}>${first}` };
  made.set(head.id, head).set(tail.id, tail);
  return from === undefined ? head : tail;
}

/** What each kind of entry does to a pass. */
const entries = {
  set: (pass, { state = pass.state, landmark = pass.landmark }) => ({ state, landmark }),
  move: (pass, { frame, x, y }) => ({ rows: (pass.drawn ? withKey : moved)(pass.rows, frame, x, y) }),
  remove: (pass, { frame }) => ({ rows: pass.rows.filter((one) => weight(one.frame, frame) <= 0.5) }),
};

function fold() {
  const made = new Map(data.passes.map((pass) => [pass.id, pass])), order = [...made.keys()];
  lost = 0;
  for (const entry of work.done) {
    const { pass: id, landmark, drawn } = entry, isNew = drawn && !made.has(id);
    const pass = isNew ? { id, landmark, drawn, rows: [], state: "accepted", origin: "drawn" } : partOf(made, entry);
    if (pass) made.set(pass.id, { ...pass, ...entries[entry.kind](pass, entry) });
    else lost++;
  }
  const place = (pass) => (order.indexOf(pass.id.split(">")[0]) + 1 || FAR) + pass.rows[0].frame / FAR;
  passes = [...made.values()].filter((pass) => pass.rows.length).sort((a, b) => place(a) - place(b));
  doubled = onOneSpot();
}

/** A warning if two accepted passes are within half a radius of each other in a frame, else "". */
function onOneSpot() {
  const byFrame = new Map();
  for (const { landmark, rows } of inState("accepted")) for (const { frame, x, y } of rows) {
    const floor = floorFromPixel(fan, x, y), others = byFrame.get(frame) ?? [];
    const other = others.find((one) => Math.hypot(one.floor[0] - floor[0], one.floor[1] - floor[1]) < radius_m / 2);
    if (other) return `. ID.${other.landmark} and ID.${landmark} are accepted on the same spot in frame ${frame}: reject one`;
    byFrame.set(frame, [...others, { landmark, floor }]);
  }
  return "";
}

// What is decided, kept in the browser, and saved
const say = (text) => { part("say").textContent = text; };
const decide = (entry) => { work.done.push(entry); work.undone = []; changed(""); };
const storage = (use) => { try { return use(localStorage); } catch { part("refused").hidden = false; } };
const keep = () => storage((kept) => kept.setItem(key, JSON.stringify({ ...work, seen: [...seen] })));

function changed(text) {
  saved = false;
  fold();
  render();
  keep();
  say(text);
}

function back(from, to, text) {
  if (!from.length) return;
  to.push(from.pop());
  ({ pass: chosen, frame: now = now } = to.at(-1));
  changed(text);
  choose(chosen);
}

function csv() {
  const cell = (text) => (/[",\r\n]|^\s/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const lines = data.kept.map(([frame, cells]) => [frame ?? FAR, 0, cells]);
  for (const { state, landmark, left_out, rows } of passes) {
    if (state === "rejected" || (left_out && state === "open")) continue;
    for (const one of rows.filter((each) => each.visible > 0 || !each.moved)) {
      const { frame, x, y, visible } = one, values = { landmark };
      if (one.moved) Object.assign(values, { frame, x_px: x.toFixed(2), y_px: y.toFixed(2), visible: visible.toFixed(3) });
      if (one.moved || state === "accepted") values.source = "";
      const came = one.cells ?? data.header.map((name) => (name === "log" ? data.log : ""));
      lines.push([one.frame, landmark, data.header.map((name, n) => String(values[name] ?? came[n]))]);
    }
  }
  lines.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  return [data.header, ...lines.map((line) => line[2])].map((cells) => cells.map(cell).join(",") + "\n");
}

// The screen
const count = (n, noun, ending = "s") => `${n} ${noun}${n === 1 ? "" : ending}`;
const inState = (state) => passes.filter((pass) => pass.state === state);
const current = () => passes.find((pass) => pass.id === chosen);
const tint = (landmark) => `--c: var(--bright-${ids.indexOf(landmark)})`;
const at = (pass, frame) => pass.rows.find((one) => one.frame === frame);
function spanOf(pass, { from = -Infinity, to = Infinity } = {}) {
  const rows = pass.rows.filter((one) => one.frame >= from && one.frame <= to);
  return `frames ${rows[0]?.frame ?? now} to ${rows.at(-1)?.frame ?? now}`;
}

function left() {
  const open = inState("open"), out = open.filter((pass) => pass.left_out).length;
  const unseen = data.frames - damaged.size - seen.size;
  const of = `${count(open.length, "pass", "es")} open${out ? ` (${out} not saved while open)` : ""}`;
  return `${open.length ? of : "No pass is open"}; ${unseen ? count(unseen, "frame") + " not seen" : "all frames seen"}${doubled}`;
}

/** The corners of a plate, else the edge of a disc; nearer than the floor that at the nearest floor. */
function outline({ corners }, { x, y, frame, moved }) {
  if (corners?.[frame] && !moved) return corners[frame];
  let floor = floorFromPixel(fan, x, y);
  const steepest = Math.sqrt(1.05 ** 2 - 1) * fan.depth_m;
  if (!(Math.hypot(...floor) > steepest)) floor = [0, steepest];
  const [column, row] = pixelFromFloor(fan, ...floor);
  return Array.from({ length: 48 }, (_, n) => {
    const [right, ahead] = [Math.cos, Math.sin].map((of, axis) => floor[axis] + radius_m * of(n * Math.PI / 24));
    return pixelFromFloor(fan, right, ahead).map((v, axis) => v + (axis ? y - row : x - column));
  });
}

function frame() {
  const held = images[now], pass = current();
  if (held) part("image").src = held;
  if (held) seen.add(now);
  part("title").textContent = `Frame ${now}`;
  part("of").textContent = `of ${data.first} to ${last}` + (placing ? `; placing ID.${placing.landmark}` : "");
  part("grey").hidden = Boolean(held);
  part("grey").textContent = damaged.has(now) ? "This frame cannot be read." : "This frame is not in this page.";
  part("pass").textContent = pass ? `ID.${pass.landmark}, ${spanOf(pass)}, ${pass.state}` : "No pass is chosen.";
  part("left").textContent = left();
  view.begin(fan.columns, fan.rows);
  for (const one of hidden ? [] : passes.filter((each) => at(each, now))) {
    const label = `ID.${one.landmark}${one.state === "open" ? "?" : ""}`, corners = outline(one, at(one, now));
    const kind = `declared ${one.state}${one.id === chosen ? " chosen" : ""}`;
    view.mark({ corners, label, colour: ids.indexOf(one.landmark), pass: one.id }, kind);
  }
  strip();
}

/** The bar of frames: which were seen, a line for each pass, and which is shown. */
function strip() {
  const svg = part("strip"), lanes = [...new Set(passes.map((pass) => pass.landmark))], height = 1.6 + lanes.length;
  const add = (x, end, y, height, look) => drawn(svg, "rect", { x, width: end - x, y, height, ...look });
  const kindOf = (n) => (damaged.has(n) ? "damaged" : seen.has(n) ? "seen" : images[n] ? "unseen" : "absent");
  svg.replaceChildren();
  for (let n = data.first, from = n; n <= last; n++) {
    if (n < last && kindOf(n + 1) === kindOf(n)) continue;
    add(from, n + 1, 0, 1, { class: kindOf(n) });
    from = n + 1;
  }
  for (const { id, rows, state, landmark } of passes) {
    const look = { class: `pass ${state}${id === chosen ? " chosen" : ""}`, style: tint(landmark) };
    add(rows[0].frame, rows.at(-1).frame + 1, 1.6 + lanes.indexOf(landmark), 0.7, look);
  }
  add(now, now + 1, 0, height, { class: "now" });
  svg.setAttribute("viewBox", `${data.first} 0 ${data.frames} ${height}`);
  svg.style.height = `${12 * height}px`;
}

const make = (tag, values, ...inside) => {
  const element = Object.assign(document.createElement(tag), values);
  element.append(...inside);
  return element;
};

function render() {
  if (!current()) chosen = placing ? null : passes[0]?.id ?? null;
  part("list").replaceChildren(...passes.map(({ id, landmark, state, drawn, origin, belief, why = "", picture, ...of }) => {
    const title = make("b", { textContent: `ID.${landmark}`, style: tint(landmark) });
    const from = drawn ? origin : `${origin}, least belief ${belief.toFixed(2)}`;
    const lines = [spanOf(of), from, why].map((textContent) => make("small", { textContent }));
    const inside = [make("span", {}, title, ...lines), make("em", { textContent: state })];
    if (picture) inside.unshift(make("img", { src: picture, alt: "" }));
    const item = make("button", { type: "button", className: `${state}${id === chosen ? " chosen" : ""}` }, ...inside);
    item.dataset.pass = id;
    return make("li", {}, item);
  }));
  for (const { style, className } of part("shares").children) style.flexGrow = inState(className).length;
  for (const act of ["all", "from", "to"]) button(act).ariaPressed = String(range === act);
  button("place").ariaPressed = String(Boolean(placing));
  button("undo").disabled = !work.done.length;
  button("redo").disabled = !work.undone.length;
  frame();
}

// What a person does
/** Choose a pass, and go to its first mistake, or frame, unless it is in this one. */
function choose(id) {
  if (timer) acts.play();
  if (id !== chosen) range = "all";
  chosen = id;
  const rows = current()?.rows ?? [], first = rows.find((one) => images[one.frame]) ?? rows[0];
  if (first && !at(current(), now)) now = (at(current(), current().first_wrong) ?? first).frame;
  render();
  const list = part("list"), item = list.querySelector(".chosen"), top = item?.offsetTop;
  if (top < list.scrollTop || top + item?.offsetHeight > list.scrollTop + list.clientHeight) list.scrollTop = top - 40;
}

const go = (n) => { now = Math.min(last, Math.max(data.first, n)); frame(); keep(); };

/** To the next frame that is in the page, or grey; by -1 to the one before. */
function step(by) {
  let n = now + by;
  while (n > data.first && n < last && !images[n] && !damaged.has(n)) n += Math.sign(by);
  go(n);
}

/** Decide on the chosen pass, or a part of it, and go on to the next one that is open. */
function set(values) {
  const pass = current(), of = { from: { from: now }, to: { to: now } }[range];
  if (!pass) return say("Choose a pass first.");
  range = "all";
  decide({ kind: "set", pass: pass.id, ...of, ...values });
  say(`ID.${pass.landmark}, ${spanOf(pass, of)}: ${values.state}${values.landmark ? ` as ID.${values.landmark}` : ""}.`);
  const order = passes.findIndex((one) => one.id === pass.id);
  const next = [...passes.slice(order), ...passes.slice(0, order)].find((one) => one.state === "open");
  if (next && values.state !== "open") choose(next.id);
}

const toPlace = () => `ID.${placing.landmark}, or type another. Click its centre here, then in another frame.`;

function name(landmark) {
  if (!placing) return set({ state: "accepted", landmark });
  placing.landmark = landmark;
  say(toPlace());
  if (passes.some((pass) => pass.id === placing.pass)) decide({ kind: "set", pass: placing.pass, landmark });
  else frame();
}

const neighbour = (by) =>
  choose(passes[(passes.findIndex((pass) => pass.id === chosen) + by + passes.length) % passes.length]?.id ?? null);

const acts = {
  undo: () => back(work.done, work.undone, "Taken back."),
  redo: () => back(work.undone, work.done, "Decided again."),
  accept: () => set({ state: "accepted" }),
  reject: () => set({ state: "rejected" }),
  reopen: () => set({ state: "open" }),
  all() { range = "all"; render(); },
  from() { range = range === "from" ? "all" : "from"; render(); },
  to() { range = range === "to" ? "all" : "to"; render(); },
  before: (event) => step(event.shiftKey ? -10 : -1),
  next: (event) => step(event.shiftKey ? 10 : 1),
  first: () => go(current()?.rows[0].frame ?? data.first),
  last: () => go(current()?.rows.at(-1).frame ?? last),
  up: () => neighbour(-1),
  down: () => neighbour(1),
  hide() { hidden = !hidden; frame(); },
  fit: () => view.scale(0),
  bigger: () => view.scale(1.25),
  smaller: () => view.scale(0.8),
  play() {
    const { rows } = current() ?? { rows: [{ frame: now }] }, inside = now >= rows[0].frame && now < rows.at(-1).frame;
    clearInterval(timer);
    timer = timer ? 0 : setInterval(() => (now < (inside ? rows.at(-1).frame : last) ? step(1) : acts.play()), STEP_MS);
    button("play").ariaPressed = String(Boolean(timer));
  },
  unseen() {
    const left = shown.filter((n) => !seen.has(n));
    go(left.find((n) => n > now) ?? left[0] ?? now);
  },
  place() {
    placing = placing ? null : { landmark: current()?.landmark ?? ids[0] };
    if (placing) chosen = null;
    say(placing ? toPlace() : "");
    render();
  },
  done() { if (placing) acts.place(); },
  remove() {
    if (!current() || !at(current(), now)) return say("The chosen pass has no outline in this frame.");
    decide({ kind: "remove", pass: chosen, frame: now });
  },
  save() {
    const lines = csv(), href = URL.createObjectURL(new Blob(lines, { type: "text/csv" }));
    make("a", { href, download: "gt.csv" }).click();
    saved = true;
    say(`gt.csv saved: ${count(lines.length - 1, "row")}. ${left()}.`);
  },
  take() { part("offer").hidden = true; },
  leave() { work = nothing(); begin(); },
};

/** A press places where one is placed; else it takes the outline beneath it, that of the chosen first. */
view.press = (x, y, event) => {
  let to = [x, y];
  if (timer) acts.play();
  if (placing) return {
    move(...place) { to = place; },
    end() {
      if (!placed(now, ...to).visible) return say("Nothing of a landmark would be in view there.");
      const { landmark, pass = placing.pass = `d${now}.${work.done.length}` } = placing;
      chosen = pass;
      decide({ kind: "move", pass, drawn: true, landmark, frame: now, x: to[0], y: to[1] });
      say("Go to another frame and click there, too; what is between is drawn. Enter, or New again, ends.");
    },
  };
  const hits = document.elementsFromPoint(event.clientX, event.clientY).map((one) => one.dataset.pass);
  const pass = passes.find((one) => one.id === (hits.includes(chosen) ? chosen : hits.find(Boolean)));
  if (!pass) return null;
  const one = at(pass, now);
  to = [one.x, one.y];
  choose(pass.id);
  return {
    move(px, py) {
      if (pass.corners?.[now] && !one.moved) return say("The outline of a plate is not dragged.");
      to = [one.x + px - x, one.y + py - y];
      frame();
      view.mark({ corners: outline(pass, placed(now, ...to)), colour: ids.indexOf(pass.landmark) }, "declared accepted chosen");
    },
    end() {
      if (Math.hypot(to[0] - one.x, to[1] - one.y) < NEAR_PX) return;
      decide({ kind: "move", pass: pass.id, frame: now, x: to[0], y: to[1] });
    },
  };
};

/** A digit of an ID, which counts at once unless a longer ID begins so. */
function digit(figure) {
  const id = typed += figure, longer = ids.some((one) => String(one) !== id && String(one).startsWith(id));
  const use = () => { typed = ""; return ids.includes(Number(id)) ? name(Number(id)) : say(`There is no ID.${id}.`); };
  clearTimeout(wait);
  wait = setTimeout(use, longer ? WAIT_MS : 0);
}

const keys = { ArrowUp: "up", ArrowDown: "down", Home: "first", End: "last", Enter: "done", Escape: "done", "+": "bigger", "-": "smaller" };
for (const each of document.querySelectorAll("[data-keys]")) {
  for (const one of each.dataset.keys.split(" ")) keys[one.replace("Space", " ")] = each.dataset.act;
}

document.addEventListener("keydown", (event) => {
  const pressed = [" ", "Enter"].includes(event.key) && event.target.matches("button:focus-visible, summary");
  if (event.ctrlKey || event.metaKey || event.altKey || pressed) return;
  const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (act) acts[act](event);
  else if (/^\d$/.test(event.key)) digit(event.key);
  else return;
  event.preventDefault();
});

document.addEventListener("click", (event) => {
  const target = event.target.closest("button");
  if (!target) return;
  if (event.detail) target.blur(); // else space would press it again
  const { act, id, pass } = target.dataset;
  if (act) acts[act](event);
  if (id) name(Number(id));
  if (pass) say("");
  if (pass) choose(pass);
});

for (const kind of ["pointerdown", "pointermove"]) part("strip").addEventListener(kind, (event) => {
  if (!event.buttons) return;
  const box = part("strip").getBoundingClientRect();
  go(data.first + Math.floor((event.clientX - box.left) / box.width * data.frames));
});

addEventListener("beforeunload", (event) => { if (!part("refused").hidden && !saved) event.preventDefault(); });

function begin() {
  part("offer").hidden = work.page === data.page || !work.done.length;
  const text = `This browser has ${count(work.done.length, "decision")} of yours from an earlier page of this log.`;
  part("offer").firstElementChild.textContent = text;
  work.page = data.page;
  seen = new Set(work.seen);
  fold();
  choose((passes.find((pass) => pass.state === "open") ?? passes[0])?.id ?? null);
  keep();
  if (lost) say(`${count(lost, "decision")} on passes that this page does not have: left out.`);
}

work = storage((kept) => JSON.parse(kept.getItem(key))) ?? work;
begin();
