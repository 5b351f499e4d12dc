// What the reader can take away: numbers as CSV, the large map as SVG and PNG.

function save(content, kind, name) {
  const link = element("a", { download: name });
  link.href = URL.createObjectURL(new Blob([content], { type: kind }));
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

const quoted = (value) => (/[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : value);

function mapTable(stage) {
  const { grid, entry, scale } = stage;
  const units = scale?.units ? ` (${scale.units})` : "";
  const rows = [["x (mm)", "y (mm)", entry.title + units].map(quoted).join(",")];
  for (let j = 0; j < grid.ny; j++) {
    for (let i = 0; i < grid.nx; i++) {
      const value = grid.values[j * grid.nx + i];
      const place = [grid.x0 + i * grid.dx, grid.y0 + j * grid.dy].map((v) => v.toFixed(5));
      rows.push([...place, Number.isFinite(value) ? value.toPrecision(5) : ""].join(","));
    }
  }
  return `${rows.join("\n")}\n`;
}

function shapeTable(stage) {
  const units = stage.scale?.units || "1";
  const names = ["shape", "x0 (mm)", "y0 (mm)", "x1 (mm)", "y1 (mm)", "length (mm) or area (mm2)"];
  names.push(...["mean", "standard deviation", "lowest", "highest"].map((n) => `${n} (${units})`));
  const rows = stage.shapes.map((shape) =>
    Object.values(stage.statistics(shape))
      .map((v) => (typeof v === "number" ? (Number.isFinite(v) ? v.toPrecision(6) : "") : v))
      .join(","),
  );
  names.push("force (mN)", `error of the mean (${units})`, "error of the force (mN)");
  return `${[names.join(","), ...rows].join("\n")}\n`;
}

const LONGEST = 640; // pixels of the frame of a picture, half of those of a PNG
const SHORTEST = 100; // of a strip: room for the scale bar

// Overlap of two ranges; the first where there is none.
function overlap(a, b) {
  const [low, high] = [Math.max(a[0], b[0]), Math.min(a[1], b[1])];
  return low < high ? [low, high] : a;
}

// Draw the large map with a frame of its own, which on the page is common to all maps and may leave
// room around this one; then call `use`, and draw the page as before.
function alone(stage, use) {
  const { axes, width, height, canvas } = stage;
  const { extent } = stage.grid;
  const x = overlap(axes.x.range, extent.x);
  const y = overlap(axes.y.range, extent.y);
  const sides = [x[1] - x[0], y[1] - y[0]];
  const scale = Math.max(LONGEST / Math.max(...sides), SHORTEST / Math.min(...sides));
  [stage.width, stage.height] = sides.map((side) => Math.round(scale * side));
  stage.axes = { x: { ...axes.x, range: x }, y: { ...axes.y, range: y } };
  stage.canvas = element("canvas", { width: 2 * stage.width, height: 2 * stage.height });
  stage.redraw();
  const made = use();
  Object.assign(stage, { axes, width, height, canvas });
  stage.redraw();
  return made;
}

// The large map with axes, colour bar and title, as a picture that stands alone.
const picture = (stage) => alone(stage, () => drawing(stage));

function drawing(stage) {
  const [width, height] = [stage.width + 150, stage.height + 80];
  const { scale } = stage;
  const whole = svg("svg", { viewBox: `0 0 ${width} ${height}`, width, height });
  const style = svg("style");
  style.textContent =
    "text{font:12px sans-serif;fill:#222}.frame{fill:none;stroke:#222}.shape,.hollow{fill:none}" +
    ".shape{stroke:#fff;stroke-width:1.5}.halo{stroke:#000;stroke-width:3;opacity:.55}" +
    ".cursor{display:none}.halo:not(.hollow){display:none}.plate{fill:#fff;opacity:.75}" +
    ".label{font-weight:bold;stroke:#fff;stroke-width:3;paint-order:stroke}";
  const body = svg("g", { transform: "translate(0 30)" });
  body.append(
    svg("image", {
      href: stage.canvas.toDataURL(),
      x: MARGIN.left,
      y: MARGIN.top,
      width: stage.width,
      height: stage.height,
    }),
    stage.scenery.cloneNode(true),
    stage.overlay.cloneNode(true),
  );
  const title = text(stage.entry.title + (scale?.units ? ` (${scale.units})` : ""), MARGIN.left, 20, "start");
  whole.append(svg("rect", { width, height, fill: "#fff" }), style, title, body);
  if (scale) {
    const left = MARGIN.left + stage.width + 20;
    const palette = palettes[scale.colours];
    for (let k = 0; k < 64; k++) {
      const rgb = palette.slice(12 * k, 12 * k + 3);
      const y = 30 + MARGIN.top + stage.height * (1 - (k + 1) / 64);
      const fill = `rgb(${rgb})`;
      whole.append(svg("rect", { x: left, y, width: 14, height: stage.height / 64 + 0.5, fill }));
    }
    for (const value of ticks(scale.low, scale.high, 6)) {
      const share = (value - scale.low) / (scale.high - scale.low);
      const y = 34 + MARGIN.top + stage.height * (1 - share);
      whole.append(text(value, left + 20, y, "start"));
    }
  }
  return [new XMLSerializer().serializeToString(whole), width, height];
}

async function savePicture(stage, kind) {
  const [drawn, width, height] = picture(stage);
  if (kind === "svg") return save(drawn, "image/svg+xml", `${stage.name}.svg`);
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(drawn)}`;
  await image.decode();
  const canvas = element("canvas", { width: 2 * width, height: 2 * height });
  canvas.getContext("2d").drawImage(image, 0, 0, 2 * width, 2 * height);
  canvas.toBlob((content) => save(content, "image/png", `${stage.name}.png`));
}

function linkDownloads(stage) {
  const on = (id, action) => document.getElementById(id).addEventListener("click", action);
  on("save-map", () => save(mapTable(stage), "text/csv", `${stage.name}.csv`));
  on("save-shapes", () => save(shapeTable(stage), "text/csv", "lines-and-rectangles.csv"));
  on("save-png", () => savePicture(stage, "png"));
  on("save-svg", () => savePicture(stage, "svg"));
}
