// B-scans with the boundaries that were found on them.

const boundaries = document.getElementById("lines");
const zoomed = document.getElementById("zoom");
const magnified = document.getElementById("magnify");

class ScanPlot extends Plot {
  static async from(block) {
    const entry = JSON.parse(block.textContent);
    block.remove(); // the text is no longer needed
    const names = Object.keys(entry.lines);
    const values = await Promise.all(names.map((name) => numbers(entry.lines[name])));
    entry.lines = Object.fromEntries(names.map((name, k) => [name, values[k]]));
    return new ScanPlot(block.dataset.state, entry);
  }

  constructor(state, entry) {
    const [left, width, top, depth] = entry.extent;
    const whole = { x: [left, left + width], y: [top, top + depth] };
    super(
      {
        x: { range: whole.x, label: "x (mm)" },
        y: { range: whole.y, label: "depth z (mm)", down: true },
      },
      // Depth is stretched where the true proportions would leave a strip.
      (frame) => frame * clamp(depth / width, 0.45, 0.9),
      { x: "x", y: null },
      `B-scan, ${state}`,
    );
    Object.assign(this, { state, entry, whole, keys: { x: "x", y: "y" } });
    this.image = new Image();
    this.index = -1;
    this.output = element("output");
    const title = `B-scan, ${state}`;
    const caption = element("figcaption", {}, element("span", {}, title), this.output);
    this.note = element("p", { class: "quiet" });
    this.figure = element("figure", {}, caption, this.host, this.note);
    this.seen = { x: NaN, y: NaN }; // the cursor, when the plot last followed it
    this.dragged = null; // the middle of what is shown, where the reader moved it
    this.listenForDrags();
  }

  step(axis) {
    const { y } = this.entry;
    if (axis === "y") return y.length > 1 ? y[1] - y[0] : 0;
    return this.entry.x ? this.entry.x[1] : (this.whole.x[1] - this.whole.x[0]) / 500;
  }

  spoken() {
    return `${this.output.textContent}, ${super.spoken()}`;
  }

  // The stored B-scan nearest to a place.
  nearest(y) {
    const at = this.entry.y;
    return clamp(Math.round((y - at[0]) / (this.step("y") || 1)), 0, at.length - 1);
  }

  // Where the boundaries run in the whole volume, with a margin.
  layerDepths() {
    const { window: upper, sample: lower } = this.entry.lines;
    if (!upper) return this.whole.y;
    const low = upper.reduce((a, b) => (b < a ? b : a), Infinity);
    const high = lower.reduce((a, b) => (b > a ? b : a), -Infinity);
    const margin = 0.15 * (high - low);
    return [low - margin, high + margin];
  }

  follow() {
    const index = this.nearest(cursor.y);
    if (index !== this.index) this.show(index);
    if (cursor.x !== this.seen.x || cursor.y !== this.seen.y) {
      this.seen = { x: cursor.x, y: cursor.y };
      this.dragged = null;
      if (this.magnification > 1) return this.redraw(); // what is enlarged follows, too
    }
    if (this.width) this.overlay.replaceChildren(...this.outlines(), ...this.cross());
  }

  // Load a B-scan; the one before stays until it is there.
  async show(index) {
    this.index = index;
    const { rows, count, y, pictures } = this.entry;
    this.output.textContent = `${rows[index] + 1} of ${count}, y ${millimetres(y[index])}`;
    const image = new Image();
    image.src = `data:image/jpeg;base64,${pictures[index]}`;
    await image.decode();
    if (index !== this.index) return;
    this.image = image;
    this.paint();
  }

  paint() {
    if (!this.width || !this.image.naturalWidth) return;
    const brush = this.canvas.getContext("2d");
    const { naturalWidth: nx, naturalHeight: nz } = this.image;
    const [z0, z1] = this.axes.y.range;
    const [x0, x1] = this.axes.x.range;
    const [top, bottom] = this.whole.y;
    const [left, right] = this.whole.x;
    const first = ((z0 - top) / (bottom - top)) * nz;
    const tall = ((z1 - z0) / (bottom - top)) * nz;
    const begin = ((x0 - left) / (right - left)) * nx;
    const wide = ((x1 - x0) / (right - left)) * nx;
    brush.imageSmoothingEnabled = wide > this.canvas.width;
    brush.imageSmoothingQuality = "high";
    brush.drawImage(this.image, begin, first, wide, tall, 0, 0, this.canvas.width, this.canvas.height);
    this.canvas.dataset.row = this.entry.rows[this.index];
  }

  get magnification() {
    return Number(magnified.value);
  }

  get shownDepths() {
    return zoomed.checked ? this.layer : this.whole.y;
  }

  // Depth that is enlarged: of the boundary that the reader pointed at, else of that of the sample.
  boundary() {
    const { lines, x } = this.entry;
    const [low, high] = this.shownDepths;
    if (!lines.window) return (low + high) / 2;
    const n = lines.window.length / this.entry.rows.length;
    const at = this.nearest(cursor.y) * n + clamp(Math.round((cursor.x - x[0]) / x[1]), 0, n - 1);
    const [upper, lower] = [lines.window[at], lines.sample[at]];
    const depth = Math.abs(this.depth - upper) < Math.abs(this.depth - lower) ? upper : lower;
    return Number.isFinite(depth) ? depth : (low + high) / 2;
  }

  // Show all, or enlarge both directions alike about the boundary at the cursor.
  aim() {
    if (this.magnification === 1) this.dragged = null;
    const target = this.dragged ?? { x: cursor.x, y: this.boundary() };
    for (const [axis, [low, high]] of [["x", this.whole.x], ["y", this.shownDepths]]) {
      const half = (high - low) / 2 / this.magnification;
      const at = clamp(target[axis], low + half, high - half);
      this.axes[axis].range = [at - half, at + half];
    }
    // A finger that moves the enlarged part must not scroll the page.
    this.host.style.touchAction = this.magnification > 1 ? "none" : "";
  }

  // Move the enlarged part by pixels of the screen; false where it is at the end already.
  move(right, down) {
    const before = ["x", "y"].map((axis) => this.axes[axis].range);
    const [[x0, x1], [y0, y1]] = before;
    this.dragged = {
      x: (x0 + x1) / 2 + (right / this.width) * (x1 - x0),
      y: (y0 + y1) / 2 + (down / this.height) * (y1 - y0),
    };
    this.redraw();
    const { x, y } = this.axes;
    this.dragged = { x: middle(x.range), y: middle(y.range) };
    return Math.abs(x.range[0] - x0) + Math.abs(y.range[0] - y0) > 1e-9;
  }

  point(event) {
    const top = this.svg.getBoundingClientRect().top + MARGIN.top;
    const [low, high] = this.axes.y.range;
    this.depth = low + ((event.clientY - top) / this.height) * (high - low);
    super.point(event);
  }

  // Where it is enlarged, a drag moves the picture; a click moves the cursor, as everywhere.
  listenForDrags() {
    const { host } = this;
    let last = null;
    let far = false;
    host.addEventListener(
      "pointerdown",
      (event) => {
        if (this.magnification === 1 || event.button !== 0) return;
        event.stopImmediatePropagation();
        host.setPointerCapture(event.pointerId);
        last = [event.clientX, event.clientY];
        far = false;
      },
      true,
    );
    host.addEventListener(
      "pointermove",
      (event) => {
        if (!last) return;
        event.stopImmediatePropagation();
        const [right, down] = [last[0] - event.clientX, last[1] - event.clientY];
        if (!far && Math.hypot(right, down) < 4) return; // a click with an unsteady hand
        far = true;
        last = [event.clientX, event.clientY];
        this.move(right, down);
      },
      true,
    );
    host.addEventListener("pointerup", (event) => {
      if (last && !far) this.point(event);
      last = null;
    });
    host.addEventListener("pointercancel", () => (last = null));
    host.addEventListener(
      "wheel",
      (event) => {
        if (this.magnification === 1 || event.ctrlKey) return;
        const lines = event.deltaMode ? 16 : 1; // pixels, or lines of text
        // At the end of the picture, the page scrolls on.
        if (this.move(lines * event.deltaX, lines * event.deltaY)) event.preventDefault();
      },
      { passive: false },
    );
  }

  key(event) {
    const way = { PageUp: -1, PageDown: 1 }[event.key];
    if (!way || this.magnification === 1) return super.key(event);
    event.preventDefault();
    this.move(0, (way * this.height) / 4);
  }

  redraw() {
    this.aim();
    if (!this.width) return;
    super.redraw();
    const { x, y } = this.axes;
    const stretch =
      this.height / (y.range[1] - y.range[0]) / (this.width / (x.range[1] - x.range[0]));
    this.note.textContent =
      (Math.abs(stretch - 1) > 0.05 ? `Depth drawn ${shown(Number(stretch.toPrecision(2)))} times as long. ` : "") +
      `Black to white: ${shown(Number(this.entry.range.toPrecision(2)), "dB")}.`;
  }

  outlines() {
    const { lines, x } = this.entry;
    if (!boundaries.checked || !lines.window) return [];
    const n = lines.window.length / this.entry.rows.length;
    const start = this.index * n;
    const parts = [];
    for (const side of ["window", "sample"]) {
      const seen = [];
      const unseen = [];
      const madeUp = lines[`${side}_filled`];
      const filled = (k) => madeUp[start + clamp(k, 0, n - 1)];
      for (let i = 0; i < n; i++) {
        const depth = lines[side][start + i];
        const point = [this.toX(x[0] + i * x[1]), this.toY(depth)];
        seen.push(filled(i) ? [NaN, NaN] : point);
        // One pixel more on either side, so that no gap is left between the two.
        unseen.push(filled(i - 1) || filled(i) || filled(i + 1) ? point : [NaN, NaN]);
      }
      parts.push(
        svg("path", { class: "boundary unseen", d: path(unseen) }),
        svg("path", { class: `boundary ${side}`, d: path(seen) }),
      );
    }
    // Of an enlarged part, the lines end at the frame.
    const frame = svg("clipPath", { id: `frame-${this.state}` });
    const [left, top] = [MARGIN.left, MARGIN.top];
    frame.append(svg("rect", { x: left, y: top, width: this.width, height: this.height }));
    const drawn = svg("g", { "clip-path": `url(#frame-${this.state})` });
    drawn.append(...parts);
    return [frame, drawn];
  }
}
