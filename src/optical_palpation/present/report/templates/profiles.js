// Profiles through the cursor, and the course of the solution.

const bands = document.getElementById("bands");

class ProfilePlot extends Plot {
  constructor(axis, { label, range, maps, errors }, grids, field) {
    const margin = 0.06 * (range[1] - range[0]);
    super(
      {
        x: { range: field[axis], label: `${axis} (mm)` },
        y: { range: [range[0] - margin, range[1] + margin], label },
      },
      () => 190,
      { x: axis, y: null },
      `Profile along ${axis}: ${label}`,
    );
    this.gridded = true;
    this.canvas.remove();
    Object.assign(this, { axis, maps, grids, errors });
    this.output = element("output");
    this.title = element("span");
    const names = maps.map((name) =>
      element("span", {}, element("i", { class: `line ${name}` }), name.replace("-", " ")),
    );
    this.figure = element(
      "figure",
      {},
      element("figcaption", {}, this.title, this.output),
      this.host,
      element("div", { class: "legend" }, ...names),
    );
  }

  step(axis) {
    const grid = this.grids[this.maps.at(-1)];
    return axis === "x" ? grid.dx : grid.dy;
  }

  follow() {
    const across = this.axis === "x" ? "y" : "x";
    this.title.textContent = `Along ${this.axis} at ${across} = ${millimetres(cursor[across])}`;
    this.output.textContent = `${this.axis} ${millimetres(cursor[this.axis])}`;
    if (!this.width) return;
    const [low, high] = this.axes.y.range;
    const curves = [];
    const dots = [];
    for (const name of this.maps) {
      const points = this.grids[name]
        .along(this.axis, cursor)
        .map(([at, value]) => [this.toX(at), this.toY(clamp(value, low, high))]);
      if (bands.checked && this.errors[name]) {
        const error = this.grids[this.errors[name]];
        const place = (at) => (this.axis === "x" ? [at, cursor.y] : [cursor.x, at]);
        const edge = (sign) =>
          this.grids[name]
            .along(this.axis, cursor)
            .map(([at, v]) => [at, v + sign * error.at(...place(at))])
            .map(([at, v]) => [this.toX(at), this.toY(clamp(v, low, high))]);
        const around = [...edge(1), ...edge(-1).reverse()].filter((p) => p.every(Number.isFinite));
        curves.push(svg("path", { class: `band ${name}`, d: `${path(around)}Z` }));
      }
      curves.push(svg("path", { class: `curve ${name}`, d: path(points) }));
      const value = this.grids[name].at(cursor.x, cursor.y);
      if (!(value >= low && value <= high)) continue;
      const at = { cx: this.toX(cursor[this.axis]), cy: this.toY(value), r: 4 };
      dots.push(svg("circle", { class: `dot ${name}`, ...at }));
    }
    this.overlay.replaceChildren(...this.cross("thin"), ...curves, ...dots);
  }
}

// Load over the Newton iterations, one line for each grid; a dot is a load that was reached.
class ConvergencePlot extends Plot {
  constructor(steps) {
    const total = steps.reduce((sum, step) => sum + step.newton, 0);
    super(
      {
        x: { range: [0, total * 1.02], label: "Newton iterations" },
        y: { range: [0, 105], label: "load (%)" },
      },
      () => 190,
      { x: null, y: null },
      "",
    );
    this.gridded = true;
    this.canvas.remove();
    this.steps = steps;
    const last = steps.at(-1);
    const label = `${total} Newton iterations, ending at ${shown(100 * last.load)} % of the load`;
    this.svg.removeAttribute("aria-hidden");
    this.svg.setAttribute("role", "img");
    this.svg.setAttribute("aria-label", label);
    const grids = [...new Set(steps.map((step) => step.elements))];
    this.names = new Map(grids.map((elements, k) => [elements, ["algebraic", "computational"][k % 2]]));
    const items = grids.map((elements) =>
      element(
        "span",
        {},
        element("i", { class: `line ${this.names.get(elements)}` }),
        `${elements.toLocaleString("en")} elements`,
      ),
    );
    this.figure = element("figure", {}, this.host, element("div", { class: "legend" }, ...items));
  }

  follow() {
    if (!this.width) return;
    const parts = [];
    let done = 0;
    let before = { elements: null };
    for (const step of this.steps) {
      const style = this.names.get(step.elements);
      // A finer grid takes the load from the coarser one, at which it starts.
      const from = step.elements === before.elements ? before.load : null;
      const start = from ?? (before.elements === null ? 0 : step.load);
      const points = [
        [this.toX(done), this.toY(100 * start)],
        [this.toX(done + step.newton), this.toY(100 * step.load)],
      ];
      done += step.newton;
      parts.push(svg("path", { class: `curve ${style}`, d: path(points) }));
      parts.push(svg("circle", { class: `dot ${style}`, cx: points[1][0], cy: points[1][1], r: 4 }));
      before = step;
    }
    this.overlay.replaceChildren(...parts);
  }
}
