// Puts the page together and links its parts through the cursor.

async function build() {
  const grids = gridsOf(data.maps);
  const masks = gridsOf(data.masks);
  const field = span(grids, "extent");
  cursor.limits = span(grids, "centres");
  const { x, y } = grids[data.profiles.stress.maps[0]].centres;
  const plots = [];
  const profiles = [];

  // The stress is on the screen before anything else is unpacked.
  const first = data.maps[data.stage[0]];
  await loaded([grids[data.stage[0]], masks[first.mask]]);
  const stage = new Stage(grids, masks, field, () => {
    for (const plot of plots) if (plot.scale) plot.recolour();
    profiles.forEach((plot) => plot.redraw());
  });
  plots.push(stage);
  document.getElementById("stage").append(stage.figure);
  linkDownloads(stage);
  cursor.move({ x: middle(x), y: middle(y) });
  stage.fit();
  addEventListener("resize", () => stage.refit());
  await drawn();
  performance.mark("first-map");

  await loaded([...Object.values(grids), ...Object.values(masks)]);
  for (const [name, entry] of Object.entries(data.maps).filter(([, entry]) => entry.group)) {
    const plot = new MapPlot(entry, grids[name], masks[entry.mask], field);
    plot.figure.dataset.map = name;
    document.querySelector(`[data-group="${entry.group}"]`).append(plot.figure);
    plots.push(plot);
  }
  for (const [group, profile] of Object.entries(data.profiles)) {
    const place = document.querySelector(`[data-profile="${group}"]`);
    for (const axis of ["x", "y"]) {
      profiles.push(new ProfilePlot(axis, profile, grids, field));
      place.append(profiles.at(-1).figure);
    }
  }
  if (data.convergence.length) {
    document.querySelector(".convergence").append(new ConvergencePlot(data.convergence).figure);
  }
  const blocks = [...document.querySelectorAll("script.scan")];
  const scans = await Promise.all(blocks.map((block) => ScanPlot.from(block)));
  if (scans.length) linkScans(scans);
  bands.addEventListener("change", () => profiles.forEach((plot) => plot.redraw()));
  bands.parentElement.hidden = !Object.values(data.profiles).some((p) => Object.keys(p.errors).length);
  linkBar(plots, Object.values(masks).some((mask) => mask.values.some(Boolean)));
  cursor.move({}); // what is new follows where the reader has it by now
}

const middle = ([low, high]) => (low + high) / 2;

const gridsOf = (entries) =>
  Object.fromEntries(Object.entries(entries).map(([name, entry]) => [name, new Grid(entry)]));

const loaded = (grids) => Promise.all(grids.map((grid) => grid?.load()));

// Until the browser has put on the screen what there is. A hidden page is never drawn.
const drawn = () =>
  new Promise((resolve) => {
    requestAnimationFrame(() => setTimeout(resolve));
    if (document.hidden) resolve();
  });

// What all grids span together.
function span(grids, kind) {
  const ranges = (axis) => Object.values(grids).map((grid) => grid[kind][axis]);
  const union = (axis) => [
    Math.min(...ranges(axis).map((range) => range[0])),
    Math.max(...ranges(axis).map((range) => range[1])),
  ];
  return { x: union("x"), y: union("y") };
}

function linkScans(scans) {
  document.querySelector(".scans").append(...scans.map((plot) => plot.figure));
  const slider = document.getElementById("slice");
  const label = document.getElementById("slice-text");
  const main = scans.at(-1); // the loaded volume, if there is one
  const zooms = scans.map((plot) => plot.layerDepths());
  const shared = [Math.min(...zooms.map((z) => z[0])), Math.max(...zooms.map((z) => z[1]))];
  for (const plot of scans) {
    plot.layer = [Math.max(shared[0], plot.whole.y[0]), Math.min(shared[1], plot.whole.y[1])];
  }
  slider.max = main.entry.y.length - 1;
  slider.addEventListener("input", () => cursor.move({ y: main.entry.y[slider.value] }));
  cursor.listeners.push(() => {
    const index = main.nearest(cursor.y);
    if (Number(slider.value) !== index) slider.value = index;
    label.textContent = `y ${millimetres(main.entry.y[index])}`;
    slider.setAttribute("aria-valuetext", `B-scan ${main.output.textContent}`);
  });
  zoomed.addEventListener("input", () => scans.forEach((plot) => (plot.dragged = null)));
  for (const input of [boundaries, zoomed, magnified]) {
    input.addEventListener("input", () => scans.forEach((plot) => plot.redraw()));
  }
  if (!scans.some((plot) => plot.entry.lines.window)) {
    boundaries.parentElement.hidden = zoomed.parentElement.hidden = true;
    document.getElementById("lines-legend").hidden = true;
  }
  const interpolated = scans.some(({ entry: { lines } }) =>
    ["window", "sample"].some((side) => lines[`${side}_filled`]?.some((of) => of)),
  );
  document.getElementById("unseen-label").hidden = !interpolated;
}

function linkBar(plots, masked) {
  document.getElementById("bar").addEventListener("submit", (event) => event.preventDefault());
  for (const axis of ["x", "y"]) {
    const input = document.getElementById(`cursor-${axis}`);
    const write = () => (input.value = cursor[axis].toFixed(3));
    input.addEventListener("change", () => {
      if (Number.isFinite(input.valueAsNumber)) cursor.move({ [axis]: input.valueAsNumber });
      write();
    });
    // What is being typed must not be overwritten.
    cursor.listeners.push(() => document.activeElement === input || write());
  }
  document.getElementById("hatch-label").hidden = !masked;
  hatching.addEventListener("change", () => plots.forEach((plot) => plot.paint()));
}

// The contents: in a row where there is room, else folded until they are asked for.
function linkContents() {
  const contents = document.getElementById("contents");
  const room = matchMedia("(min-width: 60rem)");
  const unfold = () => (contents.open = room.matches);
  room.addEventListener("change", unfold);
  unfold();
  // What a link leads to must not come to lie below the bar, whose height depends on the width.
  const bar = document.querySelector(".bar");
  const root = document.documentElement;
  new ResizeObserver(() => (root.style.scrollPaddingTop = `${bar.offsetHeight + 8}px`)).observe(bar);
  const links = [...contents.querySelectorAll("a")];
  contents.addEventListener("click", (event) => {
    if (links.includes(event.target) && !room.matches) contents.open = false;
  });
  const targets = links.map((link) => document.querySelector(link.hash));
  const mark = () => {
    // The last part that has begun in the upper third of the window, or the last one at its end.
    const ended = scrollY + innerHeight >= root.scrollHeight - 2;
    const begun = targets.filter((e) => e.getBoundingClientRect().top < innerHeight / 3);
    const current = (ended ? targets : begun).at(-1);
    links.forEach((link, k) => {
      if (targets[k] === current) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    });
  };
  let waiting = false;
  addEventListener(
    "scroll",
    () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => {
        waiting = false;
        mark();
      });
    },
    { passive: true },
  );
  mark();
}

const copy = document.getElementById("copy");
copy.addEventListener("click", async () => {
  const code = document.getElementById("code");
  try {
    await navigator.clipboard.writeText(code.textContent);
    copy.textContent = "Copied";
  } catch {
    // Where the page may not write to the clipboard, the reader can.
    getSelection().selectAllChildren(code);
    copy.textContent = "Selected: now copy it";
  }
});

linkContents();
try {
  await build();
  requestAnimationFrame(() => {
    performance.mark("all-maps");
    document.documentElement.dataset.ready = "yes";
  });
} catch (error) {
  const failed = document.getElementById("failed");
  failed.textContent = `The maps cannot be drawn (${error}). They need a browser of 2023 or later.`;
  failed.hidden = false;
  console.error(error);
}
