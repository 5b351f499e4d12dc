"""The napari plugin with real Qt and OpenGL: dropped files, mouse, table, sliders, saved study."""

import gc
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from optical_palpation.analysis import region_statistics
from optical_palpation.analysis.maps import map_error
from optical_palpation.palpation.plausibility import SOFT_SAMPLE
from optical_palpation.study import read_study, run_study, warnings_about
from optical_palpation.thickness import read_corrections, write_thickness_map
from optical_palpation.viewer.layers import KEY
from optical_palpation.viewer.session import Session
from study_case import STUDY, make_study, make_volumes
from viewer_pictures import click, drag, on_canvas, pump, wait

pytest.importorskip("napari", reason="napari is not installed")

# A viewer that shows a layer of every kind the plugin needs, in a process that may die of it.
TRIAL = """
import napari, numpy as np
viewer = napari.Viewer(show=False)
viewer.add_image(np.random.rand(4, 5, 6))
assert viewer.screenshot(canvas_only=False, flash=False).std() > 0
viewer.close()
"""


@pytest.fixture(scope="module")
def display():
    """A screen: the one there is, or a virtual one; without OpenGL on it, skip."""
    server, before = None, os.environ.get("DISPLAY")
    if sys.platform.startswith("linux") and not before and shutil.which("Xvfb"):
        read, write = os.pipe()
        server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(write), "-screen", "0", "1600x1000x24", "-nolisten", "tcp"],
            pass_fds=(write,),
            stderr=subprocess.DEVNULL,
        )
        os.close(write)
        with os.fdopen(read) as number:
            os.environ["DISPLAY"] = f":{number.readline().strip()}"
    try:
        tried = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, text=True)
        if tried.returncode != 0:
            pytest.skip("no screen with OpenGL for napari")
        import napari.window  # noqa: F401

        import optical_palpation.viewer.panel  # noqa: F401

        # napari collects garbage whenever a layer goes: it need not look among all these modules
        gc.collect()
        gc.freeze()
        yield
    finally:
        gc.unfreeze()
        if server is not None:
            server.terminate()
            server.wait()
            del os.environ["DISPLAY"]


@pytest.fixture
def viewer(display):
    import napari

    viewer = napari.Viewer(show=True)
    viewer.window._qt_window.resize(1400, 900)
    yield viewer
    viewer.close()
    pump()


@pytest.fixture
def panel(viewer):
    panel = viewer.window.add_plugin_dock_widget("optical-palpation")[1]
    yield panel
    panel.bench.background.cancel()
    wait(lambda: not panel.bench.background.is_busy)
    panel.bench.session.close()


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    make_volumes(folder)
    # the window shows what coarse elements give as it shows anything else
    return make_study(folder, STUDY.replace("[0.2, 0.2, 0.1]", "[0.2, 0.2, 0.2]"))


def wait_idle(panel):
    wait(lambda: not panel.bench.background.is_busy)
    assert not panel.message.text().startswith("error"), panel.message.text()


def layer(panel, kind, side=None):
    return next(panel.bench.layers(kind, side))


def test_the_manifest_is_valid():
    from npe2 import PluginManifest

    manifest = PluginManifest.from_distribution("optical-palpation")
    manifest.validate_imports()
    assert {reader.command for reader in manifest.contributions.readers} == {
        "optical-palpation.read_volume",
        "optical-palpation.read_maps",
        "optical-palpation.open_study",
    }


def test_a_dropped_volume_lies_where_its_file_says(viewer, tmp_path):
    from volume_samples import WRITERS, volume

    path, _ = WRITERS["hdf5"](tmp_path, volume())
    (shown,) = viewer.open(path, plugin="optical-palpation")
    assert shown.data.shape == volume().shape
    assert [str(unit) for unit in shown.units] == ["millimeter"] * 3
    assert tuple(shown.scale) == pytest.approx((0.0035, 0.02, 0.01))
    assert np.array_equal(shown.data[:, 2], volume()[:, 2])


def test_a_volume_that_says_too_little_is_opened_with_what_it_lacks(panel, study):
    from optical_palpation.viewer.reading import read_volume, volume_reader

    path = str(study.parent / "loaded.npy")
    assert volume_reader(path) is read_volume
    assert volume_reader(str(study)) is None
    with pytest.raises(Exception, match=r"axes \(.*Open volume"):
        read_volume(path)
    fields = {"axes": "yzx", "spacing": "{z = 0.0029, y = 0.03, x = 0.03}", "scale": "linear"}
    for key, text in fields.items():
        panel.measurement.how[key].setText(text)
    panel.measurement.open(path)
    shown = layer(panel, "volume")
    assert tuple(shown.scale) == pytest.approx((0.0029, 0.03, 0.03))
    panel.measurement.thickness.set(0.45)
    choice = panel.measurement.choice["unloaded"]
    choice.setCurrentIndex(choice.findData("a thickness"))
    panel.measurement.find_layer()
    wait_idle(panel)
    assert panel.bench.session.tables["loaded"]["axes"] == "yzx"
    assert layer(panel, "boundary", "loaded").data.shape == (40 * 47, 2, 3)


def test_volumes_opened_one_by_one_are_taken_for_what_they_are_called(panel, study, monkeypatch):
    from qtpy.QtWidgets import QFileDialog

    asked = iter(study.parent / f"{name}.npy" for name in ("loaded", "loaded", "unloaded"))
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(next(asked)), ""))
    measurement = panel.measurement
    measurement._ask_for_volume()
    assert "does not say: axes" in panel.message.text()
    assert measurement.folded.isExpanded()  # where to say it
    fields = {"axes": "yzx", "spacing": "{z = 0.0029, y = 0.03, x = 0.03}", "scale": "linear"}
    for key, text in fields.items():
        measurement.how[key].setText(text)
    measurement._ask_for_volume()
    assert panel.message.text() == "opened loaded.npy"
    assert measurement.choice["unloaded"].currentText() == "a thickness"
    assert measurement.thickness.isEnabled()
    assert panel.bench.viewer.dims.order == (1, 0, 2)  # B-scans, not depths
    measurement._ask_for_volume()
    chosen = [measurement.choice[side].currentText() for side in ("loaded", "unloaded")]
    assert chosen == ["loaded.npy", "unloaded.npy"]
    measurement.apply()
    assert panel.bench.session.tables["unloaded"]["volume"].endswith("unloaded.npy")
    assert not measurement.thickness.isEnabled()
    visible = {volume.name: volume.visible for volume in panel.bench.layers("volume")}
    assert visible == {"loaded.npy": False, "unloaded.npy": True}
    assert panel.solving.numbers["material.c10"]._box.text() == "? kPa"


def test_the_unloaded_volume_opened_first_is_not_taken_for_both(panel, study):
    measurement = panel.measurement
    fields = {"axes": "yzx", "spacing": "{z = 0.0029, y = 0.03, x = 0.03}", "scale": "linear"}
    for key, text in fields.items():
        measurement.how[key].setText(text)
    for name in ("unloaded", "loaded"):
        measurement.open(str(study.parent / f"{name}.npy"))
    chosen = [measurement.choice[side].currentText() for side in ("loaded", "unloaded")]
    assert chosen == ["loaded.npy", "unloaded.npy"]


@pytest.mark.parametrize("across", [0.3, 60.0])
def test_maps_of_any_size_have_outlines_that_show_and_hide_nothing(panel, tmp_path, across):
    x, y = np.meshgrid(np.linspace(0, across, 31), np.linspace(0, across, 31))
    pressed = across / 8 * (1 - 0.1 * np.exp(-((x - y) ** 2) / across**2))
    np.save(tmp_path / "map.npy", pressed)
    (tmp_path / "study.toml").write_text(
        f"unloaded = {{ thickness = {across / 8} }}\n"
        f'loaded = {{ map = "map.npy", field_of_view = [{across}, {across}] }}\n'
        "material = { c10 = 2.23 }\nfriction = { window = 0.1, sample = 0.1 }\n"
        f"grid = {{ element_size = {across / 10} }}\nerrors = {{ estimates = false }}\n"
    )
    panel.open_study(str(tmp_path / "study.toml"))
    panel.measurement.find_layer()
    assert "there is nothing to find" in panel.message.text()
    panel.solving.solve()
    wait_idle(panel)
    width = layer(panel, "regions").current_edge_width
    assert 0.002 * across < width < 0.02 * across


def test_of_a_result_the_stress_is_seen(viewer, tmp_path):
    here = {"y": np.linspace(0, 1, 11), "x": np.linspace(0, 2, 21)}
    names = {"axial_stress": "kPa", "loaded_thickness": "mm", "quality": "1"}
    fields = {name: (("y", "x"), np.ones((11, 21)), {"units": u}) for name, u in names.items()}
    xr.Dataset(fields, here).to_netcdf(tmp_path / "stress.nc", engine="h5netcdf")
    shown = viewer.open(tmp_path / "stress.nc", plugin="optical-palpation")
    assert [it.visible for it in shown] == ["Axial stress" in it.name for it in shown]
    assert sum(it.visible for it in shown) == 1


def test_dropped_maps_have_units_and_limits_in_common(viewer, tmp_path):
    here = {"y": np.linspace(0, 1, 11), "x": np.linspace(0, 2, 21)}
    fields = {
        name: xr.DataArray(
            low * np.ones((11, 21)), here, ("y", "x"), attrs={"units": "mm"}
        )
        for name, low in (("loaded_thickness", 0.4), ("initial_thickness", 0.5))
    }  # fmt: skip
    write_thickness_map(xr.Dataset(fields), tmp_path / "maps.nc")
    shown = viewer.open(tmp_path / "maps.nc", plugin="optical-palpation")
    assert [layer.name for layer in shown] == [
        "maps: Loaded thickness (mm)",
        "maps: Unloaded thickness (mm)",
    ]
    assert shown[0].contrast_limits == shown[1].contrast_limits
    assert [layer.visible for layer in shown] == [True, False]


def test_from_volumes_to_a_table_and_back_to_the_command(viewer, panel, study, tmp_path):
    from qtpy.QtWidgets import QPushButton

    bench = panel.bench
    panel.open_study(str(study))
    assert {layer.name for layer in viewer.layers} == {"unloaded.npy", "loaded.npy"}
    panel.measurement.find_layer()
    wait_idle(panel)
    assert viewer.dims.order == (1, 0, 2)
    next(b for b in panel.measurement.findChildren(QPushButton) if b.text() == "Maps").click()
    assert [m.name for m in bench.layers("map") if m.visible] == [
        "loaded: Thickness of the layer (mm)"
    ]
    before = bench.session.find("loaded")

    assert panel.regions.table.horizontalHeaderItem(0).text() == "mean"

    # an anchor on a B-scan
    panel.correction.boundary.setCurrentText("sample")
    panel.correction.draw_anchors()
    viewer.dims.set_current_step(1, 30)
    click(viewer, (0.40, 0.6))
    anchors = layer(panel, "anchors", "loaded")
    assert len(anchors.data) == 1
    # a rectangle on a map
    panel.correction.boundary.setCurrentText("window")
    panel.correction.exclude()
    assert viewer.dims.order == (0, 1, 2)
    drag(viewer, (0.1, 0.9), (0.4, 1.2))
    panel.correction.find_again()
    wait_idle(panel)
    made = bench.session.corrections["loaded"]
    ((boundary, x, y, z),) = made.anchors
    assert boundary == "sample"
    assert (x, y, z) == (pytest.approx(0.6, abs=0.02), pytest.approx(0.9), pytest.approx(0.4, abs=0.01))  # fmt: skip  # noqa: E501
    ((boundary, *span),) = made.exclusions
    assert boundary == "window"
    assert span == pytest.approx([0.9, 1.2, 0.1, 0.4], abs=0.02)
    after = bench.session.find("loaded")
    inside = after.sel(x=slice(0.95, 1.15), y=slice(0.15, 0.35))
    assert inside["filled"].all()
    assert not after["sample_depth"].equals(before["sample_depth"])
    panel.correction.save(tmp_path / "corrections.txt")
    assert read_corrections(tmp_path / "corrections.txt") == made
    panel.correction.load(tmp_path / "corrections.txt")
    assert np.allclose(layer(panel, "anchors", "loaded").data, anchors.data)

    # layers to draw on come back when they were removed in napari
    bench.viewer.layers.remove(layer(panel, "excluded", "loaded"))
    panel.correction.exclude()
    assert layer(panel, "excluded", "loaded").mode == "add_rectangle"
    panel.correction.load(tmp_path / "corrections.txt")

    # stress, and a region on it
    panel.solving.solve()
    wait_idle(panel)
    result = bench.result
    said = panel.solving.outcome.text()
    assert re.match(r"force [\d.]+ \u00b1 [\d.]+ mN, mean axial stress \u2212[\d.]+ \u00b1", said)
    for warning in (*warnings_about(result), SOFT_SAMPLE):
        assert warning in said
    shown = {layer.name: layer for layer in viewer.layers}
    stress = shown["Axial stress, computational (kPa)"]
    assert np.array_equal(stress.data, result.maps["axial_stress"].values.astype(np.float32))
    assert stress.contrast_limits == shown["Axial stress, algebraic (kPa)"].contrast_limits
    panel.regions.draw()
    drag(viewer, (0.3, 0.3), (0.9, 0.8))
    wait(lambda: panel.regions.table.rowCount() == 1 and not panel.regions._timer.isActive())
    (region,) = panel.regions.regions()
    expected = region_statistics(result.maps, [region])
    table = panel.regions.table
    header = [table.horizontalHeaderItem(i).text() for i in range(6)]
    kpa = ["mean\n(kPa)", "mean ±\n(kPa)", "lowest\n(kPa)", "highest\n(kPa)"]
    assert header == [*kpa, "force\n(mN)", "force ±\n(mN)"]
    columns = ["mean", "mean_error", "minimum", "maximum", "force", "force_error"]
    texts = [table.item(0, column).text() for column in range(6)]
    for text, name in zip(texts, columns, strict=True):
        # as many digits as the error leaves, two of the error itself, else three
        value, error = float(expected[name][0]), expected.get(f"{name}_error")
        if name in ("minimum", "maximum"):
            error = expected["mean_error"]  # no more digits than the mean has
        digits = 0.05 if name.endswith("_error") else 0.005
        step = digits * abs(value) if error is None else 0.05 * float(error[0])
        assert float(text.replace("\u2212", "-")) == pytest.approx(value, abs=1.01 * step + 1e-6)
    assert len(texts[1].replace(".", "").strip("0")) <= 2
    assert float(expected["area"][0]) == pytest.approx(0.3, rel=0.1)
    panel.regions.save_table(tmp_path / "table.csv")
    assert "mean_kPa" in (tmp_path / "table.csv").read_text()
    panel.regions.save_regions(tmp_path / "regions.csv")
    panel.regions.load(tmp_path / "regions.csv")
    assert panel.regions.table.item(0, 0).text() == texts[0]

    # another friction, as the slider is let go
    panel.solving.live.setChecked(True)
    wait_idle(panel)
    panel.solving.numbers["friction.window"]._slider.setValue(60)
    friction = panel.solving.numbers["friction.window"].value()
    assert friction == pytest.approx(0.3)
    # what was solved as the box was ticked may come first
    wait(lambda: bench.result.maps.attrs["window_friction"] == friction)
    wait_idle(panel)
    # without the errors of the inputs there may be one of the mesh, which is called so
    now = panel.solving.outcome.text()
    assert "by the mesh alone" not in said
    assert ("\u00b1" in now) == ("by the mesh alone" in now)
    assert bench.result.maps.attrs["sample_force_mN"] > result.maps.attrs["sample_force_mN"]
    assert np.array_equal(stress.data, bench.result.maps["axial_stress"].values.astype(np.float32))

    # maps that were not there before lie below the regions
    panel.solving.solve()
    wait_idle(panel)
    assert "95 % band" in " ".join(it.name for it in viewer.layers)
    assert viewer.layers[-1] is next(bench.layers("regions"))

    panel.save_study(str(tmp_path / "mine.toml"))
    only_stress = {"errors.estimates": False, "outputs.write": []}
    done = run_study(read_study(tmp_path / "mine.toml", only_stress))
    again = xr.load_dataset(done.folder / "stress.nc", engine="h5netcdf")
    for name in ("axial_stress", "contact_pressure", "contact_state"):
        assert np.array_equal(again[name].values, bench.result.maps[name].values)


def test_a_study_that_is_shown_and_not_changed_stays_as_it_is(panel, study, tmp_path):
    text = study.read_text().replace('.npy"', '.npy"\nsample = "rise"', 2)
    text = text.replace('unloaded.npy"\nsample = "rise"', 'unloaded.npy"\nsample = "line"')
    for name in ("loaded.npy", "unloaded.npy"):
        text = text.replace(f'"{name}"', f'"{(study.parent / name).as_posix()}"')
    for before, after in {
        "c10 = 2.23": "c10 = 2.23456789",
        "c01 = 0.703": "c01 = -0.00012345",
        "window = 0.15": "window = 0.0125",
        "sample = 0.05": "sample = 1.98765",
    }.items():
        assert before in text
        text = text.replace(before, after)
    measurement, numbers = panel.measurement, panel.solving.numbers
    for size in ([0.20000001, 0.2, 0.1], 0.20000001, 0.0004):
        file = tmp_path / "study.toml"
        file.write_text(text.replace("[0.2, 0.2, 0.2]", str(size)))
        panel.open_study(str(file))
        session = panel.bench.session
        sides = {side: dict(session.tables[side]) for side in ("loaded", "unloaded")}
        panel.solving.apply()
        assert {side: session.tables[side] for side in sides} == sides
        assert session.tables["material"]["c10"] == 2.23456789
        assert session.tables["material"]["c01"] == -0.00012345
        assert session.tables["friction"] == {"window": 0.0125, "sample": 1.98765}
        assert session.tables["grid"]["element_size"] == size
    # what is typed or dragged counts, for both volumes and to the usual digits
    measurement.sample_edge.setCurrentText("fall")
    numbers["friction.window"]._slider.setValue(70)
    panel.solving.apply()
    assert [session.tables[side]["sample"] for side in sides] == ["fall", "fall"]
    assert session.tables["friction"]["window"] == 0.35


def test_what_was_drawn_since_counts_for_the_stress_and_ends_with_its_volume(
    viewer, panel, study, tmp_path
):
    bench, solving = panel.bench, panel.solving
    panel.open_study(str(study))
    solving.solve(live=True)  # finds the layer, too
    wait_idle(panel)
    found, before = dict(bench.seen), bench.result
    assert set(found) == {"loaded", "unloaded"}
    assert not any(it.visible for it in bench.layers("boundary"))
    solving.solve(live=True)
    wait_idle(panel)
    assert bench.seen["loaded"] is found["loaded"]  # nothing was drawn
    panel.correction.exclude()
    drag(viewer, (0.5, 0.7), (0.9, 1.1))
    solving.solve(live=True)
    wait_idle(panel)
    assert bench.seen["loaded"] is not found["loaded"]
    assert bench.seen["unloaded"] is found["unloaded"]
    assert not bench.result.maps["axial_stress"].equals(before.maps["axial_stress"])
    panel.save_study(str(tmp_path / "mine.toml"))
    panel.open_study(str(tmp_path / "mine.toml"))
    made = dict(bench.session.corrections)
    assert len(made["loaded"].exclusions) == 1
    panel.measurement.find_layer()
    wait_idle(panel)
    solving.apply()
    assert bench.session.corrections == made  # to the last digit
    choice = panel.measurement.choice["loaded"]
    choice.setCurrentText("unloaded.npy")
    solving.apply()
    assert not list(bench.layers("excluded", "loaded"))
    assert not bench.session.corrections.get("loaded")


def test_a_computation_can_be_cancelled_and_the_window_stays_alive(panel, study):
    panel.open_study(str(study))
    panel.measurement.find_layer()
    wait_idle(panel)
    panel.solving.numbers["grid.element_size"].set(0.03)
    stages = []
    panel.bench.background.progressed.connect(lambda stage, share: stages.append((stage, share)))
    panel.solving.solve()
    assert panel.cancel.isEnabled()
    wait(lambda: any("elements" in stage for stage, _ in stages))
    panel.cancel.click()
    wait(lambda: not panel.bench.background.is_busy)
    assert panel.bench.result is None
    assert panel.message.text() == "cancelled"
    assert not panel.cancel.isEnabled()
    assert not list(panel.bench.layers("regions"))
    # what comes next is not harmed
    panel.solving.numbers["grid.element_size"].set(0.2)
    panel.solving.solve()
    wait_idle(panel)
    assert panel.bench.result is not None
    assert panel.message.text() == ""
    figures = panel.solving.outcome.text()
    panel.solving.numbers["friction.window"].set(0.3)
    panel.solving.solve()
    panel.cancel.click()
    wait(lambda: not panel.bench.background.is_busy)
    assert panel.message.text() == "cancelled; the figures are those of the last solution"
    assert panel.solving.outcome.text() == figures


def test_only_the_last_of_many_changes_is_solved(panel):
    bench, seen, started = panel.bench, [], []

    def job(number):
        def compute(tell):
            started.append(number)
            for step in range(100):
                tell(type("Report", (), {"stage": "waiting", "load": step / 100}))
                time.sleep(0.01)
            return number

        return compute

    for number in range(5):
        bench.background.run(job(number), seen.append)
        pump()
    wait(lambda: not bench.background.is_busy)
    assert seen == [4]
    assert started[0] == 0
    assert started[-1] == 4


def test_what_is_missing_or_wrong_is_said(panel, study, tmp_path):
    panel.measurement.find_layer()
    assert "choose the loaded layer: drop its volume" in panel.message.text()
    panel.correction.draw_anchors()
    assert "find the layer" in panel.message.text()
    panel.regions.draw()
    assert "solve first" in panel.message.text()
    panel.open_study(str(study))
    panel.solving.numbers["friction.window"].set(None)
    panel.solving.solve()
    assert "friction.window: is missing" in panel.message.text()
    panel.solving.numbers["friction.window"].set(0.1)
    panel.solving.numbers["grid.element_size"].set(5.0)
    panel.solving.solve()
    wait(lambda: not panel.bench.background.is_busy)
    assert panel.message.text().startswith("grid: the element size along z, 5 mm, is larger")
    assert panel.bench.result is None
    with pytest.raises(Exception, match=r"ends in \.toml"):
        panel.save_study(str(tmp_path / "a.txt"))


def test_a_study_of_a_number_and_a_volume_is_shown_as_it_is(panel, study):
    session = Session.open(study)
    session.change({"unloaded": {"thickness": 0.44}, "grid.element_size": [0.2, 0.25, 0.1]})
    session.change({"friction": {"window": "glued", "sample": 0.1, "slip_length": 0.001}})
    panel.bench.take_up(session)
    assert panel.solving.numbers["friction.window"].value() == "glued"
    assert panel.solving.numbers["friction.window"]._word.isChecked()
    assert panel.measurement.thickness.value() == 0.44
    assert layer(panel, "volume").metadata[KEY]["input"]["volume"].endswith("loaded.npy")
    panel.solving.apply()
    assert session.tables["unloaded"] == {"thickness": 0.44}
    assert session.tables["grid"]["element_size"] == [0.2, 0.25, 0.1]
    assert session.tables["friction"] == {"window": "glued", "sample": 0.1, "slip_length": 0.001}


def test_the_extent_of_the_layer_is_typed_and_kept(panel, study, tmp_path):
    panel.open_study(str(study))
    fields = panel.measurement.extent
    assert [field.text() for field in fields.values()] == [""] * 4
    panel.solving.solve(live=True)
    wait_idle(panel)
    whole = panel.bench.result.maps
    assert "layer" not in panel.bench.session.tables
    fields["x0"].setText("0.3")
    panel.solving.solve()
    assert "four numbers of mm, x0, x1, y0, y1" in panel.message.text()
    for edge, text in {"x1": "1.2", "y0": "0.15", "y1": "1.05"}.items():
        fields[edge].setText(text)
    panel.solving.solve(live=True)
    wait_idle(panel)
    part = panel.bench.result.maps
    assert not whole["axial_stress"].equals(part["axial_stress"])
    for axis, low, high in (("x", 0.3, 1.2), ("y", 0.15, 1.05)):
        there = part["axial_stress"].dropna(axis, how="all")[axis]
        assert low - 1e-9 <= float(there[0]) <= float(there[-1]) <= high + 1e-9

    panel.save_study(str(tmp_path / "part.toml"))
    saved = read_study(tmp_path / "part.toml")
    assert tuple(saved.layer.extent) == (0.3, 1.2, 0.15, 1.05)
    panel.open_study(str(study))
    assert [field.text() for field in fields.values()] == [""] * 4
    panel.open_study(str(tmp_path / "part.toml"))
    assert [field.text() for field in fields.values()] == ["0.3", "1.2", "0.15", "1.05"]
    # solved as it is changed, too
    panel.solving.live.setChecked(True)
    wait(lambda: panel.bench.result is not None and not panel.bench.background.is_busy)
    before = panel.bench.result
    for field in fields.values():
        field.clear()
    fields["y1"].editingFinished.emit()
    wait(lambda: panel.bench.result is not before and not panel.bench.background.is_busy)
    assert panel.bench.session.tables["layer"] == {}
    again = panel.bench.result.maps["axial_stress"]
    assert np.array_equal(again.values, whole["axial_stress"].values)  # no such layer came before
    assert "Solve computes it anew" not in panel.solving.outcome.text()
    panel.solving.solve(live=True)
    wait_idle(panel)
    again = panel.bench.result.maps["axial_stress"]
    assert np.allclose(again, whole["axial_stress"], rtol=0.005, atol=0.005, equal_nan=True)
    assert "Solve computes it anew" in panel.solving.outcome.text()
    panel.solving.live.setChecked(False)
    panel.solving.solve()
    wait_idle(panel)
    again = panel.bench.result.maps["axial_stress"]
    assert np.array_equal(again.values, whole["axial_stress"].values)
    assert "Solve computes it anew" not in panel.solving.outcome.text()


def test_regions_that_are_loaded_come_to_those_that_were_drawn(panel, study, tmp_path):
    panel.open_study(str(study))
    panel.solving.solve(live=True)
    wait_idle(panel)
    maps = panel.bench.result.maps
    panel.regions.draw("add_ellipse")
    drag(panel.bench.viewer, (0.3, 0.3), (0.6, 0.6))
    shown = layer(panel, "regions")
    # a ring with a pixel that touches it at a corner, and a second label
    labels = np.zeros(maps["axial_stress"].shape, np.uint8)
    labels[1:4, 1:4] = labels[4, 4] = 1
    labels[2, 2] = 0
    labels[1:3, 5:7] = 2
    np.save(tmp_path / "labels.npy", labels)
    for _ in range(2):
        panel.regions.load(tmp_path / "labels.npy")
    assert layer(panel, "regions") is shown
    assert shown.shape_type[0] == "ellipse"
    regions = panel.regions.regions()
    names = ["region 1", "label 1", "label 2", "label 1 2", "label 2 2"]
    assert [region.name for region in regions] == names
    for region, number in zip(regions[1:], (1, 2, 1, 2), strict=True):
        assert np.array_equal(region.weights(maps["axial_stress"]), labels == number)
    table = panel.regions.table
    assert [table.verticalHeaderItem(row).text() for row in range(table.rowCount())] == names
    for row, number in ((1, 1), (2, 2), (3, 1)):
        mean = float(maps["axial_stress"].values[labels == number].mean())
        said = float(table.item(row, 0).text().replace("\u2212", "-"))
        assert said == pytest.approx(mean, rel=0.006)


def test_a_result_is_compared_with_another(panel, study, tmp_path, monkeypatch):
    from qtpy.QtWidgets import QFileDialog, QPushButton

    file = tmp_path / "before.nc"
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_, **__: (str(file), ""))
    button = next(b for b in panel.solving.findChildren(QPushButton) if b.text() == "Compare with…")
    button.click()
    assert "solve first" in panel.message.text()
    panel.open_study(str(study))
    panel.solving.numbers["grid.element_size"].set(0.17)  # a relief of enough points to align
    panel.solving.solve()
    wait_idle(panel)
    button.click()
    assert panel.message.text() == f"{file}: no such file"
    before = panel.bench.result
    before.save(file)
    panel.solving.numbers["friction.window"].set(0.3)
    panel.solving.solve()
    wait_idle(panel)
    now = panel.bench.result
    button.click()
    names = {"Difference (kPa)", "Error of the difference (kPa)"}
    shown = {it.name: it for it in panel.bench.layers("map") if it.name in names}
    assert set(shown) == names
    assert "before.nc less this" in panel.bench.viewer.canvas.overlays.text.text
    assert shown["Error of the difference (kPa)"].contrast_limits[0] >= 0
    difference = before.maps["axial_stress"].values - now.maps["axial_stress"].values
    error = np.hypot(*(map_error(it.maps, "axial_stress").values for it in (before, now)))
    for name, values in (("Difference", difference), ("Error of the difference", error)):
        layer_of_it = shown[f"{name} (kPa)"]
        np.testing.assert_allclose(layer_of_it.data, values, rtol=1e-5, atol=1e-6)
        assert layer_of_it.visible == (name == "Difference")
    said = panel.message.text()
    rms = np.sqrt(np.nanmean(difference**2))
    assert f"rms difference {rms:.3g} kPa" in said
    known = np.isfinite(error) & np.isfinite(difference)
    within = 100 * np.mean(np.abs(difference[known]) <= error[known])
    share = re.search(r"([\d.]+) % of the map within the error", said)
    assert float(share[1]) == pytest.approx(within, rel=0.01)
    # the same sample, scanned from elsewhere
    step = float(np.diff(now.maps["x"]).mean())
    moved = now.maps.assign_coords(x=now.maps["x"] + 3 * step)
    replace(now, maps=moved).save(file)
    button.click()
    assert "shifted" not in panel.message.text()
    panel.solving.align.setChecked(True)
    button.click()
    assert f"shifted by x {-3 * step:+.3g} and y" in panel.message.text()
    (shown,) = (it for it in panel.bench.layers("map") if it.name == "Difference (kPa)")
    assert np.nanmax(np.abs(shown.data)) < 1e-6
    # it is one with a stress that is shown
    panel.solving.solve(live=True)
    wait_idle(panel)
    assert not [it for it in panel.bench.layers("map") if it.name in names]


def drop(viewer, path):
    """Drop a file on the canvas."""
    from qtpy.QtCore import QMimeData, QPointF, Qt, QUrl
    from qtpy.QtGui import QDropEvent

    mime = QMimeData()
    mime.setUrls([QUrl.fromLocalFile(str(path))])
    left, none = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
    copy = Qt.DropAction.CopyAction
    viewer.window._qt_viewer.dropEvent(QDropEvent(QPointF(50, 50), copy, mime, left, none))
    pump()


def test_a_dropped_study_is_opened_in_the_panel(viewer, study, tmp_path):
    drop(viewer, study)
    dock, panel = viewer.window.add_plugin_dock_widget("optical-palpation")
    assert panel.message.text() == "opened study.toml"
    assert {layer.name for layer in viewer.layers} == {"unloaded.npy", "loaded.npy"}
    assert panel.solving.numbers["material.c10"].value() == 2.23
    dock.hide()
    (tmp_path / "bad.toml").write_text("[unloaded]\nthickness = -1\n")
    drop(viewer, tmp_path / "bad.toml")
    assert dock.isVisible()
    assert "thickness" in panel.message.text()
    panel.bench.session.close()


def test_volumes_of_other_readers_are_named_with_what_to_do(panel, viewer):
    viewer.add_image(np.zeros((4, 5, 6), np.float32), name="plain")
    panel.measurement.find_layer()
    assert "choose the loaded layer: plain came by another reader" in panel.message.text()
    assert "Open volume" in panel.message.text()
    assert panel.measurement.folded.isExpanded()


def test_the_map_that_is_seen_is_named_and_not_under_its_colour_bar(panel, study):
    panel.open_study(str(study))
    panel.solving.solve(live=True)
    wait_idle(panel)
    bench, viewer = panel.bench, panel.bench.viewer
    text = viewer.canvas.overlays.text
    assert (text.visible, text.text) == (True, "Axial stress, computational (kPa)")
    stress = next(it for it in bench.layers("map") if it.name == text.text)
    top, right = stress.extent.world[1] + stress.scale / 2  # y points up
    for size in ((1400, 900), (1330, 820), (1000, 900), (1500, 600)):
        viewer.window._qt_window.resize(*size)
        pump(0.3)
        bench.view_maps([stress.name])
        pump()
        corner = on_canvas(viewer, (top, right))
        assert corner.y() > 165 or corner.x() < viewer.canvas.size[1] - 75, size
    assert text.text == stress.name
    # names of regions are read on what is bright and on what is dark
    shape = stress.data.shape
    steps = np.where(np.arange(shape[1]) < 3, *stress.contrast_limits[::-1])
    stress.data = np.broadcast_to(steps, shape).astype(np.float32)
    drawn = layer(panel, "regions")
    for x in (0.2, 1.0):
        drawn.add_rectangles(np.array([(0.2, x - 0.1), (0.4, x + 0.1)]))
    panel.regions.update_table()
    brightest_first = stress.colormap.map([1.0, 0.0])[:, :3].mean(1)
    assert brightest_first[0] < brightest_first[1]  # viridis, the other way round
    colours = drawn.text.color(drawn.features)
    assert np.allclose(colours[:, :3], [[1, 1, 1], [0, 0, 0]])
    bench.view_maps(["Contact with the window"])
    assert text.text == "Contact with the window\n0 open, 1 slip, 2 stick, 3 glued"
    next(it for it in bench.layers("map") if it.visible).visible = False
    assert not text.visible
