// Maps: colours on a canvas, hatching where pixels are interpolated, a colour bar and a read-out.

const hatching = document.getElementById("hatch");

const palettes = Object.fromEntries(
  Object.entries(data.colours).map(([name, digits]) => [
    name,
    digits.match(/../g).map((pair) => parseInt(pair, 16)),
  ]),
);

// The same as the bytes of a pixel: red lowest, opaque.
const packed = ([r, g, b]) => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;

const style = getComputedStyle(document.documentElement);
const ownColour = (name) => style.getPropertyValue(`--${name}`).trim();
const bytesOf = (colour) => colour.match(/[0-9a-f]{2}/gi).map((pair) => parseInt(pair, 16));

// A range of a given length about the middle of another, moved into a third where it must lie within.
function stretched([low, high], length, within = [-Infinity, Infinity]) {
  const start = clamp((low + high - length) / 2, within[0], within[1] - length);
  return [start, start + length];
}

// The least frame of some proportions, height to width, that holds two ranges true to scale.
function framed(x, y, aspect, within = {}) {
  const [wide, high] = [x[1] - x[0], y[1] - y[0]];
  return {
    x: stretched(x, Math.max(wide, high / aspect), within.x),
    y: stretched(y, Math.max(high, wide * aspect), within.y),
  };
}

class MapPlot extends Plot {
  constructor(entry, grid, mask, field) {
    // True to scale: a strip leaves room empty.
    const aspect = clamp((field.y[1] - field.y[0]) / (field.x[1] - field.x[0]), 0.25, 1.6);
    const { x, y } = framed(field.x, field.y, aspect);
    super(
      { x: { range: x, label: "x (mm)" }, y: { range: y, label: "y (mm)" } },
      (width) => aspect * width,
      { x: "x", y: "y" },
      entry.title,
    );
    Object.assign(this, { entry, grid, mask, aspect, whole: { x, y } });
    this.scale = data.scales[entry.scale];
    this.output = element("output");
    const title = element("span", {}, entry.title);
    const caption = element("figcaption", { class: "two" }, title, this.output);
    this.figure = element("figure", {}, caption, this.host, this.scale ? this.bar() : this.legend());
    this.recolour();
    this.filled = mask && this.draw(mask, (value) => (value ? 0xff000000 : 0));
  }

  step(axis) {
    return axis === "x" ? this.grid.dx : this.grid.dy;
  }

  // Draw the pixels anew, after a change of limits or colours.
  recolour() {
    this.image = this.draw(this.grid, this.scale ? this.shades() : this.states());
    const below = this.scale ? this.bar() : this.legend();
    this.figure.lastElementChild.replaceWith(below);
    if (this.width) this.paint();
  }

  value() {
    const value = this.grid.at(cursor.x, cursor.y);
    const name = this.scale ? shown(value, this.scale.units) : (data.states[value] ?? "no value");
    return this.mask && this.mask.at(cursor.x, cursor.y) === 1 ? `${name} (interpolated)` : name;
  }

  spoken() {
    return `${super.spoken()}, ${this.entry.title} ${this.value()}`;
  }

  follow() {
    this.output.textContent = this.value();
    this.overlay.replaceChildren(...this.cross());
  }

  shades() {
    const { low, high, colours } = this.scale;
    const palette = palettes[colours];
    const shades = Array.from({ length: 256 }, (_, k) => packed(palette.slice(3 * k, 3 * k + 3)));
    const step = 256 / (high - low);
    return (value) =>
      Number.isFinite(value) ? shades[clamp(Math.floor(step * (value - low)), 0, 255)] : 0;
  }

  states() {
    const colours = Object.fromEntries(
      Object.entries(data.states).map(([k, name]) => [k, packed(bytesOf(ownColour(name)))]),
    );
    return (value) => colours[value] ?? 0;
  }

  // One canvas pixel for each pixel of the map; y points up. 0 is transparent.
  draw(grid, colour) {
    const { nx, ny, values } = grid;
    const pixels = new ImageData(nx, ny);
    const whole = new Uint32Array(pixels.data.buffer);
    for (let j = 0; j < ny; j++) {
      const row = (ny - 1 - j) * nx;
      for (let i = 0; i < nx; i++) whole[row + i] = colour(values[j * nx + i]);
    }
    const canvas = element("canvas", { width: nx, height: ny });
    canvas.getContext("2d").putImageData(pixels, 0, 0);
    return { canvas, extent: grid.extent };
  }

  paint() {
    const brush = this.canvas.getContext("2d");
    brush.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.lay(brush, this.image);
    if (!this.filled || !hatching.checked) return;
    const cover = element("canvas", { width: this.canvas.width, height: this.canvas.height });
    const pen = cover.getContext("2d");
    pen.fillStyle = pattern(pen);
    pen.fillRect(0, 0, cover.width, cover.height);
    pen.globalCompositeOperation = "destination-in";
    this.lay(pen, this.filled);
    brush.drawImage(cover, 0, 0);
  }

  // Put an image where it lies in the frame.
  lay(brush, { canvas, extent }) {
    const dense = this.canvas.width / this.width;
    const left = (this.toX(extent.x[0]) - MARGIN.left) * dense;
    const top = (this.toY(extent.y[1]) - MARGIN.top) * dense;
    const width = (this.toX(extent.x[1]) - MARGIN.left) * dense - left;
    const height = (this.toY(extent.y[0]) - MARGIN.top) * dense - top;
    brush.imageSmoothingEnabled = width < canvas.width;
    brush.imageSmoothingQuality = "high";
    brush.drawImage(canvas, left, top, width, height);
  }

  bar() {
    const { low, high, units, colours } = this.scale;
    const palette = palettes[colours];
    const stops = [];
    for (let k = 0; k < 256; k += 15) stops.push(`rgb(${palette.slice(3 * k, 3 * k + 3)})`);
    const strip = element("i");
    strip.style.background = `linear-gradient(to right, ${stops})`;
    const unit = units && `\u202f${units}`;
    const ends = alike([low, (low + high) / 2, high], (high - low) / 200).map((number) =>
      element("span", {}, number + unit),
    );
    const label = `Colours from ${shown(low, units)} to ${shown(high, units)}`;
    return element("div", { class: "colours", role: "img", "aria-label": label }, strip, ...ends);
  }

  legend() {
    const areas = {};
    let whole = 0;
    this.grid.values.forEach((value, k) => {
      const part = this.grid.part(k);
      areas[value] = (areas[value] ?? 0) + part;
      whole += part;
    });
    const present = Object.entries(data.states).filter(([k]) => areas[k]);
    const items = present.map(([k, name]) => {
      const share = (100 * areas[k]) / whole;
      const swatch = element("i", { class: `swatch ${name}` });
      return element("span", {}, swatch, `${name} ${share.toFixed(1)}\u202f%`);
    });
    return element("div", { class: "legend" }, ...items);
  }
}

// Diagonal lines in the colour of interpolated pixels, over a tint of it that marks single pixels, too.
function pattern(pen) {
  const size = 8;
  const tile = element("canvas", { width: size, height: size });
  const brush = tile.getContext("2d");
  brush.fillStyle = brush.strokeStyle = ownColour("filled");
  brush.globalAlpha = 0.3;
  brush.fillRect(0, 0, size, size);
  brush.globalAlpha = 1;
  brush.lineWidth = 2;
  for (const shift of [-size, 0, size]) {
    brush.beginPath();
    brush.moveTo(shift - 1, -1);
    brush.lineTo(shift + size + 1, size + 1);
    brush.stroke();
  }
  return pen.createPattern(tile, "repeat");
}
