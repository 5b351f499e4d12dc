"""The report, driven in a real browser and compared with the numbers that went into it."""

import base64
import io
import json
import re
import shutil
import zlib
from importlib.resources import files

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose
from PIL import Image

from optical_palpation.errors import InputError, OutputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import algebraic_result
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present import write_report
from optical_palpation.present.report.bscans import BYTES, draw_volume
from optical_palpation.present.report.content import convergence_rows, map_entries
from optical_palpation.present.report.document import _json
from optical_palpation.present.report.maps import encode_floats, encode_map
from optical_palpation.present.summary import contact_share
from optical_palpation.present.terms import common_limits
from optical_palpation.thickness import clean_thickness, thickness_map
from optical_palpation.volume import open_volume

NZ, NY, NX = 120, 24, 36
DZ, DY, DX = 0.01, 0.1, 0.05
Z0, Y0, X0 = 0.2, 1.0, -0.5
Y, X = Y0 + DY * np.arange(NY), X0 + DX * np.arange(NX)
FILLED = np.zeros((NY, NX), bool)
FILLED[4:9, 6:10] = True
TITLE = "Layer </title><script>window.broken = 1</script> & 5 \u00b5m"
PYTHON = 'print("<b>a</b>")  # </code></script><script>window.broken = 1</script>'
PARAMETERS = {
    "note": "<img src=x onerror='window.broken = 1'>",
    "nothing": None,
    "layer": {"window": "line", "inner": {"ranges": (0.25, 0.5), "seen": True}},
}
WARNINGS = ["In 1.9 % of the map <i>nothing</i> was seen.", "</li></script>"]


def window_depth(y, x):
    return 0.4 + 0.03 * y + 0 * x


def thickness(y, x, pressed):
    return 0.5 - pressed * (0.05 + 0.03 * np.cos(4 * x) + 0.02 * y)


def layer(pressed):
    y, x = np.meshgrid(Y, X, indexing="ij")
    top, thick = window_depth(y, x), thickness(y, x, pressed)
    grid = ("y", "x")
    quality = np.where(FILLED, 0.0, 0.9 - 0.1 * x)
    return xr.Dataset(
        {
            "window_depth": (grid, top),
            "sample_depth": (grid, top + thick),
            "thickness": (grid, thick),
            "quality": (grid, quality),
            "filled": (grid, FILLED),
        },
        {"y": Y, "x": X},
    )


def marker(row):
    """Column of the bright bar that tells one B-scan from another."""
    return 3 + row


def samples(found, seed):
    """A volume `[z, y, x]`: noise, a line at the window, and scattering below the layer."""
    random = np.random.default_rng(seed)
    z = (Z0 + DZ * np.arange(NZ))[:, None, None]
    top, bottom = found["window_depth"].values, found["sample_depth"].values
    signal = random.rayleigh(1.0, (NZ, NY, NX))
    signal *= 1 + 10 * (z > bottom) * np.exp(-3 * np.clip(z - bottom, 0, None))
    signal += 200 * np.exp(-(((z - top) / DZ) ** 2))
    for row in range(NY):
        signal[40:50, row, marker(row)] += 60
    return signal.astype(np.float32)


def stress_result():
    y, x = np.linspace(1.2, 3.0, 11), np.linspace(-0.4, 1.1, 13)
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    stress = -3 - grid_x - 0.5 * grid_y**2
    computational = 1.5 * stress
    computational[0, :3] = np.nan
    state = np.where(grid_x < 0, ContactState.OPEN, np.where(grid_x < 0.6, ContactState.SLIP, 2))
    grid = ("y", "x")
    maps = xr.Dataset(
        {
            "axial_stress": (grid, computational),
            "algebraic_axial_stress": (grid, stress),
            "contact_pressure": (grid, -computational),
            "contact_state": (grid, state.astype(np.int8)),
            "window_contact_state": (grid, np.full_like(state, ContactState.STICK)),
            "loaded_thickness": (grid, thickness(grid_y, grid_x, 1.0)),
        },
        {"y": y, "x": x},
        attrs={
            "window_force_mN": 31.5,
            "sample_force_mN": 31.25,
            "force_balance": 0.008,
            "initial_thickness_mm": 0.5,
            "volume_change_percent": 3.0,
            "convergence": json.dumps(
                [
                    {"elements": 96, "load": 0.5, "newton": 7},
                    {"elements": 96, "load": 1.0, "newton": 5},
                    {"elements": 768, "load": 1.0, "newton": 4},
                ]
            ),
        },
    )
    return StressResult(maps)


def stored(folder, name, content):
    np.save(folder / f"{name}.npy", content)
    return open_volume(
        folder / f"{name}.npy",
        axes="zyx",
        spacing={"z": DZ, "y": DY, "x": DX},
        origin={"z": Z0, "y": Y0, "x": X0},
        scale="linear",
        refractive_index=1.0,
    )


LAYERS = {"unloaded": layer(0.0), "loaded": layer(1.0)}


@pytest.fixture(scope="module")
def volumes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volumes")
    opened = {
        name: stored(folder, name, samples(found, seed))
        for seed, (name, found) in enumerate(LAYERS.items())
    }
    yield opened
    for volume in opened.values():
        volume.close()


def write(path, result, volumes=None, loaded=None, unloaded=None, **texts):
    texts = {"parameters": {}, "python": "", "title": "Study", "warnings": []} | texts
    write_report(path, result, loaded=loaded, unloaded=unloaded, volumes=volumes, **texts)
    return path


@pytest.fixture(scope="module")
def study(volumes, tmp_path_factory):
    return write(
        tmp_path_factory.mktemp("report") / "study.html",
        stress_result(),
        volumes,
        **LAYERS,
        parameters=PARAMETERS,
        python=PYTHON,
        title=TITLE,
        warnings=WARNINGS,
    )


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("no Chromium on this machine")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def show(browser):
    """Open a report; in the end the console must be empty, and nothing have been asked for."""
    told, asked, contexts = [], [], []

    def opened(path, width=1366, height=768, **settings):
        context = browser.new_context(viewport={"width": width, "height": height}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: told.append(message.text))
        page.on("pageerror", lambda error: told.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-ready]", state="attached")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert told == []
    assert [url for url in asked if not url.startswith(("data:", "file:///"))] == []
    assert len([url for url in asked if url.startswith("file:")]) == len(contexts)


@pytest.fixture
def page(show, study):
    return show(study)


def settle(page):
    """Wait until the next picture of the screen is drawn."""
    page.evaluate("() => new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))")


def plot(page, name):
    return page.locator(f"[data-map='{name}'] .plot")


def frame(page, host):
    """Place of a plot's frame on the page: left, top, width, height."""
    return host.locator("svg rect.frame").evaluate(
        "(r) => { const b = r.getBoundingClientRect(); return [b.x, b.y, b.width, b.height] }"
    )


def click(page, host, right, up):
    """Click in a plot at shares of its frame, counted from the lower left."""
    host.scroll_into_view_if_needed()
    left, top, width, height = frame(page, host)
    page.mouse.click(left + right * width, top + (1 - up) * height)
    settle(page)


def place(page):
    return tuple(float(page.locator(f"#cursor-{axis}").input_value()) for axis in "xy")


def readout(page, name):
    return page.locator(f"[data-map='{name}'] figcaption output").inner_text()


def number(text):
    return float(text.split("\u202f")[0].replace("\u2212", "-"))


def scan(page, state):
    names = [
        re.search(r"\w+$", t)[0] for t in page.locator(".scans figcaption > span").all_inner_texts()
    ]
    return page.locator(".scans .plot").nth(names.index(state))


def go_to_slice(page, row):
    page.locator("#slice").fill(str(row))
    page.wait_for_selector(f".scans figure:nth-child(2) canvas[data-row='{row}']")
    page.wait_for_selector(f".scans figure:nth-child(1) canvas[data-row='{row}']")
    settle(page)


def grey(host):
    """Brightness of a plot's canvas, `[row, column]`."""
    url = host.locator("canvas").evaluate("(c) => c.toDataURL()")
    picture = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1])))
    return np.asarray(picture.convert("L"), float)


def points(host, style):
    """Pixels of a curve in a plot's SVG."""
    texts = host.locator(f"svg path.{style}").evaluate_all(
        "(p) => p.map((q) => q.getAttribute('d'))"
    )
    return np.array(
        [[float(v) for v in p.split()] for p in re.findall(r"[ML]([^MLZ]+)", "".join(texts))]
    )


def test_slider_moves_the_bscan_and_every_bscan_is_the_right_one(page):
    before = grey(scan(page, "loaded"))
    for row in (0, 9, 23):
        go_to_slice(page, row)
        for state in ("unloaded", "loaded"):
            image = grey(scan(page, state))
            # The bar lies where nothing else is bright, between the window and the sample.
            bar = image[int(0.35 * len(image)) : int(0.4 * len(image))].mean(0)
            column = (np.argmax(bar) + 0.5) / image.shape[1] * NX - 0.5
            assert column == pytest.approx(marker(row), abs=0.6)
        assert place(page)[1] == pytest.approx(Y[row], abs=1e-3)
        text = page.locator("#slice").get_attribute("aria-valuetext")
        assert f"{row + 1} of {NY}" in text
    assert not np.array_equal(before, grey(scan(page, "loaded")))


@pytest.mark.parametrize("zoom", [False, True])
def test_boundaries_lie_on_the_image(page, zoom):
    go_to_slice(page, 20)
    if zoom:
        page.locator("#zoom").check()
        settle(page)
    for state, found in LAYERS.items():
        host = scan(page, state)
        image = grey(host)
        box = host.bounding_box()
        left, top, width, height = frame(page, host)
        low, high = depths(found) if zoom else (Z0 - DZ / 2, Z0 + (NZ - 0.5) * DZ)
        for side in ("window", "sample"):
            x, y = points(host, f"boundary.{side}").T
            assert len(x) == NX
            depth = low + (y - (top - box["y"])) / height * (high - low)
            assert depth == pytest.approx(found[f"{side}_depth"].values[20], abs=0.004)
            at = ((x - (left - box["x"])) / width - 0.5 / NX) * NX
            assert at == pytest.approx(np.arange(NX), abs=0.1)
        # The line of the window itself, as it is drawn.
        x, y = points(host, "boundary.window").T
        rows = (y - (top - box["y"])) / height * len(image)
        above = int((0.55 - low) / (high - low) * len(image))  # the bar is below
        bright = np.argmax(image[:above], axis=0)
        columns = ((x - (left - box["x"])) / width * image.shape[1]).astype(int)
        # Half a pixel of the volume.
        assert bright[columns] == pytest.approx(rows, abs=0.6 * len(image) * DZ / (high - low))


def labelled(host):
    """Range in mm of a plot's frame along x and y, from the numbers at its axes."""
    ranges = []
    for axis in (0, 1):
        texts = host.locator("svg text").evaluate_all(
            """(t, axis) => t.filter((e) => !e.getAttribute("transform"))
                .filter((e) => (e.getAttribute("text-anchor") === "end") === Boolean(axis))
                .map((e) => [e.textContent, Number(e.getAttribute(axis ? "y" : "x"))])""",
            axis,
        )
        found = [
            (float(t.replace("\u2212", "-")), at - 4 * axis)
            for t, at in texts
            if re.fullmatch("[\u2212\\d.e-]+", t)
        ]
        rect = host.locator("svg rect.frame")
        start, size = (
            float(rect.get_attribute(name)) for name in ("xy"[axis], ("width", "height")[axis])
        )
        slope, first = np.polyfit([at for _, at in found], [v for v, _ in found], 1)
        ranges.append((first + slope * start, first + slope * (start + size)))
    return ranges


def test_a_boundary_can_be_enlarged_in_both_directions_and_the_picture_moved(page):
    go_to_slice(page, 20)
    host, found = scan(page, "loaded"), LAYERS["loaded"]
    whole = labelled(host)
    x = 0.4
    top = float(found["window_depth"].sel(x=x, method="nearest")[20])
    # Point at the window, so that it is what is enlarged.
    (left, right), (low, high) = whole
    click(page, host, (x - left) / (right - left), 1 - (top - 0.02 - low) / (high - low))
    page.locator("#magnify").fill("8")
    settle(page)
    part = labelled(host)
    for axis, (was, now) in enumerate(zip(whole, part, strict=True)):
        assert now[1] - now[0] == pytest.approx((was[1] - was[0]) / 8, rel=0.02)
        assert np.mean(now) == pytest.approx((x, top)[axis], abs=0.01)
    # The line lies where the picture is brightest, to a tenth of a pixel of the volume or so.
    image = grey(host)
    _, y = points(host, "boundary.window").T
    rect = host.locator("svg rect.frame")
    row = (y.mean() - float(rect.get_attribute("y"))) / float(rect.get_attribute("height"))
    bright = np.argmax(image.mean(1)) / len(image)
    assert abs(bright - row) * (part[1][1] - part[1][0]) < DZ
    # A drag moves the picture, not the cursor; so does the wheel, until the end is reached.
    before = place(page)
    _, _, wide, tall = frame(page, host)
    start = [a + b / 2 for a, b in zip(frame(page, host)[:2], (wide, tall), strict=True)]
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + 0.2 * wide, start[1] - 0.3 * tall, steps=4)
    page.mouse.up()
    settle(page)
    moved = labelled(host)
    assert place(page) == before
    for (was, now), share in zip(zip(part, moved, strict=True), (-0.2, 0.3), strict=True):
        assert now[0] - was[0] == pytest.approx(
            share * (was[1] - was[0]), abs=0.1 * (was[1] - was[0])
        )
    scrolled = page.evaluate("() => scrollY")
    page.mouse.wheel(0, 0.5 * tall)
    page.wait_for_timeout(100)
    lower = labelled(host)[1]
    assert lower[0] - moved[1][0] == pytest.approx(0.5 * (lower[1] - lower[0]), rel=0.05)
    assert page.evaluate("() => scrollY") == scrolled
    host.focus()
    page.keyboard.press("PageUp")
    settle(page)
    assert lower[0] - labelled(host)[1][0] == pytest.approx(0.25 * (lower[1] - lower[0]), rel=0.05)
    # A click moves the cursor, and what is enlarged with it.
    click(page, host, 0.9, 0.5)
    assert place(page)[0] == pytest.approx(
        moved[0][0] + 0.9 * (moved[0][1] - moved[0][0]), abs=2e-3
    )
    assert np.mean(labelled(host)[0]) == pytest.approx(place(page)[0], abs=2e-3)
    page.locator("#magnify").fill("1")
    settle(page)
    assert np.ravel(labelled(host)) == pytest.approx(np.ravel(whole))


def depths(found):
    """Range of depth that zooming leaves: both layers and a margin of each, within the volume."""
    low, high = [], []
    for one in LAYERS.values():
        top, bottom = float(one["window_depth"].min()), float(one["sample_depth"].max())
        low.append(top - 0.15 * (bottom - top))
        high.append(bottom + 0.15 * (bottom - top))
    return max(min(low), Z0 - DZ / 2), min(max(high), Z0 + (NZ - 0.5) * DZ)


def test_filled_stretches_are_marked_and_boundaries_can_be_hidden(page):
    host = scan(page, "loaded")
    go_to_slice(page, 15)
    assert len(points(host, "boundary.unseen")) == 0
    go_to_slice(page, 6)
    # Columns 5 to 10 are 6 to 9 and their neighbours, on either side of the layer.
    assert len(points(host, "boundary.unseen")) == 2 * 6
    assert len(points(host, "boundary.sample")) == NX - 4
    page.locator("#lines").uncheck()
    settle(page)
    assert host.locator("svg path.boundary").count() == 0
    page.locator("#lines").check()
    settle(page)
    assert host.locator("svg path.boundary").count() == 4


def expected(name, x, y):
    maps = stress_result().maps
    fields = {
        "algebraic": maps["algebraic_axial_stress"],
        "computational": maps["axial_stress"],
        "unloaded-thickness": LAYERS["unloaded"]["thickness"],
        "loaded-thickness": LAYERS["loaded"]["thickness"],
        "unloaded-quality": LAYERS["unloaded"]["quality"],
        "loaded-quality": LAYERS["loaded"]["quality"],
    }
    return float(fields[name].sel(x=x, y=y, method="nearest"))


def test_cursor_is_linked_through_all_maps(page):
    names = page.locator("figure[data-map]").evaluate_all("(f) => f.map((g) => g.dataset.map)")
    assert len(names) == 8  # two are the same everywhere, which is said in words
    said = page.locator("#stress").inner_text()
    assert "contact with the window: stick everywhere" in said
    assert "unloaded thickness: the same everywhere" in said
    for name, right, up in (("algebraic", 0.4, 0.3), ("loaded-quality", 0.7, 0.55)):
        click(page, plot(page, name), right, up)
        x, y = place(page)
        assert x == pytest.approx(X[0] - DX / 2 + right * NX * DX, abs=0.01)
        assert y == pytest.approx(Y[0] - DY / 2 + up * NY * DY, abs=0.01)
        for other in names:
            lines = (
                plot(page, other)
                .locator("svg line.cursor")
                .evaluate_all(
                    "(l) => l.map((m) => m.getBoundingClientRect()).map((b) => [b.x, b.y])"
                )
            )
            left, top, width, height = frame(page, plot(page, other))
            assert (lines[0][0] - left) / width == pytest.approx(right, abs=0.01)
            assert (lines[1][1] - top) / height == pytest.approx(1 - up, abs=0.01)
        for other in ("algebraic", "computational", "loaded-thickness", "unloaded-quality"):
            assert number(readout(page, other)) == pytest.approx(expected(other, x, y), rel=2e-3)
        row = int(np.argmin(np.abs(Y - y)))
        page.wait_for_selector(f".scans canvas[data-row='{row}']")
        assert page.locator("#slice").input_value() == str(row)


def test_readout_names_contact_missing_and_filled(page):
    go = page.locator("#cursor-x").fill, page.locator("#cursor-y").fill

    def at(x, y):
        for fill, value in zip(go, (x, y), strict=True):
            fill(str(value))
            page.keyboard.press("Enter")
        settle(page)

    at(-0.4, 1.2)
    assert readout(page, "computational") == "no value"
    assert readout(page, "contact_state") == "open"
    at(1.05, 2.0)
    assert readout(page, "contact_state") == "stick"
    at(X[7], Y[6])
    assert "(interpolated)" in readout(page, "loaded-thickness")
    assert readout(page, "loaded-quality") == "0 (interpolated)"
    at(X[20], Y[20])
    assert "interpolated" not in readout(page, "loaded-thickness")
    at(1e6, -1e6)  # beyond the field: its corner
    assert place(page) == (pytest.approx(X[-1]), pytest.approx(Y[0]))
    page.locator("#cursor-x").fill("")
    page.keyboard.press("Enter")
    assert place(page)[0] == pytest.approx(X[-1])


def test_the_legend_of_contact_tells_the_share_of_the_area(page):
    said = page.locator("[data-map='contact_state'] .legend").inner_text()
    found = {name: float(share) for name, share in re.findall(r"(\w+) ([\d.]+)\u202f%", said)}
    maps = stress_result().maps
    wanted = {s.name.lower(): 100 * contact_share(maps, s) for s in ContactState}
    assert found == pytest.approx({name: s for name, s in wanted.items() if s}, abs=0.06)


def test_profiles_follow_the_cursor_and_show_the_maps_values(page):
    hosts = page.locator("[data-profile='stress'] .plot")
    click(page, plot(page, "computational"), 0.5, 0.35)
    first = [points(hosts.nth(k), "curve.computational") for k in (0, 1)]
    click(page, plot(page, "computational"), 0.55, 0.6)
    x, y = place(page)
    result = stress_result().maps["axial_stress"]
    lines = result.sel(y=y, method="nearest"), result.sel(x=x, method="nearest")
    for k, curve in enumerate(lines):
        drawn = points(hosts.nth(k), "curve.computational")
        known = curve.dropna("xy"[k])
        assert drawn.shape == (known.size, 2)
        assert not np.array_equal(drawn, first[k])
        # Straight relations between pixels and mm, pixels and kPa; the same for every cursor.
        assert abs(np.corrcoef(drawn[:, 0], known["xy"[k]])[0, 1]) > 1 - 1e-6
        assert np.corrcoef(drawn[:, 1], known)[0, 1] < -(1 - 1e-4)
        heading = page.locator("[data-profile='stress'] figcaption").nth(k).inner_text()
        assert f"{(y, x)[k]:.3f}" in heading


def test_keyboard_alone(page):
    host = plot(page, "loaded-thickness")
    host.focus()
    assert host.evaluate("(e) => getComputedStyle(e).outlineStyle") == "solid"
    x, y = place(page)
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    settle(page)
    assert place(page) == (pytest.approx(x + DX, abs=2e-3), pytest.approx(y + DY, abs=2e-3))
    page.keyboard.press("Shift+ArrowLeft")
    page.keyboard.press("ArrowDown")
    settle(page)
    assert place(page) == (pytest.approx(x - 9 * DX, abs=2e-3), pytest.approx(y, abs=2e-3))
    page.wait_for_timeout(400)
    assert "Loaded thickness" in page.locator("#spoken").text_content()

    page.locator("#slice").focus()
    row = int(page.locator("#slice").input_value())
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(f".scans canvas[data-row='{row + 1}']")
    settle(page)
    assert place(page)[1] == pytest.approx(Y[row + 1], abs=1e-3)
    scan(page, "loaded").focus()
    page.keyboard.press("ArrowDown")
    page.wait_for_selector(f".scans canvas[data-row='{row}']")

    # Everything that can be used can be reached with the tabulator, and has a name.
    page.locator("body").press("Home")
    page.evaluate("() => document.activeElement.blur()")
    reached = []
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "() => { const e = document.activeElement; return [e.tagName + (e.id || ''),"
                " e.getAttribute('aria-label') || e.labels?.[0]?.innerText || e.innerText] }"
            )
        )
    labels = {name for tag, name in reached if tag == "DIV"}
    assert {"Algebraic stress", "Loaded thickness", "B-scan, loaded"} <= labels
    tags = {tag for tag, _ in reached}
    assert {"INPUTcursor-x", "INPUThatch", "INPUTslice", "INPUTzoom", "BUTTONcopy"} <= tags
    assert all(name and name.strip() for tag, name in reached if tag != "BODY")


def test_stress_maps_share_fixed_limits(page):
    maps = stress_result().maps
    names = ("axial_stress", "algebraic_axial_stress")
    both = np.array([np.nanpercentile(maps[name], [1, 99]) for name in names])
    low, high = both.min(), both.max()
    for _ in range(2):
        for name in ("algebraic", "computational"):
            ends = page.locator(f"[data-map='{name}'] .colours span").all_inner_texts()
            assert number(ends[0]) == pytest.approx(low, rel=1e-3)
            assert number(ends[2]) == pytest.approx(high, rel=1e-3)
            assert all(end.endswith("kPa") for end in ends)
        click(page, plot(page, "computational"), 0.2, 0.8)
    # The most compressed pixel of each map has the colour of its value on the common scale.
    from matplotlib import colormaps

    for name, variable in (
        ("algebraic", "algebraic_axial_stress"),
        ("computational", "axial_stress"),
    ):
        field = maps[variable]
        x, y = 0.85, 1.7
        share = (float(field.sel(x=x, y=y, method="nearest")) - low) / (high - low)
        url = plot(page, name).locator("canvas").evaluate("(c) => c.toDataURL()")
        picture = np.asarray(
            Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
        )
        column = int((x - (X[0] - DX / 2)) / (NX * DX) * picture.shape[1])
        row = int((1 - (y - (Y[0] - DY / 2)) / (NY * DY)) * picture.shape[0])
        colour = colormaps["viridis_r"](min(int(256 * share), 255), bytes=True)[:3]
        assert picture[row, column] == pytest.approx(np.array(colour), abs=3)


def test_hatching_marks_filled_pixels_and_can_be_switched_off(page):
    def changed(name, before):
        after = np.abs(grey(plot(page, name)) - before) > 2
        rows, columns = np.nonzero(after)
        return rows / after.shape[0], columns / after.shape[1]

    before = {name: grey(plot(page, name)) for name in ("loaded-quality", "contact_state")}
    page.locator("#hatch").uncheck()
    settle(page)
    rows, columns = changed("loaded-quality", before["loaded-quality"])
    assert 1 - rows.max() == pytest.approx(4 / NY, abs=0.02)
    assert 1 - rows.min() == pytest.approx(9 / NY, abs=0.02)
    assert columns.min() == pytest.approx(6 / NX, abs=0.02)
    assert columns.max() == pytest.approx(10 / NX, abs=0.02)
    assert len(changed("contact_state", before["contact_state"])[0]) == 0


def test_texts_stay_texts(page):
    assert page.title() == TITLE
    assert page.locator("h1").inner_text() == TITLE
    assert page.locator("#code").inner_text() == PYTHON
    # No line breaks between a number and its unit.
    warnings = [
        text.replace("\u00a0", " ") for text in page.locator("#warnings li").all_inner_texts()
    ]
    assert warnings[:2] == WARNINGS
    assert "volume of the layer changed by 3.0 %" in warnings[2]
    rows = page.locator("#parameters table.wide >> tr").evaluate_all(
        "(r) => r.map((t) => [...t.children].map((c) => c.textContent))"
    )
    for row in (
        ["note", PARAMETERS["note"]],
        ["nothing", "not given"],
        ["window", "line"],
        ["inner.ranges", "0.25, 0.5"],
        ["inner.seen", "yes"],
    ):
        assert row in rows
    assert page.evaluate("() => window.broken") is None
    page.locator("#copy").click()
    page.locator("#copy", has_text=re.compile("Copied|Selected")).wait_for()
    assert page.locator("main img").count() == 0


def test_data_cannot_end_their_script_element():
    text = "</script><script>alert(1)</script><!--"
    embedded = _json({text: text})
    assert "<" not in embedded
    assert json.loads(embedded) == {text: text}


def test_unknown_convergence_records_are_left_out():
    result = stress_result()
    broken = '[{"elements": "<b>", "load": 1, "newton": 2}]'
    for record in ("", "3", '[{"load": 1}]', broken, broken.replace('"<b>"', "1e999"), 7):
        result.maps.attrs["convergence"] = record
        assert convergence_rows(result) == []


def test_forces_and_convergence(page):
    text = page.locator("#solution").inner_text().replace("\u00a0", " ")
    for part in ("31.5 mN", "31.2 mN", "0.8 %"):
        assert part in text
    rows = page.locator("#solution table").nth(1).locator("tr").all_inner_texts()
    assert [row.split("\t")[0] for row in rows[1:]] == ["Mean", "1st percentile", "Most compressed"]
    stress = stress_result().maps["axial_stress"]
    force, area = (f.integrate(["y", "x"]) for f in (stress.fillna(0), 1.0 * stress.notnull()))
    for row, value in zip(
        rows[1:], (force / area, stress.quantile(0.01), stress.min()), strict=True
    ):
        assert number(row.split("\t")[2]) == pytest.approx(float(value), rel=5e-3)
    rows = page.locator("#solution details tr").evaluate_all(
        "(r) => r.map((t) => [...t.children].map((c) => c.textContent))"
    )
    assert rows[1:] == [["96", "50 %", "7"], ["96", "100 %", "5"], ["768", "100 %", "4"]]
    assert page.locator(".convergence svg circle").count() == 3
    assert page.locator(".convergence svg").get_attribute("aria-label") == (
        "16 Newton iterations, ending at 100 % of the load"
    )


@pytest.mark.parametrize(
    ("scale", "power"), [(1e-4, "10\u207b\u00b3 "), (1.0, ""), (300.0, "10\u00b3 ")]
)
@pytest.mark.parametrize("width", [1366, 390])
def test_small_and_large_numbers_do_not_lie_on_each_other(show, tmp_path, width, scale, power):
    maps = stress_result().maps
    for name in ("axial_stress", "algebraic_axial_stress", "contact_pressure"):
        maps[name] = scale * maps[name]
    page = show(write(tmp_path / "scaled.html", StressResult(maps)), width, 844)
    page.locator(".maps").first.scroll_into_view_if_needed()
    # numbers below colour bars: none beyond the bar, nor on its neighbour
    beyond = page.evaluate(
        """() => [...document.querySelectorAll(".colours")].filter((bar) => {
            const seen = [...bar.querySelectorAll("span")].map((span) => {
                const range = document.createRange();
                range.selectNodeContents(span);
                return [range.getBoundingClientRect(), span.getBoundingClientRect()];
            }).filter(([text, box]) => text.top < box.bottom - 2).map(([text]) => text);
            const whole = bar.getBoundingClientRect();
            return seen.length < 2 || seen.some((text, k) =>
                text.left < whole.left - 1 || text.right > whole.right + 1
                || (k && text.left < seen[k - 1].right + 2));
        }).length"""
    )
    assert beyond == 0
    host = page.locator(".profiles .plot").first
    host.scroll_into_view_if_needed()
    boxes = host.locator("svg text").evaluate_all(
        """(all) => all.map((e) => [e.hasAttribute("transform"), e.getAttribute("text-anchor"),
            e.getBoundingClientRect().left, e.getBoundingClientRect().right])"""
    )
    label = max(right for turned, _, _, right in boxes if turned)
    assert min(left for turned, at, left, _ in boxes if at == "end") > label
    assert host.locator("svg text[transform]").text_content() == f"axial stress ({power}kPa)"
    low, high = labelled(host)[1]
    shown = {"": 1.0, "10\u207b\u00b3 ": 1e-3, "10\u00b3 ": 1e3}[power]
    stress = maps["axial_stress"].values / shown
    assert min(low, high) == pytest.approx(np.nanmin(stress), rel=0.2)


@pytest.mark.parametrize("width", [390, 320])
def test_phone(show, study, width):
    page = show(study, width, 844, has_touch=True, is_mobile=True, device_scale_factor=2)
    size = page.evaluate("() => [document.documentElement.scrollWidth, innerWidth]")
    assert size == [width, width]
    wide = page.evaluate(
        "() => [...document.querySelectorAll('main *:not(pre *):not(.warnings summary *)')]"
        ".filter((e) => e.getBoundingClientRect().right > innerWidth + 1).length"
    )
    assert wide == 0
    host = plot(page, "computational")
    host.scroll_into_view_if_needed()
    left, top, w, h = frame(page, host)
    page.touchscreen.tap(left + 0.25 * w, top + 0.5 * h)
    settle(page)
    assert place(page)[0] == pytest.approx(X[0] - DX / 2 + 0.25 * NX * DX, abs=0.01)
    small = page.locator("nav a, button, input").evaluate_all(
        "(e) => e.filter((f) => f.offsetParent && f.getBoundingClientRect().height < 16).length"
    )
    assert small == 0


def test_contents_fold_on_a_phone_and_lead_to_every_part(show, study):
    page = show(study, 390, 844, has_touch=True, is_mobile=True)
    links = page.locator("#contents a")
    assert not links.first.is_visible()
    for k in range(links.count()):
        page.locator("#contents summary").tap()
        assert links.nth(k).is_visible()
        links.nth(k).tap()
        settle(page)
        assert not links.first.is_visible()  # folded again, out of the way of what was asked for
        target = page.locator(links.nth(k).get_attribute("href"))
        below = page.locator(".bar").evaluate("(e) => e.getBoundingClientRect().bottom")
        at_end = page.evaluate("() => scrollY + innerHeight >= document.body.scrollHeight - 2")
        top = target.evaluate("(e) => e.getBoundingClientRect().top")
        assert below - 1 <= top < 844
        assert top < below + 40 or at_end


def test_contents_stay_in_sight_and_mark_where_the_reader_is(page):
    links = page.locator("#contents a")
    current = page.locator("#contents a[aria-current]")
    assert not page.locator("#contents summary").is_visible()
    for name in ("Profiles", "Layer", "Python", "Stress"):
        links.get_by_text(name, exact=True).click()
        settle(page)
        assert current.all_inner_texts() == [name]
        box = current.bounding_box()
        assert 0 <= box["y"] < 100


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read(show, study, scheme):
    """Contrast of at least 4.5, as the accessibility guidelines (WCAG 2.1, 1.4.3) ask for."""
    page = show(study, color_scheme=scheme)

    def luminance(colour):
        channels = np.array([int(v) for v in re.findall(r"\d+", colour)[:3]]) / 255
        linear = np.where(
            channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
        )
        return float(linear @ [0.2126, 0.7152, 0.0722])

    back = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
    assert (luminance(back) < 0.1) == (scheme == "dark")
    for place in ("body", ".quiet", "figure output", "dt", "nav a", ".legend span"):
        style = page.locator(place).first.evaluate("(e) => getComputedStyle(e).color")
        light = sorted([luminance(style), luminance(back)])
        assert (light[1] + 0.05) / (light[0] + 0.05) >= 4.5, place


def test_nothing_in_the_file_points_outside(study):
    text = study.read_text()
    markup = re.sub(r"(<script[^>]*>).*?(?=</script>)", r"\1", text, flags=re.S)
    targets = re.findall(r"<[^>]*?\b(?:src|href|srcset|action)\s*=\s*[\"']?([^\"'\s>]+)", markup)
    assert len(targets) > 5
    assert [t for t in targets if not t.startswith(("#", "data:,"))] == []
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)[1]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert set(re.findall(r"https?://[^\s\"'<]+", text)) <= {"http://www.w3.org/2000/svg"}


def test_report_from_a_thickness_map_alone(show, tmp_path):
    """Algebraic, with gaps and a strip-like field: no B-scans, no convergence."""
    y, x = np.linspace(0, 0.5, 12), np.linspace(0, 5, 80)
    values = thickness(*np.meshgrid(y, x, indexing="ij"), 1.0)
    values[3:5, 20:30] = np.nan
    attrs = {"units": "mm"}
    seen = xr.DataArray(values, {"y": y, "x": x}, ("y", "x"), "loaded_thickness", attrs)
    result = algebraic_result(seen, 0.5, MooneyRivlin(2.23, 0.703))
    for measured in (None, clean_thickness(seen)):
        page = show(write(tmp_path / "map.html", result, loaded=measured))
        assert page.locator(".scans, #slice").count() == 0
        names = page.locator("figure[data-map]").evaluate_all("(f) => f.map((g) => g.dataset.map)")
        assert names == ["algebraic", "loaded-thickness"]
        for fill, value in (("#cursor-x", x[25]), ("#cursor-y", y[4])):
            page.locator(fill).fill(str(value))
            page.keyboard.press("Enter")
        settle(page)
        assert readout(page, "algebraic").startswith("no value")
        assert page.locator("#hatch").is_visible() == (measured is not None)
        assert "(interpolated)" in readout(page, "loaded-thickness") or measured is None
        assert "0.5\u00a0mm" in page.locator(".figures").inner_text()
        assert page.locator("#warnings").inner_text().split() == ["Warnings", "None."]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # means of nothing in the summary
def test_maps_without_any_value(show, tmp_path):
    result = stress_result()
    for name in ("axial_stress", "algebraic_axial_stress", "loaded_thickness"):
        result.maps[name] = result.maps[name] * np.nan
    page = show(write(tmp_path / "empty.html", result))
    assert readout(page, "computational") == "no value"


def test_volume_without_boundaries(show, volumes, tmp_path):
    page = show(write(tmp_path / "raw.html", stress_result(), {"loaded": volumes["loaded"]}))
    page.locator("#slice").fill("7")
    page.wait_for_selector(".scans canvas[data-row='7']")
    assert not page.locator("#lines").is_visible()
    assert place(page)[1] == pytest.approx(Y[7], abs=1e-3)


def test_large_volume_is_thinned(tmp_path):
    """Pictures are means of blocks of pixels of every n-th B-scan; boundaries belong to them."""
    ny, nx, nz = 230, 1100, 70
    random = np.random.default_rng(1)
    coarse = 30 * random.random((nz, ny, nx // 20)).astype(np.float32)
    content = np.repeat(coarse, 20, axis=2) + random.rayleigh(1.0, (nz, ny, nx)).astype(np.float32)
    grid = ("y", "x")
    depth = Z0 + 0.3 + 1e-4 * np.add.outer(np.arange(ny), np.arange(nx))
    found = xr.Dataset(
        {
            "window_depth": (grid, depth),
            "sample_depth": (grid, depth + 0.1),
            "thickness": (grid, 0 * depth + 0.1),
            "filled": (grid, depth > Z0 + 0.31),
            "window_filled": (grid, depth < 0),
            "sample_filled": (grid, depth > Z0 + 0.31),
        },
        {"y": Y0 + DY * np.arange(ny), "x": X0 + DX * np.arange(nx)},
    )
    with stored(tmp_path, "wide", content) as volume:
        entry, projection = draw_volume(volume, found, "loaded")
    assert entry["rows"] == list(range(0, ny, 5))
    assert entry["y"] == pytest.approx(Y0 + DY * np.arange(0, ny, 5))
    assert entry["extent"] == pytest.approx([X0 - DX / 2, 1098 * DX, Z0 - DZ / 2, nz * DZ])
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(entry["pictures"][20]))), float)
    assert picture.shape == (nz, 366)
    power = (content[:, 100, :1098].astype(float) ** 2).reshape(nz, 366, 3).mean(2)
    level = 10 * np.log10(power)
    assert np.corrcoef(picture.ravel(), level.ravel())[0, 1] > 0.9
    lines = decoded(entry["lines"]["window"]).reshape(46, 367)
    assert lines[20] == pytest.approx(depth[100, ::3], abs=1e-4)
    made_up = decoded(entry["lines"]["sample_filled"]).reshape(46, 367)
    assert (made_up[20] == (depth[100, ::3] > Z0 + 0.31)).all()
    assert made_up.any()
    assert not decoded(entry["lines"]["window_filled"]).any()
    below = (Z0 + DZ * np.arange(nz))[:, None, None] >= depth + 0.1
    brightest = 20 * np.log10(np.where(below, content, 0).max(0))
    offset = projection.values - brightest
    assert np.ptp(offset) < 1e-3


def decoded(entry):
    content = np.frombuffer(zlib.decompress(base64.b64decode(entry["data"])), np.uint8)
    return (
        content
        if entry["type"] == "u1"
        else np.ascontiguousarray(content.reshape(4, -1).T).view("<f4").ravel()
    )


@given(
    arrays(np.float64, (3, 4), elements=st.floats(-(2.0**100), 2.0**100, width=32)),
    st.integers(2, 5),
)
def test_numbers_keep_their_digits(values, digits):
    values[0, 0], values[0, 1], values[0, 2] = np.nan, np.inf, -np.inf
    back = decoded(encode_floats(values, digits)).reshape(3, 4)
    assert np.all(np.isnan(back[0, :3]))
    rest, given = back.ravel()[3:], values.ravel()[3:]
    tiny = 2e-38
    assert np.all(np.abs(rest - given) <= 10.0**-digits * np.abs(given) + tiny)


def test_uneven_and_large_maps_become_even():
    x = np.array([0.0, 0.1, 0.2, 0.35, 0.4, 0.5])
    field = xr.DataArray(np.tile(x, (2, 1)), {"y": [2.0, 1.0], "x": x}, ("y", "x"))
    entry = encode_map(field)
    assert (entry["x"], entry["y"]) == ([0.0, pytest.approx(0.1)], [1.0, 1.0])
    assert decoded(entry).reshape(2, 6)[0] == pytest.approx([0, 0.1, 0.2, 0.35, 0.4, 0.5], abs=1e-4)
    large = xr.DataArray(
        np.add.outer(np.zeros(3), np.arange(3000.0)),
        {"y": [0.0, 1.0, 2.0], "x": 0.01 * np.arange(3000)},
        ("y", "x"),
    )
    entry = encode_map(large)
    assert entry["shape"] == [3, 1000]
    assert decoded(entry)[:1000] == pytest.approx(np.arange(0, 3000, 3), rel=1e-4)


def test_fractions_are_shown_in_percent():
    result = stress_result()
    share = 0.2 * result.maps["loaded_thickness"].astype(float)
    result.maps["edge_influence"] = share.assign_attrs(units="1")
    data = map_entries(result, None, None, {}, {}, [])
    entry = data["maps"]["edge_influence"]
    assert data["scales"][entry["scale"]]["units"] == "%"
    assert_allclose(decoded(entry), 100 * share.values.ravel(), rtol=2e-3)


def test_limits_of_constant_and_empty_maps():
    flat = xr.DataArray(np.full((2, 2), 0.5))
    low, high = common_limits({"": flat}, "")
    assert low < 0.5 < high
    assert common_limits({"": flat * np.nan}, "") == (0.0, 1.0)


def test_a_map_of_many_points_does_not_decide_the_limits_of_one_of_few():
    few = xr.DataArray(np.linspace(-10.0, 0.0, 101))
    many = xr.DataArray(np.linspace(-3.0, 0.0, 100_001))
    low, high = common_limits({"few": few, "many": many}, "")
    assert low == pytest.approx(-9.9)
    assert high == pytest.approx(-0.03)


def test_what_does_not_fit_is_refused_and_leaves_no_file(volumes, tmp_path):
    path = tmp_path / "bad.html"
    cut = LAYERS["loaded"].isel(y=slice(0, 5))
    with pytest.raises(InputError, match=r"loaded volume: 24 x 36 .* 5 x 36"):
        write(path, stress_result(), volumes, loaded=cut)
    with pytest.raises(InputError, match="'pressed' is neither"):
        write(path, stress_result(), {"pressed": volumes["loaded"]})
    with pytest.raises(OutputError, match=r"ends in \.html"):
        write(tmp_path / "report.pdf", stress_result())
    with pytest.raises(OutputError, match="no folder"):
        write(tmp_path / "absent" / "report.html", stress_result())
    assert list(tmp_path.iterdir()) == []


class Noise:
    """A volume of nothing but speckle, which is what compresses worst."""

    shape = (1000, 500, 500)

    def __init__(self, like):
        self.metadata = like.metadata
        self._image = np.random.default_rng(0).rayleigh(1.0, (1100, 600)).astype(np.float32)

    def bscan(self, y):
        dz, dx = np.random.default_rng(y).integers(0, 100, 2)
        return self._image[dz : dz + 1000, dx : dx + 500].copy()


@pytest.mark.slow
def test_a_whole_study_stays_small(volumes, tmp_path):
    """500 x 500 x 1000 pixels, twice, and a result as fine, all noise: at most 5 MB."""
    random = np.random.default_rng(2)
    axis = np.linspace(0, 5, 500)
    grid = ("y", "x")

    def noise(mean, spread):
        return grid, mean + spread * random.standard_normal((500, 500))

    layers = {}
    for state, mean in (("loaded", 0.4), ("unloaded", 0.5)):
        layers[state] = xr.Dataset(
            {
                "window_depth": noise(0.5, 0.001),
                "sample_depth": noise(0.5 + mean, 0.001),
                "thickness": noise(mean, 0.001),
                "quality": noise(0.8, 0.05),
                "filled": (grid, random.random((500, 500)) < 0.05),
            },
            {"y": axis, "x": axis},
        )
    maps = xr.Dataset(
        {
            "axial_stress": noise(-5, 1),
            "algebraic_axial_stress": noise(-4, 1),
            "contact_pressure": noise(5, 1),
            "contact_state": (grid, random.integers(0, 3, (500, 500))),
            "window_contact_state": (grid, random.integers(0, 3, (500, 500))),
            "loaded_thickness": layers["loaded"]["thickness"],
        },
        {"y": axis, "x": axis},
    )
    both = {state: Noise(volume) for state, volume in volumes.items()}
    path = write(tmp_path / "large.html", StressResult(maps), both, **layers)
    assert 2 * BYTES / 2 < path.stat().st_size < 5e6


# ---- the large map


def stage_text(page):
    return page.locator("#stage figcaption output").inner_text()


def drag(page, tool, start, end):
    """Drag over the large map between shares of its frame, counted from the lower left."""
    page.locator(f"input[value='{tool}']").check()
    host = page.locator("#stage-plot")
    host.scroll_into_view_if_needed()
    left, top, width, height = frame(page, host)
    page.mouse.move(left + start[0] * width, top + (1 - start[1]) * height)
    page.mouse.down()
    page.mouse.move(left + end[0] * width, top + (1 - end[1]) * height, steps=3)
    page.mouse.up()
    settle(page)


def on_field(share):
    """Position in mm of a share of the frame of all maps of the study."""
    return X[0] - DX / 2 + share[0] * NX * DX, Y[0] - DY / 2 + share[1] * NY * DY


def choose(page, key):
    page.locator("#stage-map").select_option(key)
    settle(page)


def test_the_large_map_tells_the_value_under_the_pointer(page):
    assert page.locator("#stage figure").get_attribute("data-stage") == "computational"
    host = page.locator("#stage-plot")
    host.scroll_into_view_if_needed()
    left, top, width, height = frame(page, host)
    for right, up in ((0.4, 0.3), (0.78, 0.7)):
        page.mouse.move(left + right * width, top + (1 - up) * height)
        settle(page)
        x, y = on_field((right, up))
        text = stage_text(page)
        assert number(text.split(": ")[1]) == pytest.approx(expected("computational", x, y), 2e-3)
        assert text.endswith("kPa")
    assert "1\u202f" not in page.locator("#stage-units").inner_text()
    assert page.locator("#stage svg .scale-bar").count() == 1


def test_every_map_can_be_enlarged(page):
    keys = page.locator("#stage-map option").evaluate_all("(o) => o.map((p) => p.value)")
    assert {"algebraic", "contact_pressure", "window_contact_state", "loaded-quality"} <= set(keys)
    page.locator("#cursor-x").fill("0.85")
    page.keyboard.press("Enter")
    page.locator("#cursor-y").fill("2.1")
    page.keyboard.press("Enter")
    page.mouse.move(1, 1)
    for key, value in (
        ("algebraic", expected("algebraic", 0.85, 2.1)),
        ("loaded-thickness", expected("loaded-thickness", 0.85, 2.1)),
        ("contact_pressure", -expected("computational", 0.85, 2.1)),
    ):
        choose(page, key)
        assert number(stage_text(page).split(": ")[1]) == pytest.approx(value, rel=3e-3)
    choose(page, "window_contact_state")
    assert stage_text(page).endswith(": stick")
    # no limits of another map are left, and what cannot be used looks so
    for key in ("low", "high", "colours", "auto"):
        box = page.locator(f"#stage-{key}")
        assert box.is_disabled()
        assert float(box.evaluate("(e) => getComputedStyle(e).opacity")) < 0.6
    for key in ("low", "high", "colours"):
        assert page.locator(f"#stage-{key}").input_value() == ""
    assert page.locator("#stage-units").inner_text() == ""
    choose(page, "contact_pressure")
    assert page.locator("#stage-low").is_enabled()
    assert page.locator("#stage-units").inner_text() == "kPa"
    assert float(page.locator("#stage-high").input_value()) > 0


def test_limits_and_colours_hold_for_all_maps_of_a_scale(page):
    low = page.locator("#stage-low").input_value()
    page.locator("#stage-low").fill("-20")
    page.keyboard.press("Enter")
    page.locator("#stage-high").fill("-2")
    page.keyboard.press("Enter")
    page.locator("#stage-colours").select_option("magma")
    settle(page)
    for name in ("algebraic", "computational"):
        ends = page.locator(f"[data-map='{name}'] .colours span").all_inner_texts()
        assert [number(ends[0]), number(ends[2])] == [-20, -2]
    assert page.locator("[data-map='loaded-thickness'] .colours span").first.inner_text() != ends[0]
    page.locator("#stage-low").fill("5")  # above the highest: refused
    page.keyboard.press("Enter")
    assert page.locator("#stage-low").input_value() == "-20"
    page.locator("#stage-auto").click()
    assert page.locator("#stage-low").input_value() == low
    assert page.locator("#stage-colours").input_value() == "viridis_r"


def test_a_rectangle_has_the_statistics_of_what_is_in_it(page):
    from optical_palpation.analysis import Region, region_statistics

    before = place(page)
    drag(page, "rectangle", (0.35, 0.3), (0.75, 0.6))
    assert place(page) == before  # the cursor stays where it is
    (x0, y0), (x1, y1) = on_field((0.35, 0.3)), on_field((0.75, 0.6))
    maps = stress_result().maps
    found = region_statistics(maps, [Region.rectangle("r", x0, x1, y0, y1)]).isel(region=0)
    cells = page.locator("#shapes tbody tr").first.locator("th, td").all_inner_texts()
    assert cells[0] == "1 rectangle"
    assert number(cells[1]) == pytest.approx(float(found["area"]), rel=0.02)
    assert number(cells[2].split(" ")[0]) == pytest.approx(float(found["mean"]), rel=0.01)
    assert number(cells[3]) == pytest.approx(float(found["standard_deviation"]), rel=0.01)
    assert number(cells[4]) == pytest.approx(float(found["minimum"]), rel=0.01)
    assert number(cells[5]) == pytest.approx(float(found["maximum"]), rel=0.01)
    assert number(cells[6]) == pytest.approx(float(found["force"]), rel=0.03)
    choose(page, "loaded-thickness")  # the same rectangle, of another map
    cells = page.locator("#shapes tbody tr").first.locator("th, td").all_inner_texts()
    thick = LAYERS["loaded"]["thickness"].sel(x=slice(x0, x1), y=slice(y0, y1))
    assert number(cells[2].split(" ")[0]) == pytest.approx(float(thick.mean()), rel=0.01)
    assert cells[6] == ""
    page.locator("#shapes tbody button").click()
    assert not page.locator("#shapes").is_visible()


def test_a_line_has_a_profile(page):
    drag(page, "line", (0.3, 0.4), (0.8, 0.7))
    (x0, y0), (x1, y1) = on_field((0.3, 0.4)), on_field((0.8, 0.7))
    cells = page.locator("#shapes tbody tr").first.locator("th, td").all_inner_texts()
    assert number(cells[1]) == pytest.approx(np.hypot(x1 - x0, y1 - y0), rel=0.01)
    drawn = points(page.locator("#course .plot"), "curve")
    assert len(drawn) > 5
    # the stress falls with x and y: so does the curve
    assert drawn[-1, 1] > drawn[0, 1]
    page.locator("#stage-clear").click()
    assert not page.locator("#course").is_visible()


def test_lines_and_rectangles_say_what_the_library_says(show, tmp_path):
    """Interpolated lines with the band of the error, means with their errors, a gap, the rim."""
    from optical_palpation.analysis import Region, line_profile, region_statistics
    from optical_palpation.present.terms import rounded

    maps = annotated().maps
    maps["axial_stress"][5, 6] = np.nan
    page = show(write(tmp_path / "lines.html", StressResult(maps)))
    extent = {
        axis: (float(maps[axis][0] - step / 2), float(maps[axis][-1] + step / 2))
        for axis in "xy"
        for step in [float(maps[axis].diff(axis).mean())]
    }

    def at(share):
        return tuple(
            low + s * (high - low) for s, (low, high) in zip(share, extent.values(), strict=True)
        )

    for start, end in [
        ((0.1, 0.3), (0.95, 0.75)),
        ((0.5, 0.0), (0.52, 1.0)),
        ((0.02, 0.9), (0.3, 0.6)),
    ]:
        drag(page, "line", start, end)
        settle(page)
        # what was drawn, to the pixel of the screen
        with page.expect_download() as waiting:
            page.locator("#save-shapes").click()
        waiting.value.save_as(tmp_path / "shapes.csv")
        names, *_, last = (r.split(",") for r in (tmp_path / "shapes.csv").read_text().splitlines())
        row = dict(zip(names, last, strict=True))
        ends = [[float(row[f"{axis}{k} (mm)"]) for axis in "xy"] for k in (0, 1)]
        assert ends == [pytest.approx(at(p), abs=0.02) for p in (start, end)]
        profile = line_profile(maps, *ends)
        values = profile["axial_stress"].values
        there = np.isfinite(values)
        mean = values[there].mean()
        error = profile["axial_stress_error"].values[there].mean()
        assert float(row["mean (kPa)"]) == pytest.approx(mean, rel=2e-3)
        assert float(row["standard deviation (kPa)"]) == pytest.approx(
            values[there].std(), rel=0.01
        )
        assert float(row["lowest (kPa)"]) == pytest.approx(values[there].min(), rel=2e-3)
        assert float(row["error of the mean (kPa)"]) == pytest.approx(error, rel=5e-3)
        host = page.locator("#course .plot")
        drawn = points(host, "curve")
        assert len(drawn) == there.sum()
        slope, first = np.polyfit(drawn[:, 1], values[there], 1)
        assert slope * drawn[:, 1] + first == pytest.approx(
            values[there], abs=0.01 * np.ptp(values[there])
        )
        band = points(host, "band")
        assert len(band) == 2 * there.sum()
        wide = abs(slope) * (band[:, 1].max() - band[:, 1].min())
        assert wide > np.ptp(values[there]) + error / 2
    page.locator("#stage-clear").click()
    for start, end in [((0.35, 0.3), (0.75, 0.62)), ((0.0, 0.0), (0.45, 0.5))]:  # to the rim
        drag(page, "rectangle", start, end)
        (x0, y0), (x1, y1) = at(start), at(end)
        found = region_statistics(maps, [Region.rectangle("r", x0, x1, y0, y1)]).isel(region=0)
        cells = page.locator("#shapes tbody tr").last.locator("th, td").all_inner_texts()
        headings = page.locator("#shapes thead th").all_inner_texts()
        assert headings[2:4] == ["Mean \u00b1 error", "s.d."]
        mean, error = cells[2].replace("\u00a0", " ").split(" \u00b1 ")
        assert number(mean) == pytest.approx(float(found["mean"]), rel=0.01)
        assert number(error) == pytest.approx(float(found["mean_error"]), rel=0.02)
        force, error = cells[6].replace("\u00a0", " ").split(" \u00b1 ")
        assert number(force) == pytest.approx(float(found["force"]), rel=0.03)
        assert number(error) == pytest.approx(float(found["force_error"]), rel=0.05)
        decimals = len(mean.partition(".")[2])
        assert all(len(cell.partition(".")[2]) == decimals for cell in cells[3:6])
    for value, error in (
        (412.3456, 11.7),
        (-7.1234, 0.0456),
        (0.5, 0.0999),
        (1234.5, 151.2),
        (-0.0004, 0.011),
    ):
        said = page.evaluate(f"() => {{ {DIGITS}; return rounded({value}, {error}).join('') }}")
        assert said.replace("\u00a0", " ") == rounded(value, error)


# The page's own function: its script is a module, whose names cannot be reached from outside.
DATA = (files("optical_palpation") / "present/report/templates/data.js").read_text()
DIGITS = "".join(re.findall(r"^const clamp[^;]*;|^function rounded.*?^}", DATA, flags=re.S | re.M))


def test_zoom_shows_a_part_and_the_whole_again(page):
    host = page.locator("#stage-plot")
    drag(page, "zoom", (0.25, 0.25), (0.75, 0.75))
    left, top, width, height = frame(page, host)
    page.mouse.move(left + 0.5 * width, top + 0.1 * height)
    settle(page)
    x, y = on_field((0.5, 0.7))
    shown = stage_text(page)
    assert float(re.search(r"y (\S+?)\u202f", shown)[1]) == pytest.approx(y, abs=0.01)
    assert number(shown.split(": ")[1]) == pytest.approx(expected("computational", x, y), rel=5e-3)
    page.locator("#stage-whole").click()
    page.mouse.move(left + 0.5 * width, top + 0.1 * height)
    settle(page)
    y = on_field((0.5, 0.9))[1]
    assert float(re.search(r"y (\S+?)\u202f", stage_text(page))[1]) == pytest.approx(y, abs=0.01)


@pytest.mark.parametrize("size", [(1.0, 8.0), (8.0, 1.0)])
def test_a_strip_is_true_to_scale_whole_and_in_part(show, tmp_path, size):
    shape = [round(10 * length) for length in reversed(size)]
    pressed = thickness_map(0.4 - 0.01 * np.random.default_rng(1).random(shape), field_of_view=size)
    result = algebraic_result(pressed, 0.5, MooneyRivlin(2.0, 0.5))
    page = show(write(tmp_path / "strip.html", result))
    host = page.locator("#stage-plot")

    def at(right, down):
        page.mouse.move(right, down)
        settle(page)
        return [float(v) for v in re.findall(r"[xy] (\S+?)\u202f", stage_text(page))]

    def lengths():
        """mm along x and y, of the same number of pixels of the screen."""
        host.scroll_into_view_if_needed()
        left, top, width, height = frame(page, host)
        middle = left + width / 2, top + height / 2
        here, there = at(*middle), at(middle[0] + 60, middle[1] - 60)
        return np.subtract(there, here)

    along_x, along_y = lengths()
    assert along_y == pytest.approx(along_x, rel=0.05)
    drag(page, "zoom", (0.45, 0.4), (0.55, 0.8))
    part = lengths()
    assert part[1] == pytest.approx(part[0], rel=0.05)
    assert part[0] < 0.7 * along_x


@pytest.fixture
def got(page, tmp_path):
    """Click on a button of the page, and return the path of what it downloads."""

    def got(button):
        with page.expect_download() as waiting:
            page.locator(button).click()
        path = tmp_path / waiting.value.suggested_filename
        waiting.value.save_as(path)
        return path

    return got


def test_downloads(page, got):
    rows = got("#save-map").read_text().splitlines()
    assert rows[0] == "x (mm),y (mm),Computational stress (kPa)"
    table = [row.split(",") for row in rows[1:]]
    maps = stress_result().maps["axial_stress"]
    assert len(table) == maps.size
    for x, y, value in table[:: len(table) // 7]:
        truth = float(maps.sel(x=float(x), y=float(y), method="nearest"))
        assert (np.isnan(truth) and value == "") or float(value) == pytest.approx(truth, rel=1e-3)
    drag(page, "rectangle", (0.35, 0.3), (0.75, 0.6))
    drag(page, "line", (0.35, 0.3), (0.75, 0.6))
    rows = got("#save-shapes").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["shape", "rectangle", "line"]
    assert "mean (kPa)" in rows[0]
    assert len({row.count(",") for row in rows}) == 1
    drawn = got("#save-svg").read_text()
    assert "Computational stress (kPa)" in drawn
    assert 'clip-path="url(#stage-frame)"' in drawn  # lines end at the frame
    assert "data:image/png" in drawn
    picture = np.asarray(Image.open(got("#save-png")).convert("RGB"), float)
    assert picture.shape[1] > 800
    assert picture.std() > 20


def test_pictures_end_where_the_map_ends(page, got):
    """Volumes and maps share a frame, of which a map may fill a part; its picture has no rim."""

    choose(page, "algebraic")
    page.mouse.move(1, 1)
    before = grey(page.locator("#stage-plot"))
    drawn = got("#save-svg").read_text()

    def box(mark):
        tag = re.search(rf"<(?:rect|image)[^>]*{mark}[^>]*>", drawn)[0]
        return [
            float(re.search(rf' {name}="([\d.]+)"', tag)[1])
            for name in ("x", "y", "width", "height")
        ]

    left, top, width, height = box('class="frame"')
    maps = stress_result().maps
    size = [float(maps[a][-1] - maps[a][0] + maps[a][1] - maps[a][0]) for a in "xy"]
    assert width / height == pytest.approx(size[0] / size[1], rel=0.01)
    for mark in ("scale-bar", "plate"):
        x, y, w, h = box(mark)
        assert left <= x < x + w <= left + width
        assert top <= y < y + h <= top + height
    picture = np.asarray(Image.open(got("#save-png")).convert("RGB"), float)
    inner = picture[
        2 * int(top + 30) + 6 : 2 * int(top + 30 + height) - 6,
        2 * int(left) + 6 : 2 * int(left + width) - 6,
    ]
    # No white at the rim, but for the plate of the scale bar.
    assert inner[:, :3].min(2).max() < 240
    assert inner[:3].min(2).max() < 240
    assert inner[:, -3:][: int(0.8 * len(inner))].min(2).max() < 240
    # The page is as before.
    assert np.array_equal(grey(page.locator("#stage-plot")), before)
    drag(page, "zoom", (0.3, 0.3), (0.6, 0.6))
    drawn = got("#save-svg").read_text()
    assert box('class="frame"')[2] / box('class="frame"')[3] > 0.5


def annotated():
    """A result with the maps that other parts of the software add: errors, influences."""
    result = stress_result()
    maps = result.maps
    maps["axial_stress_error"] = abs(maps["axial_stress"]) * 0.1
    maps["axial_stress_error"].attrs = {"units": "kPa", "long_name": "error of the axial stress"}
    maps["strain_energy"] = maps["axial_stress"] * 0 + 0.25 + 0.1 * maps["x"]
    maps["strain_energy"].attrs = {"units": "kPa", "long_name": "energy of the <b>strain</b>"}
    return result


def test_the_algebraic_method_is_shown_on_the_pixels(show, tmp_path):
    y, x = np.linspace(1.2, 3.0, 37), np.linspace(-0.4, 1.1, 61)
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    pixels = xr.Dataset(
        {
            "algebraic_axial_stress": (("y", "x"), -3 - np.sin(9 * grid_x) - 0.5 * grid_y**2),
            "loaded_thickness": (("y", "x"), thickness(grid_y, grid_x, 1.0)),
        },
        {"y": y, "x": x},
    )
    maps = annotated().maps
    maps["algebraic_axial_stress_error"] = 0.1 + 0 * maps["axial_stress"].fillna(0)
    page = show(write(tmp_path / "pixels.html", StressResult(maps, pixels=pixels)))
    data = json.loads(page.locator("#data").text_content())
    assert data["maps"]["algebraic"]["shape"] == [37, 61]
    assert data["maps"]["loaded-thickness"]["shape"] == [37, 61]
    assert data["maps"]["computational"]["shape"] == [11, 13]
    along_x = page.locator("[data-profile='stress'] .plot").first
    assert len(points(along_x, "curve.algebraic")) == 61
    assert len(points(along_x, "curve.computational")) == 13
    band = along_x.locator("path.band.algebraic").get_attribute("d")
    assert len(re.findall("[ML]", band)) == 2 * 61
    figures = page.locator(".figures").inner_text()
    mean = float(pixels["algebraic_axial_stress"].mean())
    assert f"{mean:.1f}".replace("-", "\u2212") in figures


def test_further_maps_error_bands_differences_and_regions(show, tmp_path):
    from optical_palpation.analysis import Region

    result = annotated()
    stress = result.maps["axial_stress"]
    changed = stress - 0.5 - 0.1 * (stress.x == stress.x[0])
    other = StressResult(result.maps.assign(axial_stress=changed))
    name = "second </script><script>window.broken = 1</script>"
    page = show(
        write(
            tmp_path / "more.html",
            result,
            others={name: other},
            regions=[Region.rectangle("<i>bump</i>", 0.0, 0.8, 1.5, 2.5)],
            result_file="stress.nc",
        )
    )
    titles = page.locator("#stage-map option").all_inner_texts()
    assert "Energy of the <b>strain</b>" in titles
    assert f"{name} less this" in titles
    choose(page, "difference-0")
    page.mouse.move(1, 1)
    assert number(stage_text(page).split(": ")[1]) == pytest.approx(-0.5, rel=1e-3)
    choose(page, "axial_stress_error")
    assert stage_text(page).endswith("kPa")
    bands = page.locator("[data-profile='stress'] svg path.band")
    assert bands.count() == 2
    page.locator("#bands").uncheck()
    settle(page)
    assert bands.count() == 0
    row = page.locator(".regions tbody tr").first.locator("th, td").all_inner_texts()
    assert row[0] == "<i>bump</i>"
    found = result.maps["axial_stress"].sel(x=slice(0, 0.8), y=slice(1.5, 2.5))
    mean, error = row[1].split(" \u00b1 ")
    assert number(mean) == pytest.approx(float(found.mean()), rel=0.1)
    assert number(error) > 0
    headings = page.locator(".regions thead th").all_inner_texts()
    assert headings[1] == "Mean \u00b1 error"
    assert len(headings) == len(row)
    assert page.locator("[data-map='difference-0']").count() == 1
    assert page.locator("a[download]").get_attribute("href") == "stress.nc"
    assert "\u00b1" in page.locator(".figures").inner_text()
    assert page.evaluate("() => window.broken") is None


def test_a_comparison_shows_the_other_map_the_error_and_a_table(show, tmp_path):
    result = annotated()
    stress, error = result.maps["axial_stress"], result.maps["axial_stress_error"]
    offset = xr.where(stress.x > 0.3, 3.0, 0.1)
    changed = result.maps.assign(axial_stress=stress + offset).assign_attrs(
        sample_force_mN=40.0, force_error_mN=2.0
    )
    changed["axial_stress_error"] = error.fillna(0.0) * 0 + 0.3
    page = show(write(tmp_path / "two.html", result, others={"second": StressResult(changed)}))
    page.locator("#cursor-x").fill("0.85")
    page.keyboard.press("Enter")
    page.locator("#cursor-y").fill("2.1")
    page.keyboard.press("Enter")
    page.mouse.move(1, 1)
    here = stress.sel(x=0.85, y=2.1, method="nearest")
    known = np.hypot(0.1 * abs(here), 0.3)
    for key, value in (
        ("other-0", here + 3.0),
        ("difference-0", 3.0),
        ("difference-0-error", known),
    ):
        choose(page, key)
        assert number(stage_text(page).split(": ")[1]) == pytest.approx(float(value), rel=3e-3)
    assert page.locator("[data-map='other-0']").count() == 1
    # one scale for both maps of stress
    ends = [
        page.locator(f"[data-map='{name}'] .colours span").all_inner_texts()
        for name in ("computational", "other-0")
    ]
    assert ends[0] == ends[1]
    rows = page.locator("#comparison + .scroll tbody tr")
    this, other = (rows.nth(k).locator("th, td").all_inner_texts() for k in (0, 1))
    assert this[0] == "this"
    assert this[-1] == "31.2"
    there = np.isfinite(stress.values)
    d = np.broadcast_to(offset.values, stress.shape)[there]
    rms = np.sqrt(np.mean(d**2))
    both = np.hypot(0.1 * stress.values[there], 0.3)
    cells = [number(text.replace("\u00a0", "\u202f")) for text in other[1:6]]
    assert cells[0] == pytest.approx(d.mean(), rel=5e-3)
    assert cells[1] == pytest.approx(rms, rel=5e-3)
    assert cells[2] == pytest.approx(100 * rms / np.sqrt(np.mean(stress.values[there] ** 2)), 2e-2)
    assert cells[3] == pytest.approx(np.sqrt(np.mean(both**2)), rel=5e-2)
    assert cells[4] == pytest.approx(100 * np.mean(d <= both), rel=2e-2)
    assert other[0] == "second"
    assert other[6].replace("\u00a0", " ") == "40.0 \u00b1 2.0"


def test_a_mask_is_outlined_along_the_edges_of_its_pixels(show, tmp_path):
    from skimage.measure import points_in_poly

    from optical_palpation.analysis import Region

    y, x = 1.3 + 0.05 * np.arange(30), -0.2 + 0.04 * np.arange(25)
    inside = np.random.default_rng(3).random((30, 25)) > 0.5  # holes, islands, touching corners
    inside[0], inside[:, -1] = True, True
    mask = xr.DataArray(inside, {"y": y, "x": x}, ("y", "x"))
    regions = [Region.of_mask("<b>mask</b>", mask), Region.rectangle("box", 0.0, 0.5, 1.5, 2.0)]
    page = show(write(tmp_path / "mask.html", stress_result(), regions=regions))
    data = json.loads(page.locator("#data").text_content())
    outlines = [np.array(o) for o in data["regions"][0]["outlines"]]
    centres = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    count = sum(points_in_poly(centres, outline).astype(int) for outline in outlines)
    assert np.array_equal(count % 2 == 1, inside.ravel())
    # Every corner is one of a pixel, every side runs along x or along y.
    corners = np.concatenate(outlines)
    for values, at, step in ((corners[:, 0], x, 0.04), (corners[:, 1], y, 0.05)):
        places = (values - at[0]) / step + 0.5
        assert places == pytest.approx(np.round(places), abs=1e-3)
    for outline in outlines:
        sides = np.abs(np.diff(outline, axis=0, append=outline[:1])) > 1e-9
        assert (sides.sum(1) == 1).all()
    area = sum(
        np.sum(o[:, 0] * np.roll(o[:, 1], -1) - o[:, 1] * np.roll(o[:, 0], -1)) / 2
        for o in outlines
    )
    assert area == pytest.approx(inside.sum() * 0.04 * 0.05, rel=1e-4)
    assert page.locator("#stage-plot path.shape").count() == len(outlines) + 1
    labels = page.locator("#stage-plot .label").all_text_contents()
    assert [label for label in labels if label and "mm" not in label] == ["<b>mask</b>", "box"]


def test_a_link_goes_nowhere_but_beside(tmp_path):
    for name in ("../stress.nc", "/etc/passwd", "a/b.nc"):
        with pytest.raises(InputError, match="beside the report"):
            write(tmp_path / "r.html", stress_result(), result_file=name)
    write(tmp_path / "r.html", stress_result(), result_file="javascript:alert(1)")
    assert 'href="javascript%3Aalert' in (tmp_path / "r.html").read_text()


def test_numbers_have_the_digits_that_their_error_leaves():
    from optical_palpation.present.terms import rounded

    assert rounded(412.3456, 11.7) == "412 \u00b1 12"
    assert rounded(-7.1234, 0.0456) == "\u22127.123 \u00b1 0.046"
    assert rounded(0.5, 0.0999) == "0.50 \u00b1 0.10"
    assert rounded(1234.5, 151.2) == "1230 \u00b1 150"
    assert rounded(-0.0004, 0.011) == "0.000 \u00b1 0.011"
    assert rounded(238.17) == "238"
    assert rounded(2381.7) == "2380"
    assert rounded(0.01234, digits=2) == "0.012"
    assert rounded(238.17, float("nan")) == "238"


def test_parameters_have_units():
    from optical_palpation.present.report.content import parameter_sections

    given = {
        "material": {"c10": 2.23, "bulk_to_shear": 1e4},
        "grid": {"element_size": (0.1, 0.1, 0.05), "edges": "free"},
        "friction": {"window": 0.15},
        "loaded": {"spacing": {"z": 0.003}, "window": "line", "refractive_index": None},
        "window_force_mN": 31.5,
        "errors": {"modulus": 0.05, "sample_thickness": 0.05, "initial_thickness": 0.002},
    }
    rows = {name: value for _, section in parameter_sections(given) for name, value in section}
    assert rows["c10"] == "2.23 kPa"
    assert rows["element_size"] == "0.1, 0.1, 0.05 mm"
    assert rows["edges"] == "free"
    assert rows["spacing.z"] == "0.003 mm"
    assert rows["window_force"] == "31.5 mN"
    assert rows["modulus"] == rows["sample_thickness"] == "0.05 (fraction)"
    assert rows["initial_thickness"] == "0.002 mm"
    assert rows["refractive_index"] == "not given"


def test_a_printed_report_has_few_pages(page, tmp_path):
    page.pdf(path=tmp_path / "r.pdf", format="A4")
    content = (tmp_path / "r.pdf").read_bytes()
    assert 1 <= len(re.findall(rb"/Type\s*/Page[^s]", content)) <= 6


def test_print_lays_plots_out_for_paper_and_puts_maps_in_their_frames(show, study):
    page = show(study, width=703)  # A4 less its margins
    page.emulate_media(media="print")
    page.evaluate(
        """() => {
            window.painted = 0;
            const before = CanvasRenderingContext2D.prototype.drawImage;
            CanvasRenderingContext2D.prototype.drawImage = function (...given) {
                window.painted += 1;
                return before.apply(this, given);
            };
            dispatchEvent(new Event("beforeprint"));
        }"""
    )
    settle(page)
    plots = page.locator(".plot").evaluate_all(
        """(plots) => plots.filter((p) => p.querySelector("canvas")).map((p) => {
            const place = (e) => {
                const b = e.getBoundingClientRect();
                return [b.x, b.y, b.width, b.height];
            };
            const scale = p.querySelector("svg").getScreenCTM().a;
            return [place(p.querySelector("rect.frame")), place(p.querySelector("canvas")), scale];
        })"""
    )
    assert len(plots) > 10
    for frame, canvas, scale in plots:
        assert canvas == pytest.approx(frame, abs=1.5)
        assert 12 * 0.75 * scale >= 6.5  # points
    # Chromium shifts and shrinks in the print what is painted in answer to "beforeprint".
    assert page.evaluate("() => window.painted") == 0
    page.evaluate("() => dispatchEvent(new Event('afterprint'))")
    page.emulate_media(media="screen")
    settle(page)
    assert page.evaluate("() => window.painted") > 0
    host = page.locator("#stage-plot")
    assert host.locator("svg").evaluate(
        "(s) => s.viewBox.baseVal.width === s.parentNode.clientWidth"
    )


def test_a_report_without_parameters_tells_those_of_the_result(show, tmp_path):
    result = stress_result()
    result.maps.attrs |= {"law": "mooney-rivlin", "c10_kPa": 2.23, "edges": "free"}
    page = show(write(tmp_path / "alone.html", result))
    told = page.locator("#parameters .tables").inner_text()
    for text in ("c10\t2.23 kPa", "edges\tfree", "initial_thickness\t0.5 mm"):
        assert text in told


def test_key_figures_have_the_errors_that_are_known_and_no_empty_counts(show, tmp_path):
    result = stress_result()
    result.maps.attrs |= {
        "input_errors": json.dumps({"thickness": 0.002, "initial_thickness": 0.004}),
        "force_error_mN": 4.4,
        "force_error_contributions_mN": json.dumps({"thickness": 4.0, "initial_thickness": 1.8}),
    }
    seen = {name: found.assign(filled=found["filled"] & False) for name, found in LAYERS.items()}
    page = show(write(tmp_path / "figures.html", result, **seen))
    figures = page.locator(".figures div").all_inner_texts()
    told = dict(text.replace("\u00a0", " ").split("\n") for text in figures)
    assert told["Force on the sample"] == "31.2 \u00b1 4.4 mN"
    assert told["Loaded thickness, median"].endswith(" \u00b1 0.0020 mm")
    assert told["Unloaded thickness, median"].endswith(" \u00b1 0.0040 mm")
    assert not any("nterpolated" in name for name in told)
    assert page.locator("#hatch-label").is_hidden()
    del result.maps.attrs["force_error_mN"]
    result.maps.attrs["force_mesh_error_mN"] = 1.2
    page = show(write(tmp_path / "mesh.html", result))
    said = page.locator(".figures div").first.inner_text().replace("\u00a0", " ").split("\n")
    assert said == ["Force on the sample, ± by the mesh alone", "31.2 ± 1.2 mN"]


def test_warnings_are_sentences_and_break_no_option(show, tmp_path):
    text = "sides are free: <i>give</i> --layer-extent"
    page = show(write(tmp_path / "warned.html", stress_result(), warnings=[text]))
    item = page.locator("#warnings li").first
    assert item.inner_text() == text[0].upper() + text[1:]
    assert item.locator(".whole").inner_text() == "--layer-extent"
    assert item.locator("i").count() == 0


LONG = "the sides of the layer are free: " + "that changes what is near them, and " * 9 + "is all."


@pytest.mark.parametrize("size", [(1300, 900), (390, 844)])
def test_warnings_take_a_line_each_and_the_whole_map_is_on_the_first_screen(show, tmp_path, size):
    touch = {"has_touch": True, "is_mobile": True} if size[0] < 500 else {}
    path = write(tmp_path / "warned.html", stress_result(), warnings=[LONG, LONG + "!", "Short."])
    page = show(path, *size, **touch)
    items = page.locator("#warnings li")
    heights = items.evaluate_all("(l) => l.map((e) => e.offsetHeight)")
    assert max(heights) < 30
    box = page.locator("#stage").bounding_box()
    assert box["y"] + box["height"] <= size[1]
    *_, height = frame(page, page.locator("#stage-plot"))
    assert height > 0.3 * size[1]
    items.first.locator("summary").click()
    assert items.first.evaluate("(e) => e.offsetHeight") > 2 * heights[0]
    assert page.locator("#stage").bounding_box()["width"] == pytest.approx(box["width"], abs=1)
    if size[0] > 1000:  # nothing stays folded on paper
        items.first.locator("summary").click()
        page.emulate_media(media="print")
        inside = items.first.locator("summary").evaluate("(e) => e.scrollWidth <= e.clientWidth")
        assert inside
        assert items.first.evaluate("(e) => e.offsetHeight") > heights[0]


def test_a_deep_volume_keeps_its_resolution_at_the_layer(tmp_path):
    nz = 1200
    content = np.random.default_rng(0).rayleigh(1.0, (nz, 4, 30)).astype(np.float32)
    found = layer(0.0).isel(y=slice(4), x=slice(30))
    with stored(tmp_path, "deep", content) as volume:
        entry, _ = draw_volume(volume, found, "loaded")
    picture = Image.open(io.BytesIO(base64.b64decode(entry["pictures"][0])))
    left, _, top, depth = entry["extent"]
    assert depth / picture.size[1] == pytest.approx(DZ)
    assert top < float(found["window_depth"].min()) - 0.1
    assert top + depth > float(found["sample_depth"].max()) + 0.1
    assert picture.size[1] < nz / 4
    assert left == pytest.approx(X0 - DX / 2)


def test_percentages_keep_what_is_left_and_say_next_to_nothing():
    from optical_palpation.present import percent

    assert percent(0.0273) == "2.7 %"
    assert percent(0.183) == "18 %"
    assert percent(0.99815) == "99.8 %"
    assert percent(1.0) == "100 %"
    assert percent(0) == "0 %"
    assert percent(3e-9) == "below 0.001 %"


def test_summary_and_report_give_the_same_figures_to_the_same_digits():
    from optical_palpation.present import summarise
    from optical_palpation.present.report.content import force_rows, stress_rows

    x = np.linspace(0, 2, 5)
    stress = xr.DataArray(np.full((5, 5), -4.5273), dims=("y", "x"), coords={"y": x, "x": x})
    maps = xr.Dataset(
        {
            "axial_stress": stress,
            "algebraic_axial_stress": 0.6 * stress,
            "axial_stress_error": 0 * stress + 0.8666,
            "contact_pressure": -stress,
            "loaded_thickness": 0 * stress + 0.4,
        },
        attrs={
            "window_force_mN": 78.91,
            "sample_force_mN": 78.93,
            "force_error_mN": 14.51,
            "error_bands": "{}",
        },
    )
    text = summarise(StressResult(maps))
    assert "total force: window 79 \u00b1 15 mN, sample 79 \u00b1 15 mN" in text
    assert "computational: mean -4.53 \u00b1 0.87 kPa" in text
    assert "interpolated" not in text
    rows = dict(force_rows(StressResult(maps)))
    assert rows["Force on the window"] == "79 \u00b1 15 mN"
    assert stress_rows(StressResult(maps))[0] == ("Mean", "\u22122.72", "\u22124.53 \u00b1 0.87")
