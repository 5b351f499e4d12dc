"""The pictures of docs/viewer.md: a stranger's way through the napari plugin, with the mouse.

    python benchmarks/viewer_pictures.py docs/viewer

The last picture is of a soft sample and its stiffness, from the thickness map of a virtual
experiment: two columns, of which one is three times as stiff as the layer.

Needs the extra `viewer` and a screen with OpenGL; `xvfb-run -a -s "-screen 0 1600x1000x24"` before
the command gives it a virtual one. The volumes are those of `optical-palpation sample relief`, with
a piece of debris put into the layer, which the boundary follows until it is corrected.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from optical_palpation.experiment.sample_data import make_sample

SIZE = 1500, 930
#: Debris in the loaded volume: x, y, radius, and depth from and to, mm.
DEBRIS = 2.7, 1.5, 0.32, 0.22, 0.62


def pump(seconds=0.0):
    """Let Qt do what there is to do."""
    from qtpy.QtWidgets import QApplication

    end = time.monotonic() + seconds
    while True:
        QApplication.processEvents()
        if time.monotonic() >= end:
            return
        time.sleep(0.01)


def wait(until, seconds=600):
    """Wait for something, the window alive meanwhile."""
    end = time.monotonic() + seconds
    while not until():
        if time.monotonic() > end:
            raise TimeoutError("took too long")
        pump(0.02)
    pump()


def on_canvas(viewer, point):
    """Where a point, in the order of the shown axes (vertical, horizontal), lies on the canvas."""
    from qtpy.QtCore import QPoint

    transform = viewer.window._qt_viewer.canvas.view.scene.transform
    x, y = transform.map([point[1], point[0], 0, 1])[:2]
    return QPoint(round(float(x)), round(float(y)))


def click(viewer, point):
    """Click with the left button."""
    from qtpy.QtCore import Qt
    from qtpy.QtTest import QTest

    pump()
    canvas = viewer.window._qt_viewer.canvas.native
    at = on_canvas(viewer, point)
    QTest.mouseMove(canvas, at)
    pump()
    QTest.mouseClick(canvas, Qt.MouseButton.LeftButton, pos=at)
    pump()


def drag(viewer, start, end):
    """Draw with the left button held."""
    from qtpy.QtCore import Qt
    from qtpy.QtTest import QTest

    pump()
    canvas = viewer.window._qt_viewer.canvas.native
    places = [
        on_canvas(viewer, [a + share * (b - a) for a, b in zip(start, end, strict=True)])
        for share in (0.0, 0.3, 0.6, 1.0)
    ]
    QTest.mouseMove(canvas, places[0])
    QTest.mousePress(canvas, Qt.MouseButton.LeftButton, pos=places[0])
    for at in places[1:]:
        QTest.mouseMove(canvas, at)
        pump()
    QTest.mouseRelease(canvas, Qt.MouseButton.LeftButton, pos=places[-1])
    pump()


def spoil(file):
    """Put debris into a volume of the sample data."""
    volume = np.load(file)  # y, z, x
    dz, dy, dx = 0.0029, 0.04, 0.04
    y, x = (-0.2 + d * np.arange(n) for d, n in ((dy, volume.shape[0]), (dx, volume.shape[2])))
    x0, y0, radius, top, bottom = DEBRIS
    at = np.hypot(x[None, :] - x0, y[:, None] - y0) < radius
    rows = slice(round(top / dz), round(bottom / dz))
    level = np.median(volume[:, -20:])
    random = np.random.default_rng(5)
    debris = level * 2.0 * random.rayleigh(1.0, volume[:, rows].shape)
    volume[:, rows] = np.where(at[:, None, :], debris, volume[:, rows])
    np.save(file, volume.astype(np.float32))


class Tour:
    """The panel in a viewer, and the pictures taken of it."""

    def __init__(self, folder):
        import napari

        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.viewer = napari.Viewer(show=True)
        self.viewer.window._qt_window.resize(*SIZE)
        self.panel = self.viewer.window.add_plugin_dock_widget("optical-palpation")[1]

    def idle(self):
        """Wait until nothing is computed."""
        wait(lambda: not self.panel.bench.background.is_busy)
        if self.panel.message.text():
            print(self.panel.message.text())

    def show(self, part):
        """Scroll the panel to one of its parts."""
        from qtpy.QtWidgets import QScrollArea

        area = self.panel.findChild(QScrollArea)
        area.verticalScrollBar().setValue(part.pos().y() - 5 if part is not None else 0)

    def picture(self, name):
        """Save what the window shows."""
        from PIL import Image

        pump(0.5)
        shot = self.viewer.screenshot(canvas_only=False, flash=False)
        file = self.folder / f"{name}.png"
        picture = Image.fromarray(shot[..., :3])
        picture.quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)
        print(file)


def tour(output, folder):
    """Make the pictures; volumes and studies go to `folder`."""
    from optical_palpation import present

    study = make_sample("relief", folder)
    spoil(folder / "loaded.npy")
    t = Tour(output)
    viewer, panel = t.viewer, t.panel
    panel.open_study(str(study))
    panel.bench.view_bscans("loaded")
    row = round((DEBRIS[1] + 0.2) / 0.04)
    viewer.dims.set_current_step(1, row)
    t.picture("volumes")

    panel.measurement.find_layer()
    t.idle()
    viewer.dims.set_current_step(1, row)
    viewer.scene.camera.zoom *= 1.6
    viewer.scene.camera.center = (0, 0.42, DEBRIS[0])
    t.picture("boundaries")

    camera = viewer.scene.camera.zoom, viewer.scene.camera.center
    panel.correction.draw_anchors()
    viewer.dims.set_current_step(1, row)
    viewer.scene.camera.zoom, viewer.scene.camera.center = camera
    around = panel.bench.session.find("loaded")["sample_depth"].sel(y=DEBRIS[1], method="nearest")
    left, right = (float(around.sel(x=DEBRIS[0] + d, method="nearest")) for d in (-0.5, 0.5))
    for share in (0.3, 0.5, 0.7):
        x = DEBRIS[0] - 0.5 + share
        click(viewer, (left + share * (right - left), x))
    t.show(panel.correction)
    t.picture("anchors")

    panel.correction.exclude()
    x, y, radius = DEBRIS[0], DEBRIS[1], DEBRIS[2] + 0.06
    drag(viewer, (y - radius, x - radius), (y + radius, x + radius))
    t.show(panel.correction)
    t.picture("excluded")

    panel.correction.find_again()
    t.idle()
    panel.bench.view_bscans("loaded")
    viewer.dims.set_current_step(1, row)
    viewer.scene.camera.zoom, viewer.scene.camera.center = camera
    t.picture("corrected")

    panel.solving.solve()
    t.idle()
    t.show(panel.solving)
    t.picture("stress")

    panel.solving.live.setChecked(True)
    t.idle()
    friction = panel.solving.numbers["friction.window"]._slider
    measured, before = friction.value(), panel.bench.result
    friction.setValue(2 * measured)
    wait(lambda: panel.bench.result is not before and not panel.bench.background.is_busy)
    t.show(panel.solving)
    t.picture("friction")
    panel.solving.live.setChecked(False)
    friction.setValue(measured)
    panel.solving.solve()
    t.idle()

    panel.regions.draw()
    drag(viewer, (1.5, 1.5), (2.5, 2.5))
    panel.regions.draw("add_ellipse")
    drag(viewer, (0.4, 0.2), (1.2, 0.9))
    layer = next(panel.bench.layers("regions"))
    for number, name in enumerate(("peak", "side")):
        layer.selected_data = {number}
        panel.regions.name.setCurrentText(name)
        panel.regions.name_selected()
    layer.selected_data = set()
    layer.mode = "pan_zoom"
    wait(lambda: panel.regions.table.rowCount() == 2)
    t.show(panel.regions)
    t.picture("regions")

    panel.save_study(str(folder / "mine.toml"))
    present.write_maps(
        panel.bench.result,
        Path(output) / "figure.png",
        width="single",
        scale_bar=True,
        regions=panel.regions.regions(),
    )
    viewer.close()
    pump()


def soft_sample(output, folder):
    """Make the picture of a soft sample: its Young's modulus, and that of two regions."""
    command = [sys.executable, "-m", "optical_palpation", "experiment", "soft_stiff_columns"]
    command += ["--element-size", "0.25", "--output", str(folder)]
    subprocess.run(command, check=True)
    study = folder / "study.toml"
    study.write_text(
        "[unloaded]\nthickness = 0.5\n"
        '[loaded]\nmap = "experiment.nc"\nvariable = "loaded_thickness"\n'
        "[material]\nc10 = 2.23\nc01 = 0.703\n"
        "[friction]\nwindow = 0.3\nsample = 0.1\n"
        "[sample]\nthickness = 2.0\ncompression = 0.5\nplate_friction = 0.3\n"
        "[grid]\nelement_size = 0.2\n"
    )
    t = Tour(output)
    t.panel.open_study(str(study))
    t.panel.solving.solve()
    t.idle()
    t.panel.bench.view_maps(["Young's modulus of the sample (kPa)"])
    t.panel.regions.variable.setCurrentText("Young's modulus of the sample (kPa)")
    layer = next(t.panel.bench.layers("regions"))
    for number, (name, corner) in enumerate({"soft": (2.0, 0.9), "stiff": (2.0, 3.2)}.items()):
        t.panel.regions.draw()
        drag(t.viewer, corner, [c + 1.0 for c in corner])
        layer.selected_data = {number}
        t.panel.regions.name.setCurrentText(name)
        t.panel.regions.name_selected()
    layer.selected_data = set()
    layer.mode = "pan_zoom"
    wait(lambda: t.panel.regions.table.rowCount() == 2)
    t.show(t.panel.regions)
    t.picture("stiffness")
    t.viewer.close()
    pump()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("give the folder for the pictures, docs/viewer")
    with tempfile.TemporaryDirectory() as scratch:
        tour(sys.argv[1], Path(scratch) / "relief")
        soft_sample(sys.argv[1], Path(scratch) / "columns")
