// The page's data: JSON, in which maps are packed as pixels, compressed, in base64.

const data = JSON.parse(document.getElementById("data").textContent);

async function unpack(text) {
  const letters = atob(text);
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i);
  const plain = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(plain).arrayBuffer());
}

// Numbers of four bytes come sorted by the bytes' significance, lowest first.
async function numbers({ type, data }) {
  const bytes = await unpack(data);
  if (type === "u1") return bytes;
  const n = bytes.length / 4;
  const sorted = new Uint8Array(4 * n);
  for (let k = 0; k < 4; k++) {
    for (let i = 0; i < n; i++) sorted[4 * i + k] = bytes[k * n + i];
  }
  return new Float32Array(sorted.buffer); // browsers run on little-endian machines
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

// Values on evenly spaced pixels; positions in mm. There are no values before they are loaded.
class Grid {
  constructor(entry) {
    this.entry = entry;
    [this.ny, this.nx] = entry.shape;
    [this.y0, this.dy] = entry.y;
    [this.x0, this.dx] = entry.x;
  }

  load() {
    this.loading ??= numbers(this.entry).then((values) => {
      this.values = values;
      this.entry = null; // the text is no longer needed
    });
    return this.loading;
  }

  get extent() {
    const { x0, dx, nx, y0, dy, ny } = this;
    return { x: [x0 - dx / 2, x0 + (nx - 0.5) * dx], y: [y0 - dy / 2, y0 + (ny - 0.5) * dy] };
  }

  // Centres of the outermost pixels.
  get centres() {
    const { x0, dx, nx, y0, dy, ny } = this;
    return { x: [x0, x0 + (nx - 1) * dx], y: [y0, y0 + (ny - 1) * dy] };
  }

  // Part of a pixel that lies in the map, which ends at its outermost points.
  part(k) {
    const half = (at, count) => (count > 1 && (at === 0 || at === count - 1) ? 0.5 : 1);
    return half(k % this.nx, this.nx) * half(Math.floor(k / this.nx), this.ny);
  }

  column(x) {
    return Math.round((x - this.x0) / this.dx);
  }

  row(y) {
    return Math.round((y - this.y0) / this.dy);
  }

  // NaN outside.
  at(x, y) {
    const i = this.column(x);
    const j = this.row(y);
    return i < 0 || j < 0 || i >= this.nx || j >= this.ny ? NaN : this.values[j * this.nx + i];
  }

  // Interpolated between the centres of pixels, as the profiles of results are: NaN beyond the
  // outermost, and where one of the four around has no value. States are those of the nearest.
  between(x, y) {
    if (this.values instanceof Uint8Array || this.nx < 2 || this.ny < 2) return this.at(x, y);
    const find = (at, first, step, n) => {
      const place = (at - first) / step;
      if (place < -1e-6 || place > n - 1 + 1e-6) return [NaN, NaN];
      const k = clamp(Math.floor(place), 0, n - 2);
      return [k, clamp(place - k, 0, 1)];
    };
    const [i, right] = find(x, this.x0, this.dx, this.nx);
    const [j, up] = find(y, this.y0, this.dy, this.ny);
    if (!Number.isFinite(i + j)) return NaN;
    const row = (k) => {
      const [a, b] = this.values.subarray(k * this.nx + i, k * this.nx + i + 2);
      return a + right * (b - a);
    };
    return row(j) + up * (row(j + 1) - row(j));
  }

  // Values along an axis through a place: [position, value] pairs.
  along(axis, place) {
    const pairs = [];
    const n = axis === "x" ? this.nx : this.ny;
    for (let k = 0; k < n; k++) {
      const at = axis === "x" ? this.x0 + k * this.dx : this.y0 + k * this.dy;
      pairs.push([at, axis === "x" ? this.at(at, place.y) : this.at(place.x, at)]);
    }
    return pairs;
  }
}

// Four digits, with the minus of print.
function shown(value, units = "") {
  if (!Number.isFinite(value)) return "no value";
  const digits = Number(value.toPrecision(4)).toString().replace("-", "\u2212");
  return units ? `${digits}\u202f${units}` : digits;
}

// To the digits that its error leaves, two of the error, with that error; else to three digits.
function rounded(value, error) {
  if (!Number.isFinite(value)) return ["no value", ""];
  if (!(error > 0)) return [shown(Number(value.toPrecision(3))), ""];
  const two = Number(error.toPrecision(2));
  const place = 1 - Math.floor(Math.log10(two));
  const written = (v) => {
    const whole = 10 ** -place;
    const kept = place < 0 ? Math.round(v / whole) * whole : v;
    const text = kept.toFixed(clamp(place, 0, 20));
    // what rounds to zero has no sign
    return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "\u2212");
  };
  return [written(value), `\u00a0\u00b1\u00a0${written(two)}`];
}

// Numbers with as many decimals each as tell steps of a size apart, less zeros that all end in.
function alike(values, step) {
  const most = clamp(Math.ceil(-Math.log10(step)), 0, 9);
  const written = (places) => values.map((v) => v.toFixed(places).replace("-", "\u2212"));
  let places = most;
  while (places > 0 && written(places).every((text) => text.endsWith("0"))) places -= 1;
  return written(places);
}

function millimetres(value) {
  return `${value.toFixed(3).replace("-", "\u2212")}\u202fmm`;
}

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}
