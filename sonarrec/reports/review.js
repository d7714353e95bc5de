// Truth by eye. A pass is accepted, rejected, given another ID, split, shifted, its ends are set;
// outlines are dragged, placed and removed. Each is an entry of `work.done`; `fold` makes the passes
// from those of the page and these entries, so that undo is to leave the last one out, and only
// entries are kept in the browser.
const data = JSON.parse(document.getElementById("data").textContent);
const { fan, ids, images, radius_m } = data, last = data.first + data.frames - 1, key = `sonarrec review ${data.key}`;
const damaged = new Set(data.damaged), shown = Object.keys(images).map(Number);
const part = (id) => document.getElementById(id), button = (act) => document.querySelector(`[data-act=${act}]`);
const view = new View(part("marks"), part("image"));
const STEP_MS = 80, NEAR_PX = 0.5, WAIT_MS = 700, FAR = 1e9, END_PX = 7, CARRIED_BY = 5;
const nothing = () => ({ page: data.page, done: [], undone: [], seen: [] });
let work = nothing(), seen = new Set(); // seen: frames that were on the screen
let passes = [], lost = 0, spots = new Map(); // as folded; entries on passes that this page lacks; see onOneSpot
let now = shown[0], chosen = null, range = "all", placing = null, hidden = false, shifting = false, pulled = null;
let saved = true, timer = 0, typed = "", wait = 0, stale = false; // stale: another tab has decided since
const tabs = new BroadcastChannel(key);

// The passes
const placed = (frame, x, y, more) => ({ frame, x, y, visible: visibleShare(fan, x, y, radius_m), moved: true, ...more });

const rotated = ([right, ahead], [cos, sin]) => [right * cos + ahead * sin, ahead * cos - right * sin];
const stretchOf = (frame) => data.poses[frame]?.[4];

/** Where a pixel of a frame lies on the floor, which stands still; null if the motion is not known. */
function placeOf({ frame, x, y }) {
  const pose = data.poses[frame], floor = floorFromPixel(fan, x, y);
  return pose && !floor.some(Number.isNaN) ? rotated(floor, pose).map((v, axis) => v + pose[2 + axis]) : null;
}

function pixelOf([east, north], frame) {
  const [cos, sin, x, y] = data.poses[frame];
  return pixelFromFloor(fan, ...rotated([east - x, north - y], [cos, -sin]));
}

/** The pixel in a frame of what lies at a in one frame and at b in another: on a straight line on the
    floor; in the image where the sonar's motion from one to the other is not known. */
function between(a, b, frame) {
  const mix = (p, q) => p.map((v, n) => v + (frame - a.frame) / (b.frame - a.frame) * (q[n] - v));
  const places = [a, b].map(placeOf), isOne = [a, b].every((one) => stretchOf(one.frame) === stretchOf(frame));
  return isOne && places.every(Boolean) ? pixelOf(mix(...places), frame) : mix([a.x, a.y], [b.x, b.y]);
}

/** The pixel in a frame of what lies still, as the nearest rows have it; null where the motion is not known. */
function carried(rows, frame) {
  const isBefore = frame < rows[0].frame, end = rows.at(isBefore ? 0 : -1);
  const whole = rows.filter((one) => one.visible > 0.9), from = end.key || !whole.length ? [end] : whole;
  const places = from.slice(...(isBefore ? [0, CARRIED_BY] : [-CARRIED_BY])).map(placeOf).filter(Boolean);
  if (!places.length || stretchOf(frame) === undefined || stretchOf(frame) !== stretchOf(end.frame)) return null;
  return pixelOf([0, 1].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length), frame);
}

/** Rows from a first frame to a last one: cut there, or carried on while the landmark is in view; where the
    motion is not known in the same pixel if held, else no further. */
function reaching(rows, first, last, held) {
  const kept = rows.filter((one) => one.frame >= first && one.frame <= last);
  const beyond = (from, by, end) => {
    const more = [];
    for (let n = from + by; (end - n) * by >= 0; n += by) {
      if (damaged.has(n)) continue;
      const end = kept.at(by > 0 ? -1 : 0), pixel = carried(kept, n) ?? (held ? [end.x, end.y] : null);
      const one = pixel && placed(n, ...pixel, { made: true });
      if (!one?.visible) break;
      more.push(one);
    }
    return more;
  };
  if (!kept.length) return rows;
  return [...beyond(kept[0].frame, -1, first).reverse(), ...kept, ...beyond(kept.at(-1).frame, 1, last)];
}

/** Rows with a key frame at a pixel. Rows made, not seen, are made anew up to the next that was seen. */
function withKey(rows, frame, x, y) {
  const others = rows.filter((one) => one.frame !== frame), key = placed(frame, x, y, { key: true });
  const firm = others.filter((one) => !one.made);
  const before = firm.findLast((one) => one.frame < frame), after = firm.find((one) => one.frame > frame);
  const found = new Map(others.map((one) => [one.frame, one])).set(frame, key);
  const make = (n, pixel) => found.set(n, placed(n, ...pixel, { made: true }));
  for (const [a, b] of [[before, key], [key, after]].filter((pair) => pair[0] && pair[1])) {
    for (let n = a.frame + 1; n < b.frame; n++) if (!damaged.has(n)) make(n, between(a, b, n));
  }
  const beyond = others.filter((one) => (one.frame < frame ? !before : !after));
  for (const { frame: n } of beyond) make(n, carried([key], n) ?? [x, y]);
  return [...found.values()].sort((one, other) => one.frame - other.frame);
}

/** Rows shifted on the floor by as much as the one in a frame, to a pixel; where the motion is not
    known in the image. */
function shifted(rows, frame, x, y) {
  const from = rows.find((one) => one.frame === frame) ?? { frame, x, y };
  const [a, b] = [from, { frame, x, y }].map(placeOf);
  return rows.map((one) => {
    const place = a && b && placeOf(one), to = place?.map((v, axis) => v + b[axis] - a[axis]);
    return { ...one, ...placed(one.frame, ...(to ? pixelOf(to, one.frame) : [one.x + x - from.x, one.y + y - from.y])) };
  });
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
  move: (pass, { frame, x, y }) => ({ rows: (pass.drawn || at(pass, frame)?.made ? withKey : moved)(pass.rows, frame, x, y) }),
  shift: (pass, { frame, x, y }) => ({ rows: shifted(pass.rows, frame, x, y) }),
  reach: (pass, { first, last, held }) => ({ rows: reaching(pass.rows, first, last, held) }),
  remove: (pass, { frame }) => ({ rows: pass.rows.filter((one) => weight(one.frame, frame) <= 0.5) }),
};

function fold() {
  const made = new Map(data.passes.map((pass) => [pass.id, { ...pass, recognised: pass.landmark }])), order = [...made.keys()];
  lost = 0;
  for (const entry of work.done) {
    const { pass: id, landmark, drawn } = entry, isNew = drawn && !made.has(id);
    const pass = isNew ? { id, landmark, drawn, rows: [], state: "accepted", origin: "drawn" } : partOf(made, entry);
    if (pass) made.set(pass.id, { ...pass, ...entries[entry.kind](pass, entry) });
    else lost++;
  }
  const place = (pass) => (order.indexOf(pass.id.split(">")[0]) + 1 || FAR) + pass.rows[0].frame / FAR;
  passes = [...made.values()].filter((pass) => pass.rows.length).sort((a, b) => place(a) - place(b));
  spots = onOneSpot();
}

/** Of the outlines kept by frame those within a distance of this one, which is added to them. */
function near(byFrame, { frame, x, y, made }, landmark, distance) {
  const floor = floorFromPixel(fan, x, y), others = byFrame.get(frame) ?? [];
  byFrame.set(frame, [...others, { landmark, floor, made }]);
  return others.filter((one) => Math.hypot(one.floor[0] - floor[0], one.floor[1] - floor[1]) < distance);
}

/** By pass that would be saved, a warning if it is within half a radius of another in a frame. */
function onOneSpot() {
  const byFrame = new Map(), found = new Map();
  for (const { id, landmark, rows } of passes.filter(isSaved)) for (const one of rows) {
    const isOther = (each) => each.landmark !== landmark || !(each.made || one.made); // two of one ID are saved once
    const other = near(byFrame, one, landmark, radius_m / 2).find(isOther);
    if (other && !found.has(id)) found.set(id, `on the same spot as ${called(other.landmark)} in frame ${one.frame}`);
  }
  return found;
}

// What is decided, kept in the browser, and saved
const say = (text) => { part("say").textContent = text; };
const RELOAD = "Another tab has decided on this log since: reload, so that nothing is lost.";
function decide(entry) {
  if (stale) return say(RELOAD);
  work.done.push(entry);
  work.undone = [];
  changed("");
}
const storage = (use) => { try { return use(localStorage); } catch { part("refused").hidden = false; } };
function keep() {
  const open = inState("open").length, unseen = data.frames - damaged.size - seen.size;
  const counts = { passes: passes.length, open, decided: passes.length - open, unseen, saved: saved && open < passes.length };
  if (!stale) storage((kept) => kept.setItem(key, JSON.stringify({ ...work, seen: [...seen], counts })));
}

function changed(text) {
  saved = false;
  fold();
  render();
  keep();
  tabs.postMessage("decided");
  say(text);
}

function back(from, to, text) {
  if (stale) return say(RELOAD);
  if (!from.length) return;
  to.push(from.pop());
  ({ pass: chosen, frame: now = now } = to.at(-1));
  changed(text);
  choose(chosen);
}

function csv() {
  const cell = (text) => (/[",\r\n]|^\s/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const lines = data.kept.map(([frame, cells]) => [frame ?? FAR, 0, cells]), track = data.header.indexOf("track");
  const taken = new Map(), used = new Map(), rows = passes.flatMap((pass) => pass.rows.map((one) => [pass, one]));
  let number = rows.reduce((most, [, { cells }]) => Math.max(most, Number(cells?.[track]) || 0), 0);
  const rank = ([{ state }, { made }]) => (state === "rejected" ? 2 : made ? 1 : 0);
  for (const [pass, one] of rows.sort((a, b) => rank(a) - rank(b))) {
    const { id, state } = pass, isNone = state === "rejected", landmark = isNone ? "none" : pass.landmark;
    const { frame, x, y, visible, moved: isMoved, cells } = one;
    if (!(isSaved(pass) || isNone) || (isMoved && !visible)) continue;
    // Of two on one spot that say the same the first is saved. Where a landmark is, but not the one that was
    // rejected, the row teaches nothing.
    const isSame = (other) => other.landmark === landmark && (other.made || one.made);
    const others = near(taken, one, landmark, radius_m).filter((other) => isNone || isSame(other));
    if (others.some((other) => other.landmark === landmark)) continue;
    const free = (name) => ![...used].some(([of, taken]) => of !== id && taken === `${landmark} ${name}`);
    if (!used.has(id)) used.set(id, `${landmark} ${cells?.[track] && free(cells[track]) ? cells[track] : ++number}`);
    const values = { landmark, track: used.get(id).split(" ")[1] };
    if (isMoved) Object.assign(values, { frame, x_px: x.toFixed(2), y_px: y.toFixed(2), visible: visible.toFixed(3) });
    if (isMoved || state !== "open") values.source = "";
    if (others.length) values.visible = 0;
    const came = cells ?? data.header.map((column) => (column === "log" ? data.log : ""));
    lines.push([frame, pass.landmark ?? FAR, data.header.map((column, n) => String(values[column] ?? came[n]))]);
  }
  lines.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  return [data.header, ...lines.map((line) => line[2])].map((cells) => cells.map(cell).join(",") + "\n");
}

// The screen
const count = (n, noun, ending = "s") => `${n} ${noun}${n === 1 ? "" : ending}`;
const inState = (state) => passes.filter((pass) => pass.state === state);
const current = () => passes.find((pass) => pass.id === chosen);
const isSaved = ({ state, left_out }) => state === "accepted" || (state === "open" && !left_out);
const called = (landmark) => (landmark === null ? "none" : `ID.${landmark}`);
const tint = (landmark) => `--c: var(--bright-${ids.indexOf(landmark)}, #8b959e)`;
const at = (pass, frame) => pass.rows.find((one) => one.frame === frame);
function spanOf(pass, { from = -Infinity, to = Infinity } = {}) {
  const rows = pass.rows.filter((one) => one.frame >= from && one.frame <= to);
  return `frames ${rows[0]?.frame ?? now} to ${rows.at(-1)?.frame ?? now}`;
}

function left() {
  const open = inState("open"), out = open.filter((pass) => pass.left_out).length;
  const unseen = data.frames - damaged.size - seen.size;
  const of = `${count(open.length, "pass", "es")} open${out ? ` (${out} not saved while open)` : ""}`;
  const [id] = spots.keys(), pass = passes.find((one) => one.id === id);
  const warning = pass ? `. ${called(pass.landmark)} is ${spots.get(id)}: reject one` : "";
  return `${open.length ? of : "No pass is open"}; ${unseen ? count(unseen, "frame") + " not seen" : "all frames seen"}${warning}`;
}

/** The corners of a plate, else the edge of a disc; nearer than the floor that at the nearest floor. */
function outline({ corners }, { x, y, frame, moved }) {
  if (corners?.[frame] && !moved) return corners[frame];
  return Array.from({ length: 48 }, (_, n) => onEdge(x, y, n * Math.PI / 24));
}

/** The pixel of the edge of a disc at a pixel, at an angle counter-clockwise from the right, seen from above. */
function onEdge(x, y, angle) {
  let floor = floorFromPixel(fan, x, y);
  const steepest = Math.sqrt(1.05 ** 2 - 1) * fan.depth_m;
  if (!(Math.hypot(...floor) > steepest)) floor = [0, steepest];
  const [column, row] = pixelFromFloor(fan, ...floor);
  const [right, ahead] = [Math.cos, Math.sin].map((of, axis) => floor[axis] + radius_m * of(angle));
  return pixelFromFloor(fan, right, ahead).map((v, axis) => v + (axis ? y - row : x - column));
}

/** The orientation, rad, of a pass in a frame: as in the nearest one where it was measured, and the
    sonar's yaw since. */
function orientationIn({ orientations = {} }, frame) {
  const yaw = (n) => Math.atan2(data.poses[n]?.[1] ?? 0, data.poses[n]?.[0] ?? 1), off = (n) => Math.abs(n - frame);
  const from = Object.keys(orientations).reduce((best, n) => (off(n) < off(best ?? FAR) ? n : best), null);
  return from === null ? null : orientations[from] * Math.PI / 180 + yaw(frame) - yaw(from);
}

/** Draw the chosen pass's ID into the picture, at its orientation; known for the ID that was recognised. */
function drawSymbol(pass) {
  const angle = orientationIn(pass, now), { x, y } = at(pass, now), { landmark, recognised, corners = {} } = pass;
  if (angle === null || landmark !== recognised || Object.keys(corners).length) return;
  const axis = (of) => onEdge(x, y, of).map((v, n) => (v - [x, y][n]) / 49);
  const [a, b, c, d] = [...axis(angle), ...axis(angle - Math.PI / 2)];
  const transform = `matrix(${[a, b, c, d, x - 50 * (a + c), y - 50 * (b + d)].join(" ")})`;
  drawn(part("marks"), "path", { d: data.glyphs[ids.indexOf(landmark)], transform, class: "symbol", style: tint(landmark) });
}

/** The mean picture of a pass; around it, bright, the directions that were read to be lit. */
function mean({ picture: href, read = [] } = {}) {
  part("mean").replaceChildren();
  if (href) drawn(part("mean"), "image", { href, x: -50, y: -50, width: 100, height: 100 });
  const point = (angle) => `${46 * Math.cos(angle)} ${-46 * Math.sin(angle)}`, step = 2 * Math.PI / read.length;
  read.forEach((lit, n) => {
    const d = `M${point(n * step)}A46 46 0 0 0 ${point((n + 1) * step)}`;
    drawn(part("mean"), "path", { d, style: `opacity: ${lit / 9}` });
  });
  part("mean").parentElement.hidden = !href;
}

function frame() {
  const held = images[now], pass = current();
  if (held) part("image").src = held;
  if (held) seen.add(now);
  part("title").textContent = `Frame ${now}`;
  part("of").textContent = `of ${data.first} to ${last}` + (placing ? `; placing ID.${placing.landmark}` : "");
  part("grey").hidden = Boolean(held);
  part("grey").textContent = damaged.has(now) ? "This frame cannot be read." : "This frame is not in this page.";
  part("pass").textContent = pass ? `${called(pass.landmark)}, ${spanOf(pass)}, ${pass.state}` : "No pass is chosen.";
  part("left").textContent = left();
  view.begin(fan.columns, fan.rows);
  for (const one of hidden ? [] : passes.filter((each) => at(each, now))) {
    const label = `${called(one.landmark)}${one.state === "open" ? "?" : ""}`, corners = outline(one, at(one, now));
    const kind = `declared ${one.state}${one.id === chosen ? " chosen" : ""}`;
    view.mark({ corners, label, colour: ids.indexOf(one.landmark), pass: one.id }, kind);
  }
  if (pass && !hidden && at(pass, now)) drawSymbol(pass);
  strip();
}

/** A lane of the strip for each pass, by its ID and so that none lies on another. */
function lanesOf() {
  const ends = [], lanes = new Map();
  const first = (pass) => pass.rows[0].frame;
  const order = ({ landmark }) => (landmark === null ? FAR : ids.indexOf(landmark));
  for (const pass of [...passes].sort((a, b) => order(a) - order(b) || first(a) - first(b))) {
    const free = ends.findIndex((end) => end.landmark === pass.landmark && end.last < first(pass));
    const lane = free < 0 ? ends.length : free;
    ends[lane] = { landmark: pass.landmark, last: pass.rows.at(-1).frame };
    lanes.set(pass.id, lane);
  }
  return [lanes, ends.length];
}

/** The bar of frames: which were seen, the passes, and which is shown. */
function strip() {
  const svg = part("strip"), [lanes, count] = lanesOf(), height = 1.6 + count;
  const add = (x, end, y, height, look) => drawn(svg, "rect", { x, width: end - x, y, height, ...look });
  const kindOf = (n) => (damaged.has(n) ? "damaged" : seen.has(n) ? "seen" : images[n] ? "unseen" : "absent");
  svg.replaceChildren();
  for (let n = data.first, from = n; n <= last; n++) {
    if (n < last && kindOf(n + 1) === kindOf(n)) continue;
    add(from, n + 1, 0, 1, { class: kindOf(n) });
    from = n + 1;
  }
  for (const { id, rows, state, landmark } of passes) {
    const look = { class: `pass ${state}${id === chosen ? " chosen" : ""}`, style: tint(landmark), "data-pass": id };
    const [first, end] = pulled?.id === id ? pulled.ends : endsOf({ rows });
    add(first, end + 1, 1.6 + lanes.get(id), 0.7, look);
  }
  add(now, now + 1, 0, height, { class: "now" });
  svg.setAttribute("viewBox", `${data.first} 0 ${data.frames} ${height}`);
  svg.style.height = `${Math.min(12 * height, innerHeight / 4)}px`;
}

const make = (tag, values, ...inside) => {
  const element = Object.assign(document.createElement(tag), values);
  element.append(...inside);
  return element;
};

function render() {
  if (!current()) chosen = placing ? null : passes[0]?.id ?? null;
  part("list").replaceChildren(...passes.map(({ id, landmark, state, drawn, origin, belief, why = "", picture, ...of }) => {
    const title = make("b", { textContent: called(landmark), style: tint(landmark) });
    const sure = belief ? `least belief ${belief.toFixed(2)}` : "missed by the program";
    const from = drawn || landmark === null ? origin : `${origin}, ${sure}`;
    const doubts = [why, spots.get(id)].filter(Boolean).join("; ");
    const lines = [spanOf(of), from, doubts].map((textContent) => make("small", { textContent }));
    const inside = [make("span", {}, title, ...lines), make("em", { textContent: state })];
    if (picture) inside.unshift(make("img", { src: picture, alt: "" }));
    const item = make("button", { type: "button", className: `${state}${id === chosen ? " chosen" : ""}` }, ...inside);
    item.dataset.pass = id;
    return make("li", {}, item);
  }));
  for (const { style, className } of part("shares").children) style.flexGrow = inState(className).length;
  for (const act of ["all", "from", "to"]) button(act).ariaPressed = String(range === act);
  button("place").ariaPressed = String(Boolean(placing));
  button("shift").ariaPressed = String(shifting);
  mean(current());
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
  const list = part("passes"), item = list.querySelector(".chosen"), top = item?.offsetTop;
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
  if (values.state === "accepted" && (values.landmark ?? pass.landmark) === null) return say("Type its ID.");
  range = "all";
  decide({ kind: "set", pass: pass.id, ...of, ...values });
  const as = values.landmark ? ` as ID.${values.landmark}` : "";
  if (!stale) say(`${called(pass.landmark)}, ${spanOf(pass, of)}: ${values.state}${as}.`);
  const order = passes.findIndex((one) => one.id === pass.id);
  const next = [...passes.slice(order), ...passes.slice(0, order)].find((one) => one.state === "open");
  if (next && values.state !== "open") choose(next.id);
}

/** Let the chosen pass begin or end in this frame, or as far as it is in view. */
function reach(isFirst, { shiftKey }) {
  if (!current()) return say("Choose a pass first.");
  const ends = endsOf(current());
  ends[isFirst ? 0 : 1] = shiftKey ? [data.first, last][isFirst ? 0 : 1] : now;
  pull(current(), ...ends, !shiftKey);
}

const endsOf = ({ rows }) => [rows[0].frame, rows.at(-1).frame];

function pull(pass, first, last, held) {
  const [before, after] = endsOf(pass);
  if (first > after || last < before) return say("That would leave nothing of the pass: reject it, or choose another.");
  decide({ kind: "reach", pass: pass.id, first, last, held });
  if (stale) return;
  const ends = endsOf(current()), inView = ends[0] > first || ends[1] < last ? ", as far as it is in view" : "";
  const isKnown = ends.every((n) => n >= before && n <= after || (stretchOf(n) ?? -1) === stretchOf(before));
  const doubt = isKnown ? "" : " The motion is not known all along: drag the outlines to where it lies.";
  say(`${called(pass.landmark)}: ${spanOf(current())}${inView}.${doubt}`);
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
  begin: (event) => reach(true, event),
  end: (event) => reach(false, event),
  shift() { shifting = !shifting; say(shifting ? "A drag now shifts the whole pass." : ""); render(); },
  log() { location.href = encodeURIComponent(data.next); },
  again: () => location.reload(),
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
    make("a", { href, download: data.gt_name }).click();
    saved = true;
    keep();
    say(`${data.gt_name} saved: ${count(lines.length - 1, "row")}. ${left()}.`);
  },
  take() { part("offer").hidden = true; },
  leave() { work = nothing(); tabs.postMessage("decided"); begin(); },
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
      decide({ kind: shifting || event.shiftKey ? "shift" : "move", pass: pass.id, frame: now, x: to[0], y: to[1] });
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
  const slid = event.target.matches("input") && event.key.startsWith("Arrow");
  if (event.ctrlKey || event.metaKey || event.altKey || pressed || slid) return;
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

function frameAt({ clientX }) {
  const { left, width } = part("strip").getBoundingClientRect();
  return Math.min(last, Math.max(data.first, data.first + Math.floor((clientX - left) / width * data.frames)));
}

/** The end of a pass that a press on the strip takes, if it is at one; that of the chosen first. */
function endAt({ clientX, clientY }) {
  const ends = [...part("strip").querySelectorAll(".pass")].flatMap((bar) => {
    const box = bar.getBoundingClientRect(), id = bar.dataset.pass, isIn = Math.abs(clientY - (box.top + box.bottom) / 2) <= box.height / 2 + 2;
    return isIn ? [box.left, box.right].map((x, n) => ({ id, side: n, off: Math.abs(x - clientX) - (id === chosen) })) : [];
  });
  const [end] = ends.filter(({ off }) => off <= END_PX).sort((a, b) => a.off - b.off);
  return end && { ...end, ends: endsOf(passes.find((one) => one.id === end.id)) };
}

for (const kind of ["pointerdown", "pointermove", "pointerup"]) part("strip").addEventListener(kind, (event) => {
  const n = frameAt(event);
  if (kind === "pointerdown") {
    part("strip").setPointerCapture(event.pointerId);
    const end = endAt(event);
    if (end) choose(end.id);
    pulled = end ?? null;
  } else if (pulled && event.buttons) {
    pulled.ends[pulled.side] = pulled.side ? Math.max(n, pulled.ends[0]) : Math.min(n, pulled.ends[1]);
    pulled.moved = true;
  } else if (pulled) {
    const { ends, moved: isMoved } = pulled;
    pulled = null;
    if (isMoved && current()) pull(current(), ...ends, true);
  }
  part("strip").style.cursor = endAt(event) ? "ew-resize" : "";
  if (event.buttons) go(n);
});

for (const id of ["brightness", "contrast"]) part(id).addEventListener("input", () => {
  part("image").style.filter = `brightness(${part("brightness").value}) contrast(${part("contrast").value})`;
});
new ResizeObserver(() => frame()).observe(part("image").parentElement);

// Each page of a log in another tab hears what this one does; the one that opened later is answered.
tabs.onmessage = ({ data: what }) => {
  if (what === "opened") return tabs.postMessage("here");
  stale ||= what === "decided";
  part("twin").hidden = false;
  part("twin").firstElementChild.textContent = stale ? RELOAD : "This log is open in another tab, too: decide in one of them.";
};
tabs.postMessage("opened");

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
