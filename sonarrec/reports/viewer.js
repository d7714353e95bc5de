// A frame with marks on it, of the report and of the review: it is zoomed by wheel or two fingers,
// and dragged. Coordinates are pixels of the fan image, pixel centres at whole numbers.
"use strict";
const POINTS = 500; // of a disc, spread evenly

// As ground_range, pixel_from_polar and share_in_image of the program, which tests compare.

/** [right, ahead] of the sonar on the floor, m, of a pixel; NaN if nearer than the floor. */
function floorFromPixel(fan, x, y) {
  const across = x - fan.apex_column, along = fan.apex_row - y;
  const slant = Math.hypot(across, along) * fan.metres_per_pixel;
  const ground = Math.sqrt(slant ** 2 - fan.depth_m ** 2), bearing = Math.atan2(across, along);
  return [ground * Math.sin(bearing), ground * Math.cos(bearing)];
}

/** [column, row] of a position on the floor, m to the right and ahead of the sonar. */
function pixelFromFloor(fan, right, ahead) {
  const distance = Math.hypot(right, ahead, fan.depth_m) / fan.metres_per_pixel;
  const bearing = Math.atan2(right, ahead);
  return [fan.apex_column + distance * Math.sin(bearing), fan.apex_row - distance * Math.cos(bearing)];
}

/** Share, 0 to 1, of a disc on the floor, its centre at a pixel, that the fan image shows. */
function visibleShare(fan, x, y, radius) {
  const [right, ahead] = floorFromPixel(fan, x, y).map((m) => m || 0); // too near: straight below
  let shown = 0;
  for (let n = 0.5; n < POINTS; n++) {
    const r = radius * Math.sqrt(n / POINTS), angle = n * Math.PI * (3 - Math.sqrt(5));
    const floor = [right + r * Math.cos(angle), ahead + r * Math.sin(angle)], [column, row] = pixelFromFloor(fan, ...floor);
    const slant = Math.hypot(...floor, fan.depth_m), bearing = Math.atan2(...floor) * 180 / Math.PI;
    shown += slant >= fan.range_min_m && slant <= fan.range_max_m &&
      bearing >= fan.bearing_min_deg && bearing <= fan.bearing_max_deg &&
      row >= -0.5 && row <= fan.rows - 0.5 && column >= -1 && column <= fan.columns;
  }
  return shown / POINTS;
}

/** Add an element to an SVG. */
function drawn(svg, name, attributes, text = "") {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) element.setAttribute(key, attributes[key]);
  element.textContent = text;
  svg.append(element);
}

class View {
  /** svg: lies on the image, in a box that hides what is beyond it. */
  constructor(svg, image) {
    Object.assign(this, { svg, image, size: [1, 1], margin: [0, 0], zoom: 1, left: 0, top: 0 });
    this.press = () => null; // what follows a press, (x, y, event): {move(x, y), end()}; null: it drags
    const fingers = new Map();
    let taken = null;
    svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.scale(Math.exp(-event.deltaY / 400), this.share(event));
    }, { passive: false });
    svg.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      svg.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
      taken = fingers.size > 1 ? null : this.press(...this.pixel(event), event);
    });
    svg.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const [other] = [...fingers.values()].filter((one) => one.pointerId !== event.pointerId);
      fingers.set(event.pointerId, event);
      if (taken) return taken.move(...this.pixel(event));
      if (other) {
        const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
        this.scale(apart(event) / apart(before), this.share(other));
      } else {
        const [from, to] = [this.share(before), this.share(event)];
        this.place(this.left - (to[0] - from[0]) / this.zoom, this.top - (to[1] - from[1]) / this.zoom);
      }
    });
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, (event) => {
      if (fingers.delete(event.pointerId) && taken && name === "pointerup") taken.end();
      taken = null;
    });
  }

  /** Begin a frame of this size, in the middle of the box; what was on the last one is removed. */
  begin(columns, rows) {
    const { width, height } = this.svg.getBoundingClientRect(), shape = width && height ? width / height : columns / rows;
    this.size = [Math.max(columns, rows * shape), Math.max(rows, columns / shape)];
    this.margin = [(this.size[0] - columns) / 2, (this.size[1] - rows) / 2];
    this.svg.replaceChildren();
    this.place(this.left, this.top);
  }

  /** Where a pointer is, as shares of the box's width and height. */
  share({ clientX, clientY }) {
    const box = this.svg.getBoundingClientRect();
    return [(clientX - box.left) / box.width, (clientY - box.top) / box.height];
  }

  /** The pixel of a pointer. */
  pixel(event) {
    return this.share(event).map((v, n) => ([this.left, this.top][n] + v / this.zoom) * this.size[n] - 0.5 - this.margin[n]);
  }

  /** Zoom by a factor about a point of the box. */
  scale(factor, [across, down] = [0.5, 0.5]) {
    const before = this.zoom;
    this.zoom = Math.min(16, Math.max(1, before * factor));
    const more = 1 / before - 1 / this.zoom;
    this.place(this.left + across * more, this.top + down * more);
  }

  /** Put the box's corner at these shares of the frame, or so that the frame fills the box. */
  place(left, top) {
    const [width, height] = this.size, part = 1 / this.zoom;
    [this.left, this.top] = [left, top].map((v) => Math.min(1 - part, Math.max(0, v)));
    this.image.style.transform = `scale(${this.zoom}) translate(${-100 * this.left}%, ${-100 * this.top}%)`;
    const [x, y] = [this.left * width, this.top * height].map((v, n) => v - 0.5 - this.margin[n]);
    const box = [x, y, part * width, part * height];
    this.svg.setAttribute("viewBox", box.join(" "));
    this.svg.style.fontSize = Math.max(width, height) / 36 * part + "px"; // in the frame's pixels
  }

  /** An outline: an ellipse (centre, half axes, rotation in deg) or corners, a label and the index of
      its colour, which it has if its kind is "declared". */
  mark({ ellipse: [cx, cy, rx, ry, turn] = [], corners, label, colour, pass = "" }, kind, below) {
    const look = { class: kind, style: kind.startsWith("declared") ? `--c: var(--bright-${colour})` : "" };
    const r = Math.max(rx, ry), points = corners ?? [[cx - r, cy - r], [cx + r, cy + r]];
    const rotated = { cx, cy, rx, ry, transform: `rotate(${turn} ${cx} ${cy})` };
    if (corners) drawn(this.svg, "polygon", { points: corners.join(" "), "data-pass": pass, ...look });
    else drawn(this.svg, "ellipse", { ...rotated, ...look });
    const [columns, rows] = [0, 1].map((n) => points.map((point) => point[n]));
    const x = (Math.min(...columns) + Math.max(...columns)) / 2;
    const [y, dy] = below ? [Math.max(...rows), "1.5em"] : [Math.min(...rows), "-0.5em"];
    drawn(this.svg, "text", { x, y, dy, ...look }, label);
  }
}
