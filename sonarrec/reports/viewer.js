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
    Object.assign(this, { svg, image, size: [1, 1], zoom: 1, left: 0, top: 0 });
    this.press = () => null; // what follows a press, (x, y, event): {move(x, y), end()}; null: it drags
    const fingers = new Map();
    let taken = null;
    svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.scale(Math.exp(-event.deltaY / 400), event.clientX, event.clientY);
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
        this.scale(apart(event) / apart(before), other.clientX, other.clientY);
      } else {
        const box = svg.getBoundingClientRect();
        this.left -= (event.clientX - before.clientX) / box.width / this.zoom;
        this.top -= (event.clientY - before.clientY) / box.height / this.zoom;
        this.place();
      }
    });
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, (event) => {
      if (fingers.delete(event.pointerId) && taken && name === "pointerup") taken.end();
      taken = null;
    });
  }

  /** Begin a frame of this size; what was on the last one is removed. */
  begin(width, height) {
    this.size = [width, height];
    this.svg.replaceChildren();
    this.place();
  }

  /** The pixel of a pointer. */
  pixel(event) {
    const box = this.svg.getBoundingClientRect(), [width, height] = this.size;
    return [(this.left + (event.clientX - box.left) / box.width / this.zoom) * width - 0.5,
            (this.top + (event.clientY - box.top) / box.height / this.zoom) * height - 0.5];
  }

  /** Zoom by a factor about a point of the screen; without one about the middle. */
  scale(factor, x, y) {
    const box = this.svg.getBoundingClientRect(), before = this.zoom;
    this.zoom = Math.min(16, Math.max(1, before * factor));
    const moved = 1 / before - 1 / this.zoom;
    this.left += (x === undefined ? 0.5 : (x - box.left) / box.width) * moved;
    this.top += (y === undefined ? 0.5 : (y - box.top) / box.height) * moved;
    this.place();
  }

  place() {
    const [width, height] = this.size, part = 1 / this.zoom;
    this.left = Math.min(1 - part, Math.max(0, this.left));
    this.top = Math.min(1 - part, Math.max(0, this.top));
    this.image.style.transform = `scale(${this.zoom}) translate(${-100 * this.left}%, ${-100 * this.top}%)`;
    const corner = [this.left * width - 0.5, this.top * height - 0.5];
    this.svg.setAttribute("viewBox", [...corner, part * width, part * height].join(" "));
    this.svg.style.fontSize = Math.max(width, height) / 36 * part + "px"; // in the frame's pixels
  }

  /** An outline: an ellipse (centre, half axes, rotation in deg) or corners, a label and the index of
      its colour, which it has if its kind is "declared". */
  mark({ ellipse, corners, label, colour, pass = "" }, kind, below) {
    const text = Math.max(...this.size) / 36 / this.zoom;
    const style = kind.startsWith("declared") ? `--c: var(--bright-${colour})` : "";
    let x, top, bottom;
    if (corners) {
      const [columns, rows] = [0, 1].map((n) => corners.map((corner) => corner[n]));
      drawn(this.svg, "polygon", { points: corners.join(" "), class: kind, style, "data-pass": pass });
      x = (Math.min(...columns) + Math.max(...columns)) / 2;
      [top, bottom] = [Math.min(...rows), Math.max(...rows)];
    } else {
      const [cx, cy, rx, ry, turn] = ellipse, r = Math.max(rx, ry);
      drawn(this.svg, "ellipse", { cx, cy, rx, ry, transform: `rotate(${turn} ${cx} ${cy})`, class: kind, style });
      [x, top, bottom] = [cx, cy - r, cy + r];
    }
    drawn(this.svg, "text", { x, y: below ? bottom + 1.5 * text : top - text / 2, class: kind, style }, label);
  }
}
