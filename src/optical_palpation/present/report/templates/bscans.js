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

  // What of the width is shown: all of it, or a part about the cursor.
  window() {
    const [left, right] = this.whole.x;
    const half = (right - left) / 2 / Number(magnified.value);
    const middle = clamp(cursor.x, left + half, right - half);
    return [middle - half, middle + half];
  }

  redraw() {
    this.axes.y.range = zoomed.checked ? this.layer : this.whole.y;
    this.axes.x.range = this.window();
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
    const [low, high] = this.axes.y.range;
    const parts = [];
    for (const side of ["window", "sample"]) {
      const seen = [];
      const unseen = [];
      for (let i = 0; i < n; i++) {
        const depth = lines[side][start + i];
        const inside = depth >= low && depth <= high;
        const at = x[0] + i * x[1];
        const across = at >= this.axes.x.range[0] - x[1] && at <= this.axes.x.range[1] + x[1];
        const point = [this.toX(at), inside && across ? this.toY(depth) : NaN];
        const filled = (k) => lines.filled[start + clamp(k, 0, n - 1)];
        seen.push(filled(i) ? [NaN, NaN] : point);
        // One pixel more on either side, so that no gap is left between the two.
        unseen.push(filled(i - 1) || filled(i) || filled(i + 1) ? point : [NaN, NaN]);
      }
      parts.push(
        svg("path", { class: "boundary unseen", d: path(unseen) }),
        svg("path", { class: `boundary ${side}`, d: path(seen) }),
      );
    }
    return parts;
  }
}
