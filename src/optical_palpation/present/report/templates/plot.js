// A frame with axes in mm, and the cursor that all plots share.

const cursor = {
  x: 0,
  y: 0,
  limits: { x: [0, 1], y: [0, 1] },
  listeners: [],
  waiting: false,

  // Moves at once; the plots follow with the next picture of the screen.
  move({ x = this.x, y = this.y }) {
    this.x = clamp(x, ...this.limits.x);
    this.y = clamp(y, ...this.limits.y);
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      for (const listener of this.listeners) listener(this);
    });
  },
};

// What a screen reader says after the keys have rested for a moment.
const speak = (() => {
  const target = document.getElementById("spoken");
  let timer;
  return (text) => {
    clearTimeout(timer);
    timer = setTimeout(() => (target.textContent = text()), 300);
  };
})();

function svg(name, attributes = {}) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// Round numbers within [low, high], two at least: one alone is no scale.
function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((m) => m * power >= rough * 0.999) * power;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found.length < 2 && count < 100 ? ticks(low, high, 2 * count) : found;
}

// Power of a thousand to take out of numbers that would else reach the label of their axis.
function factor(values) {
  const longest = Math.max(...values.map((value) => shown(value).replace(".", "").length));
  const most = Math.max(...values.map(Math.abs));
  return longest > 4 ? 3 * Math.floor(Math.log10(most) / 3 + 1e-9) : 0;
}

// The label of an axis with the power in its unit.
function scaled(label, power) {
  const signs = "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079";
  const raised = String(power).replace(/./g, (sign) => signs["-0123456789".indexOf(sign)]);
  const [, words, unit] = label.match(/^(.*) \(([^(]*)\)$/) ?? [label, label, ""];
  return `${words} (${`10${raised} ${unit}`.trim()})`;
}

// Pixels for which plots are laid out on paper, which is narrower than the screen: were the plots of
// the screen scaled down to it, their text would be too small to read. Their canvas stays that of the
// screen: Chromium puts what is painted while it prints in the wrong place.
const PRINTED = { maps: 200, stage: 480, other: 400 };
let printing = false;

const MARGIN = { left: 52, right: 10, top: 6, bottom: 36 };

class Plot {
  // axes: { x: {range, label}, y: {range, label, down} }; height(width): of the frame, in pixels;
  // moves: what the horizontal and the vertical direction are to the cursor, "x", "y" or null.
  constructor(axes, height, moves, label) {
    this.axes = axes;
    this.frameHeight = height;
    this.moves = moves;
    this.host = element("div", { class: "plot" });
    this.canvas = element("canvas", { "aria-hidden": "true" });
    this.svg = svg("svg", { "aria-hidden": "true" });
    this.scenery = svg("g");
    this.overlay = svg("g");
    this.svg.append(this.scenery, this.overlay);
    this.host.append(this.canvas, this.svg);
    if (moves.x || moves.y) this.listen(label);
    else this.host.classList.add("still");
    new ResizeObserver(() => printing || this.resize()).observe(this.host);
    addEventListener("beforeprint", () => {
      printing = true;
      const place = ["maps", "stage"].find((name) => this.host.closest(`.${name}`));
      this.resize(PRINTED[place ?? "other"]);
    });
    addEventListener("afterprint", () => {
      printing = false;
      this.resize();
    });
    cursor.listeners.push(() => this.follow());
  }

  // Size of a pixel along an axis of the cursor, for the arrow keys.
  step() {
    return 0.01;
  }

  // For subclasses: what stands on the canvas, and what follows the cursor.
  paint() {}
  follow() {}
  spoken() {
    return `x ${millimetres(cursor.x)}, y ${millimetres(cursor.y)}`;
  }

  toX(value) {
    const [low, high] = this.axes.x.range;
    return MARGIN.left + ((value - low) / (high - low)) * this.width;
  }

  toY(value) {
    const { range, down } = this.axes.y;
    const share = (value - range[0]) / (range[1] - range[0]);
    return MARGIN.top + (down ? share : 1 - share) * this.height;
  }

  resize(whole = this.host.clientWidth) {
    if (whole <= MARGIN.left + MARGIN.right) return;
    this.width = whole - MARGIN.left - MARGIN.right;
    this.height = Math.round(this.frameHeight(this.width));
    const high = this.height + MARGIN.top + MARGIN.bottom;
    // By proportions, so that a printed page scales what was laid out for it.
    this.host.style.aspectRatio = `${whole} / ${high}`;
    this.svg.setAttribute("viewBox", `0 0 ${whole} ${high}`);
    if (!printing) {
      const dense = window.devicePixelRatio || 1;
      Object.assign(this.canvas, {
        width: Math.round(this.width * dense),
        height: Math.round(this.height * dense),
      });
    }
    Object.assign(this.canvas.style, {
      left: `${(100 * MARGIN.left) / whole}%`,
      top: `${(100 * MARGIN.top) / high}%`,
      width: `${(100 * this.width) / whole}%`,
      height: `${(100 * this.height) / high}%`,
    });
    this.redraw();
  }

  redraw() {
    if (!this.width) return;
    this.drawAxes();
    if (!printing) this.paint();
    this.follow();
  }

  drawAxes() {
    const { x, y } = this.axes;
    const { left, top } = MARGIN;
    const bottom = top + this.height;
    const parts = [];
    for (const value of ticks(...x.range, clamp(this.width / 70, 2, 8))) {
      const at = this.toX(value);
      if (this.gridded) parts.push(line("grid", at, top, at, bottom));
      parts.push(line("frame", at, bottom, at, bottom + 4), text(value, at, bottom + 16));
    }
    const values = ticks(...y.range, clamp(this.height / 45, 2, 8));
    const power = factor(values);
    for (const value of values) {
      const at = this.toY(value);
      const number = Number((value / 10 ** power).toPrecision(12));
      if (this.gridded) parts.push(line("grid", left, at, left + this.width, at));
      parts.push(line("frame", left - 4, at, left, at), text(number, left - 6, at + 4, "end"));
    }
    const label = power ? scaled(y.label, power) : y.label;
    parts.push(
      svg("rect", { class: "frame", x: left, y: top, width: this.width, height: this.height }),
      text(x.label, left + this.width / 2, bottom + 31),
      text(label, 0, 0, "middle", `translate(11 ${top + this.height / 2}) rotate(-90)`),
    );
    this.scenery.replaceChildren(...parts);
  }

  // Lines through the cursor, as far as it lies in the frame.
  cross(style = "") {
    const parts = [];
    if (!this.width) return parts;
    const { left, top } = MARGIN;
    for (const [direction, axis] of Object.entries(this.moves)) {
      if (!axis) continue;
      const [low, high] = this.axes[direction].range;
      if (cursor[axis] < low || cursor[axis] > high) continue;
      const at = direction === "x" ? this.toX(cursor[axis]) : this.toY(cursor[axis]);
      const ends =
        direction === "x" ? [at, top, at, top + this.height] : [left, at, left + this.width, at];
      if (!style) parts.push(line("halo", ...ends));
      parts.push(line(`cursor ${style}`, ...ends));
    }
    return parts;
  }

  listen(label) {
    const { host } = this;
    for (const [key, value] of Object.entries({
      tabindex: "0",
      role: "application",
      "aria-roledescription": "plot with a cursor",
      "aria-label": label,
      "aria-describedby": "keys",
    })) {
      host.setAttribute(key, value);
    }
    host.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      host.setPointerCapture(event.pointerId);
      this.point(event);
    });
    host.addEventListener("pointermove", (event) => {
      if (host.hasPointerCapture(event.pointerId)) this.point(event);
    });
    host.addEventListener("keydown", (event) => this.key(event));
  }

  // Move the cursor to where the pointer is.
  point(event) {
    const box = this.svg.getBoundingClientRect();
    const shares = {
      x: (event.clientX - box.left - MARGIN.left) / this.width,
      y: (event.clientY - box.top - MARGIN.top) / this.height,
    };
    if (!this.axes.y.down) shares.y = 1 - shares.y;
    const target = {};
    for (const [direction, axis] of Object.entries(this.moves)) {
      const [low, high] = this.axes[direction].range;
      if (axis) target[axis] = low + clamp(shares[direction], 0, 1) * (high - low);
    }
    cursor.move(target);
  }

  key(event) {
    const way = {
      ArrowLeft: ["x", -1],
      ArrowRight: ["x", 1],
      ArrowUp: ["y", 1],
      ArrowDown: ["y", -1],
    }[event.key];
    if (!way || event.altKey || event.ctrlKey || event.metaKey) return;
    const axis = this.keys ? this.keys[way[0]] : this.moves[way[0]];
    if (!axis) return;
    event.preventDefault();
    const far = event.shiftKey ? 10 : 1;
    cursor.move({ [axis]: cursor[axis] + way[1] * far * this.step(axis) });
    speak(() => this.spoken());
  }
}

function line(style, x1, y1, x2, y2) {
  return svg("line", { class: style, x1, y1, x2, y2 });
}

function text(content, x, y, anchor = "middle", transform = "") {
  const made = svg("text", { x, y, "text-anchor": anchor });
  if (transform) made.setAttribute("transform", transform);
  made.textContent = typeof content === "number" ? shown(content) : content;
  return made;
}

// Path through [x, y] pixels, interrupted where one is no number.
function path(points) {
  let pen = "M";
  let d = "";
  for (const [x, y] of points) {
    if (Number.isFinite(x) && Number.isFinite(y)) {
      d += `${pen}${x.toFixed(1)} ${y.toFixed(1)}`;
      pen = "L";
    } else {
      pen = "M";
    }
  }
  return d;
}
