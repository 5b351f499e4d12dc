// The large map: any layer, its limits and colours, zoom, and lines and rectangles with statistics.

const controls = Object.fromEntries(
  [...document.querySelectorAll("#stage-controls [id]")].map((e) => [e.id.replace("stage-", ""), e]),
);

const LEAST = 384; // pixels along the longer side of the large map, if the screen has them

class Stage extends MapPlot {
  constructor(grids, masks, field, redrawAll) {
    const name = data.stage[0];
    super(data.maps[name], grids[name], masks[data.maps[name].mask], field);
    Object.assign(this, { name, grids, masks, field, redrawAll, shapes: [], tool: "cursor" });
    this.figure.dataset.stage = name;
    this.host.id = "stage-plot";
    this.regions = data.regions;
    const options = data.stage.map((key) =>
      element("option", { value: key }, data.maps[key].title),
    );
    controls.map.append(...options);
    controls.colours.append(
      ...Object.keys(data.colours).map((key) =>
        element("option", { value: key }, key.replace(/_r$/, ", reversed")),
      ),
    );
    controls.map.addEventListener("change", () => this.choose(controls.map.value));
    controls.colours.addEventListener("change", () => {
      this.scale.colours = controls.colours.value;
      this.redrawAll();
    });
    for (const end of ["low", "high"]) {
      controls[end].addEventListener("change", () => this.limit(end, controls[end].valueAsNumber));
    }
    controls.auto.addEventListener("click", () => {
      Object.assign(this.scale, this.scale.start);
      this.redrawAll();
    });
    controls.whole.addEventListener("click", () => this.zoom(this.whole.x, this.whole.y));
    for (const input of document.querySelectorAll('input[name="tool"]')) {
      input.addEventListener("change", () => this.take(input.value));
    }
    controls.clear.addEventListener("click", () => this.remove(() => true));
    this.listenForShapes();
    this.turnTo(name);
  }

  // As wide as lets the whole map be on the first screen; where little room is left, it must be
  // large enough all the same.
  fit() {
    this.fitted = { width: innerWidth, height: innerHeight };
    const least = LEAST / Math.max(1, this.aspect);
    for (let pass = 0; pass < 3; pass++) { // the caption of a narrower figure may take more lines
      this.resize();
      const box = this.figure.getBoundingClientRect();
      const [beside, around] = [box.width - this.width, box.height - this.height];
      const room = innerHeight - (box.top + scrollY) - around - 8;
      const wide = Math.floor(Math.max(room / this.aspect + beside, least));
      document.documentElement.style.setProperty("--map", `${wide}px`);
    }
  }

  // Not where only the bar of a phone's browser comes and goes: the map would change its size under
  // the finger.
  refit() {
    const { width, height } = this.fitted;
    if (!printing && (innerWidth !== width || Math.abs(innerHeight - height) > 120)) this.fit();
  }

  // Show another map, as soon as its values are there.
  async choose(name) {
    const [grid, mask] = [this.grids[name], this.masks[data.maps[name].mask]];
    await loaded([grid, mask, this.grids[data.maps[name].error]]);
    if (controls.map.value === name) this.turnTo(name); // no other was chosen meanwhile
  }

  turnTo(name) {
    const entry = data.maps[name];
    const [grid, mask] = [this.grids[name], this.masks[entry.mask]];
    Object.assign(this, { name, entry, grid, mask, scale: data.scales[entry.scale] });
    this.figure.dataset.stage = controls.map.value = name;
    this.figure.querySelector("figcaption span").textContent = entry.title;
    this.filled = mask && this.draw(mask, (value) => (value ? 0xff000000 : 0));
    for (const key of ["low", "high", "colours", "auto"]) controls[key].disabled = !this.scale;
    this.recolour();
    this.tell();
    this.follow();
  }

  recolour() {
    super.recolour();
    if (!this.scale) {
      // states have no limits, and those of the map before would be read as theirs
      for (const key of ["low", "high", "colours"]) controls[key].value = "";
      document.getElementById("stage-units").textContent = "";
      return;
    }
    controls.colours.value = this.scale.colours;
    for (const end of ["low", "high"]) {
      const span = this.scale.high - this.scale.low;
      const places = clamp(Math.ceil(-Math.log10(span / 2000)), 0, 9);
      controls[end].value = Number(this.scale[end].toFixed(places));
      controls[end].step = Number((span / 50).toPrecision(1));
    }
    document.getElementById("stage-units").textContent = this.scale.units;
  }

  limit(end, value) {
    const ends = { low: this.scale.low, high: this.scale.high, [end]: value };
    if (Number.isFinite(value) && ends.low < ends.high) this.scale[end] = value;
    this.redrawAll();
  }

  take(tool) {
    this.tool = tool;
    // A finger that draws must not scroll the page.
    this.host.style.touchAction = tool === "cursor" ? "" : "none";
  }

  zoom(x, y) {
    const part = framed(x, y, this.aspect, this.whole);
    this.axes.x.range = part.x;
    this.axes.y.range = part.y;
    this.redraw();
  }

  place(event) {
    const box = this.svg.getBoundingClientRect();
    const share = {
      x: clamp((event.clientX - box.left - MARGIN.left) / this.width, 0, 1),
      y: clamp(1 - (event.clientY - box.top - MARGIN.top) / this.height, 0, 1),
    };
    return ["x", "y"].map((axis) => {
      const [low, high] = this.axes[axis].range;
      return low + share[axis] * (high - low);
    });
  }

  listenForShapes() {
    const { host } = this;
    let start = null;
    const during = (event) => {
      const end = this.place(event);
      this.draft = { kind: this.tool === "line" ? "line" : "rectangle", points: [start, end] };
      this.follow();
    };
    host.addEventListener(
      "pointerdown",
      (event) => {
        if (this.tool === "cursor" || event.button !== 0) return;
        event.stopImmediatePropagation();
        event.preventDefault();
        host.setPointerCapture(event.pointerId);
        start = this.place(event);
      },
      true,
    );
    host.addEventListener(
      "pointermove",
      (event) => {
        this.hover = this.place(event);
        if (start) {
          event.stopImmediatePropagation(); // the cursor stays
          during(event);
        } else {
          this.follow();
        }
      },
      true,
    );
    host.addEventListener("pointerleave", () => {
      this.hover = null;
      this.follow();
    });
    host.addEventListener("pointerup", () => {
      if (!start) return;
      start = null;
      const draft = this.draft;
      this.draft = null;
      if (draft) this.finish(draft);
    });
    host.addEventListener("pointercancel", () => {
      start = this.draft = null;
      this.follow();
    });
  }

  finish({ kind, points: [a, b] }) {
    const low = a.map((v, k) => Math.min(v, b[k]));
    const high = a.map((v, k) => Math.max(v, b[k]));
    const wide = [high[0] - low[0], high[1] - low[1]];
    const least = [this.grid.dx, this.grid.dy];
    if (this.tool === "zoom") {
      if (wide[0] > least[0] && wide[1] > least[1]) this.zoom([low[0], high[0]], [low[1], high[1]]);
    } else if (kind === "line" ? Math.hypot(...wide) > least[0] / 2 : wide[0] * wide[1] > 0) {
      this.shapes.push({ kind, points: kind === "line" ? [a, b] : [low, high] });
      this.tell();
    }
    this.follow();
  }

  remove(which) {
    this.shapes = this.shapes.filter((shape, k) => !which(shape, k));
    this.tell();
    this.follow();
  }

  // Error of the map at a place where it has a value; NaN where none is known.
  errorAt(value, x, y, how = "at") {
    const grid = this.grids[this.entry.error];
    if (!grid?.values) return NaN;
    const error = grid[how](x, y);
    return this.entry.relative ? error * Math.abs(value) : error;
  }

  // Value, weight and error: of each pixel by the area of it that lies in a rectangle, where the share
  // of it follows; or of places along a line, a pixel apart, where the distance from its start does.
  // Of the outermost pixels half lies in the map.
  weighted({ kind, points: [a, b] }) {
    const { nx, ny, x0, dx, y0, dy, values } = this.grid;
    const found = [];
    if (kind === "line") {
      const n = Math.max(2, Math.ceil(Math.hypot(b[0] - a[0], b[1] - a[1]) / Math.min(dx, dy)) + 1);
      for (let k = 0; k < n; k++) {
        const at = a.map((v, axis) => v + (k / (n - 1)) * (b[axis] - v));
        const value = this.grid.between(...at);
        const distance = (k / (n - 1)) * Math.hypot(b[0] - a[0], b[1] - a[1]);
        found.push([value, 1, this.errorAt(value, ...at, "between"), distance]);
      }
      return found;
    }
    // The part of pixel k along an axis that lies between two places, and all of it, in pixels.
    const part = (k, count, first, size, low, high) => {
      const [begin, end] = [Math.max(k - 0.5, 0), Math.min(k + 0.5, count - 1)];
      const inside = Math.min(end, (high - first) / size) - Math.max(begin, (low - first) / size);
      return [clamp(inside, 0, end - begin), end - begin];
    };
    for (let j = 0; j < ny; j++) {
      const [inY, ofY] = part(j, ny, y0, dy, a[1], b[1]);
      if (!inY) continue;
      for (let i = 0; i < nx; i++) {
        const [inX, ofX] = part(i, nx, x0, dx, a[0], b[0]);
        if (!inX) continue;
        const value = values[j * nx + i];
        const error = this.errorAt(value, x0 + i * dx, y0 + j * dy);
        found.push([value, inX * inY, error, (inX * inY) / (ofX * ofY)]);
      }
    }
    return found;
  }

  statistics(shape) {
    const [a, b] = shape.points;
    const seen = this.weighted(shape).filter(([value]) => Number.isFinite(value));
    const total = seen.reduce((sum, [, w]) => sum + w, 0);
    const mean = seen.reduce((sum, [v, w]) => sum + v * w, 0) / total;
    // An error may be common to all pixels: its mean bounds that of the mean.
    const known = seen.filter(([, , error]) => Number.isFinite(error));
    const counted = known.reduce((sum, [, w]) => sum + w, 0);
    const error = known.reduce((sum, [, w, e]) => sum + e * w, 0) / counted;
    const square = seen.reduce((sum, [v, w]) => sum + w * (v - mean) ** 2, 0) / total;
    const line = shape.kind === "line";
    const inner = seen.filter(([, , , share]) => line || share >= 0.5).map(([v]) => v);
    const extremes = inner.length ? inner : seen.map(([v]) => v);
    const pixel = this.grid.dx * this.grid.dy;
    const forced = !line && this.entry.force;
    return {
      shape: shape.kind,
      x0: a[0],
      y0: a[1],
      x1: b[0],
      y1: b[1],
      size: line ? Math.hypot(b[0] - a[0], b[1] - a[1]) : (b[0] - a[0]) * (b[1] - a[1]),
      mean,
      deviation: Math.sqrt(square),
      lowest: extremes.reduce((p, q) => Math.min(p, q), Infinity),
      highest: extremes.reduce((p, q) => Math.max(p, q), -Infinity),
      force: forced ? this.entry.force * mean * total * pixel : NaN,
      meanError: error,
      forceError: forced ? error * total * pixel : NaN,
    };
  }

  // The table of lines and rectangles.
  tell() {
    const units = this.scale?.units ?? "";
    const body = document.querySelector("#shapes tbody");
    document.getElementById("shapes").hidden = !this.shapes.length;
    document.getElementById("shapes-caption").textContent =
      this.entry.title + (units ? `, ${units}` : "") + (this.entry.error ? "; errors are upper bounds" : "");
    document.getElementById("shapes-mean").textContent = this.entry.error ? "Mean \u00b1 error" : "Mean";
    // The read-out has the digits of the map; what is drawn by hand has fewer.
    const few = (value, unit) => shown(Number(value.toPrecision(3)), unit);
    body.replaceChildren(
      ...this.shapes.map((shape, k) => {
        const s = this.statistics(shape);
        const size = shape.kind === "line" ? "mm" : "mm\u00b2";
        const gone = element("button", { type: "button", "aria-label": `Remove ${k + 1}` }, "\u00d7");
        gone.addEventListener("click", () => this.remove((_, n) => n === k));
        // What has no error of its own has no more digits than the mean.
        const like = (value) => rounded(value, s.meanError)[0];
        const force = Number.isFinite(s.force) ? rounded(s.force, s.forceError).join("") : "";
        const cells = [
          `${k + 1} ${s.shape}`,
          few(s.size, size),
          rounded(s.mean, s.meanError).join(""),
          like(s.deviation),
          like(s.lowest),
          like(s.highest),
          force && `${force}\u202fmN`,
        ].map((text, n) => element(n ? "td" : "th", n ? {} : { scope: "row" }, text));
        return element("tr", {}, ...cells, element("td", {}, gone));
      }),
    );
    this.course();
  }

  // Values along the last line.
  course() {
    const last = this.shapes.findLast((shape) => shape.kind === "line");
    const target = document.getElementById("course");
    target.hidden = !last || !this.scale;
    if (target.hidden) return;
    const points = this.weighted(last).map(([value, , error, at]) => [at, value, error]);
    const label = `${this.entry.title}${this.scale.units ? ` (${this.scale.units})` : ""}`;
    target.replaceChildren(new CoursePlot(points, label).figure);
  }

  follow() {
    const at = this.hover ?? [cursor.x, cursor.y];
    const value = this.grid.at(...at);
    const name = this.scale ? shown(value, this.scale.units) : (data.states[value] ?? "no value");
    const filled = this.mask && this.mask.at(...at) === 1 ? " (interpolated)" : "";
    this.output.textContent = `x ${millimetres(at[0])}, y ${millimetres(at[1])}: ${name}${filled}`;
    if (!this.width) return;
    const parts = [];
    for (const { name: label, outlines } of this.regions) {
      // holes and islands are not named again
      outlines.forEach((outline, k) => parts.push(...this.outline(outline, true, k ? "" : label)));
    }
    [...this.shapes, ...(this.draft ? [this.draft] : [])].forEach(({ kind, points: [a, b] }, k) => {
      const corners = kind === "line" ? [a, b] : [a, [b[0], a[1]], b, [a[0], b[1]]];
      parts.push(...this.outline(corners, kind !== "line", String(k + 1)));
    });
    const corners = this.regions.flatMap((region) => region.outlines.flat());
    corners.push(...this.shapes.flatMap((shape) => shape.points));
    // What is drawn ends at the frame, of which a part may be shown.
    const frame = svg("clipPath", { id: "stage-frame" });
    const [x, y] = [MARGIN.left, MARGIN.top];
    frame.append(svg("rect", { x, y, width: this.width, height: this.height }));
    const drawn = svg("g", { "clip-path": "url(#stage-frame)" });
    drawn.append(...parts);
    this.overlay.replaceChildren(frame, ...this.cross(), drawn, ...this.scaleBar(corners));
  }

  outline(corners, closed, label) {
    const at = corners.map(([x, y]) => [this.toX(x), this.toY(y)]);
    const d = path(at) + (closed ? "Z" : "");
    const words = text(label, at[0][0] + 5, at[0][1] - 5, "start");
    words.setAttribute("class", "label");
    return [svg("path", { class: "halo hollow", d }), svg("path", { class: "shape", d }), words];
  }

  // A round length of about a quarter of the frame, on the left if something is drawn on the right.
  scaleBar(drawn) {
    const [low, high] = this.axes.x.range;
    const rough = (high - low) / 4;
    const power = 10 ** Math.floor(Math.log10(rough));
    const length = [5, 2, 1].find((m) => m * power <= rough * 1.001) * power;
    const wide = (length / (high - low)) * this.width;
    const bottom = MARGIN.top + this.height - 12;
    const far = MARGIN.left + this.width - 12;
    const taken = drawn.some(([x, y]) => this.toX(x) > far - wide - 40 && this.toY(y) > bottom - 60);
    const right = taken ? MARGIN.left + 12 + wide : far;
    const name = length < 0.1 ? `${Number((1000 * length).toPrecision(3))} \u00b5m` : `${length} mm`;
    const words = text(name, right - wide / 2, bottom - 9);
    words.setAttribute("class", "label");
    return [
      svg("rect", { class: "plate", x: right - wide - 8, y: bottom - 26, width: wide + 16, height: 34 }),
      svg("rect", { class: "scale-bar", x: right - wide, y: bottom - 4, width: wide, height: 5 }),
      words,
    ];
  }
}

// Values against the distance along a line.
class CoursePlot extends Plot {
  constructor(points, label) {
    const values = points.map(([, v]) => v).filter(Number.isFinite);
    let [low, high] = [Math.min(...values), Math.max(...values)];
    const ends = points.flatMap(([, v, e]) => [v - e, v + e]).filter(Number.isFinite);
    // With the error band, unless that dwarfs the values.
    [low, high] = [
      Math.min(low, Math.max(Math.min(...ends), 2 * low - high)),
      Math.max(high, Math.min(Math.max(...ends), 2 * high - low)),
    ];
    const margin = 0.06 * (high - low) || 1;
    super(
      {
        x: { range: [0, points.at(-1)[0]], label: "distance along the line (mm)" },
        y: { range: values.length ? [low - margin, high + margin] : [0, 1], label },
      },
      () => 170,
      { x: null, y: null },
      "",
    );
    this.gridded = true;
    this.canvas.remove();
    this.points = points;
    this.figure = element("figure", {}, this.host);
  }

  follow() {
    if (!this.width) return;
    const [low, high] = this.axes.y.range;
    const curve = path(this.points.map(([x, y]) => [this.toX(x), this.toY(y)]));
    // Cut at gaps, across which no band may run.
    const runs = [[]];
    for (const [x, y, e] of this.points) {
      if (Number.isFinite(y + e)) runs.at(-1).push([x, y, e]);
      else runs.push([]);
    }
    const edge = (run, sign) =>
      run.map(([x, y, e]) => [this.toX(x), this.toY(clamp(y + sign * e, low, high))]);
    const around = runs.filter((run) => run.length > 1);
    const d = around.map((run) => `${path([...edge(run, 1), ...edge(run, -1).reverse()])}Z`).join("");
    this.overlay.replaceChildren(
      ...(d ? [svg("path", { class: "band computational", d })] : []),
      svg("path", { class: "curve computational", d: curve }),
    );
  }
}
