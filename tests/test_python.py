"""The package as a Python user meets it: names, results, studies, sweeps, and errors that help."""

import multiprocessing
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import xarray as xr

import optical_palpation as op
from optical_palpation.analysis.maps import area_mean
from optical_palpation.errors import ConvergenceError, InputError, OutputError
from optical_palpation.mechanics.newton import balance
from optical_palpation.present.report.content import key_figures
from optical_palpation.present.tables import result_columns
from optical_palpation.present.terms import plain, rounded
from optical_palpation.study import python, read_study, warnings_about
from optical_palpation.study.script import reproducing_lines

matplotlib.use("Agg")
X, Y = np.linspace(0, 2, 33), np.linspace(0, 1.5, 25)
GRID = {"element_size": 0.25, "threads": 1}
PRESSED = {"thickness": 1.0, "compression": 0.5, "plate_friction": 0.1}


def loaded(units="mm"):
    y, x = np.meshgrid(Y, X, indexing="ij")
    values = 0.42 - 0.04 * np.exp(-((x - 0.7) ** 2 + (y - 0.8) ** 2) / 0.2)
    return xr.DataArray(values, {"y": Y, "x": X}, ("y", "x"), attrs={"units": units})


def study(**changes):
    tables = {
        "loaded": loaded(),
        "unloaded": 0.5,
        "material": op.MooneyRivlin(2.23, 0.703),
        "friction": {"window": 0.15, "sample": 0.05},
        "grid": GRID,
    }
    return op.Study(**tables | changes)


@pytest.fixture(scope="module")
def result():
    return study().run()


def test_importing_the_package_loads_none_of_it():
    code = (
        "import sys; import optical_palpation as op; print(op.__version__);"
        "print([m for m in ('numpy', 'numba', 'xarray', 'matplotlib') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    version, loaded_modules = out.stdout.splitlines()
    assert version[0].isdigit()
    assert loaded_modules == "[]"


def test_every_public_name_is_there():
    for name in op.__all__:
        assert getattr(op, name) is not None
        assert name in dir(op)
    assert op.present.write_panel
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = op.nothing_of_the_kind


def test_a_result_says_in_one_line_what_it_is(result):
    text = repr(result)
    assert "\n" not in text
    assert "computational" in text
    force, error = re.search("force ([0-9.]+) \u00b1 ([0-9.]+) mN", text).groups()
    assert abs(float(force) - result.maps.attrs["sample_force_mN"]) <= 0.06 * float(error)
    assert len(text) < 200


def test_a_notebook_shows_a_picture_and_words(result):
    html = result._repr_html_()
    assert "data:image/png;base64," in html
    assert "total force" in html
    assert "<script" not in html
    bare = op.StressResult(xr.Dataset({"axial_stress": loaded() * -1}))
    assert "img" not in bare._repr_html_()


def test_plot_draws_into_axes_of_ones_own(result):
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.subplots()
    assert result.plot("contact_pressure", ax=axes, limits=(0, 5)) is axes
    assert axes.collections[0].get_clim() == (0, 5)
    assert "Contact pressure (kPa)" in axes.get_title(loc="left")
    with pytest.raises(InputError, match="known are"):
        result.plot("strain", ax=axes)
    with pytest.raises(InputError, match="limit: options are"):
        result.plot("axial_stress", ax=axes, limit=(0, 1))


def test_profile_regions_and_comparison(result):
    along = result.profile("x")
    assert float(along["x"][0]) == 0.0
    assert float(along["x"][-1]) == 2.0
    band = result.profile([(0.2, 0.2), (1.8, 1.2)], width=0.2)
    assert band["axial_stress"].attrs["units"] == "kPa"
    for wrong in ("z", 3, [(0, 0)]):
        with pytest.raises(InputError, match="line"):
            result.profile(wrong)
    table = result.regions([op.Region.rectangle("all", -1, 3, -1, 3)], background=None)
    inner = result.maps["axial_stress"]
    area = np.ptp(inner["x"].values) * np.ptp(inner["y"].values)
    assert float(table["mean"][0]) == pytest.approx(float(inner.integrate(("x", "y"))) / area)
    same = result.compare(result)
    assert float(np.abs(same["difference"]).max()) == 0.0
    with pytest.raises(
        InputError, match=r"other: a StressResult \(op.read_result reads one\), not Dataset"
    ):
        result.compare(result.maps)


def test_a_result_is_read_back_with_its_problem_and_its_state(result, tmp_path):
    result.save(tmp_path / "r.nc")
    back = op.read_result(tmp_path / "r.nc")
    for name in ("u", "p", "slip", "anchor", "normal_force"):
        if hasattr(result.state, name):
            np.testing.assert_array_equal(getattr(back.state, name), getattr(result.state, name))
    assert back.problem.friction == result.problem.friction
    np.testing.assert_array_equal(back.problem.grid.nodes, result.problem.grid.nodes)
    assert balance(back.problem, back.state).force_error == result.maps.attrs["force_residual"]


def test_save_goes_by_the_ending(result, tmp_path):
    for name in ("a.png", "a.svg", "a.vts", "a.csv", "a.inp"):
        result.save(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
    with pytest.raises(OutputError, match=r"\.vts \(ParaView file\)"):
        result.save(tmp_path / "a.docx")


def test_a_study_in_python_is_the_study_of_the_file(result, tmp_path):
    from optical_palpation.cli import main

    saved = study().save(tmp_path / "study.toml")
    assert (tmp_path / "study-loaded.nc").is_file()
    with pytest.raises(SystemExit) as leaving:
        main(["run", str(tmp_path / "study.toml"), "--quiet"])
    assert leaving.value.code in (0, None)
    of_file = op.read_result(tmp_path / "study-results" / "stress.nc")
    for name in result.maps.data_vars:
        np.testing.assert_array_equal(of_file.maps[name], result.maps[name], err_msg=str(name))
    assert "0.15 (window)" in repr(saved)
    assert op.Study.read(tmp_path / "study.toml").parameters == saved.parameters


def test_with_changes_some_keys_and_leaves_the_study_as_it_is():
    first = study()
    second = first.with_(friction={"window": 0.3}, material={"c10": 3.0})
    third = first.with_({"friction.window": 0.3, "material.c10": 3.0})
    assert second.parameters == third.parameters
    assert second.parameters["friction"] == {"window": 0.3, "sample": 0.05}
    assert first.parameters["friction"]["window"] == 0.15
    assert "unloaded 0.5 mm; loaded a map in memory;" in repr(first)
    assert first.with_(unloaded=0.45).parameters["unloaded"] == {"thickness": 0.45}
    assert first.with_({"grid.edges": None}).parameters == first.parameters


def test_what_stands_in_for_something_replaces_it(tmp_path):
    np.save(tmp_path / "flat.npy", np.full((9, 9), 0.5))
    first = study()
    accurate = first.with_(grid={"accuracy": 0.05})
    assert accurate.parameters["grid"].keys() == {"accuracy", "edges", "solver", "threads"}
    assert "elements for 5 %" in repr(accurate)
    assert accurate.with_({"grid.element_size": 0.25}).parameters == first.parameters
    flat = {"map": str(tmp_path / "flat.npy"), "field_of_view": [2.0, 1.5]}
    of_map = first.with_(unloaded=flat)
    assert of_map.parameters["unloaded"] == flat
    back = of_map.with_({"unloaded.thickness": 0.5, "unloaded.field_of_view": None})
    assert back.parameters == first.parameters
    with pytest.raises(InputError, match=r"grid: takes element_size \(mm\) or accuracy .*one of"):
        first.with_(grid={"accuracy": 0.05, "element_size": 0.25})


def test_a_study_chooses_its_mesh_by_the_accuracy(tmp_path):
    chosen = study(grid={"accuracy": 0.1, "threads": 1}, errors={"estimates": False})
    result = chosen.run()
    attrs = result.maps.attrs
    assert attrs["force_mesh_error_mN"] < 0.1 * attrs["sample_force_mN"]
    again = chosen.with_(grid={"element_size": attrs["chosen_element_size_mm"]}).run()
    np.testing.assert_array_equal(again.maps["axial_stress"], result.maps["axial_stress"])
    saved = chosen.save(tmp_path / "study.toml")
    assert saved.parameters["grid"]["accuracy"] == 0.1


def test_the_row_of_a_result_in_a_table(result):
    attrs, row = result.maps.attrs, result_columns(result)
    assert row["elements"] == np.prod(attrs["elements"])
    by_hand = np.hypot(attrs["force_error_mN"], attrs.get("force_mesh_error_mN", 0.0))
    assert row["force_error_mN"] == pytest.approx(by_hand)
    error = area_mean(result.maps["axial_stress_error"])
    assert row["mean_axial_stress_error_kPa"] >= error > 0


def test_a_study_without_estimates_has_the_same_stress(result, tmp_path, monkeypatch):
    estimates = {"axial_stress_error", "edge_influence"}
    assert estimates <= set(result.maps)
    alone = study(errors={"estimates": False})
    bare = alone.run()
    np.testing.assert_array_equal(bare.maps["axial_stress"], result.maps["axial_stress"])
    assert not estimates & set(bare.maps)
    assert not [name for name in result_columns(bare) if "error" in name]
    saved = alone.save(tmp_path / "study.toml")
    assert saved.parameters["errors"]["estimates"] is False
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(reproducing_lines(read_study("study.toml")), names)
    np.testing.assert_array_equal(names["result"].maps["axial_stress"], bare.maps["axial_stress"])
    assert not estimates & set(names["result"].maps)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"friction": {"windw": 0.1}}, "friction.windw.*did you mean window"),
        ({"friction": {"window": -1}}, "friction.window"),
        ({"material": (2.23, 0.7)}, "material: a law such as MooneyRivlin.*, or a mapping"),
        ({"material": {"c10": "soft"}}, "material.c10.*number"),
        ({"loaded": "map.npy"}, "loaded: .*DataArray"),
        ({"loaded": np.ones((3, 3))}, "loaded: .*thickness_map makes one of an array"),
        ({"friction": 0.2}, r"friction: a mapping such as \{'window'"),
        ({"unloaded": "thin"}, "unloaded: .*or a number of mm"),
        ({"loaded": {"map": "nowhere.npy"}}, "there is no"),
        ({"loaded": {"map": np.ones((9, 9))}}, "loaded.map: the name of a file; .* loaded=thick"),
        ({"loaded": {"volume": 3}}, "loaded.volume: the name of a file, not int 3"),
        ({"layer": {"extent": [0, 1]}}, r"extent = \[0, 1\] .*: must be an array of 4"),
        ({"layer": {"extent": [0, 1, 0, 1, 1]}}, "must be an array of 4"),
        ({"grid": [0.1, 0.1]}, "must be .*an array of 3"),
        ({"grid": "fine"}, "grid"),
        ({"loaded": loaded("um")}, r"map is in um; give mm: thickness_map\(map\)"),
    ],
)
def test_errors_of_a_study_name_the_argument(changes, message):
    with pytest.raises(InputError, match=message):
        study(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"material": {"c10": -1.0}}, r"^material: unstable"),
        ({"grid": 0.7}, r"^grid: the element size along z, 0\.7 mm"),
        ({"unloaded": 500.0}, r"^unloaded\.thickness: a layer of 500 mm"),
        ({"unloaded": 0.3}, r"^study: .*nothing is pressed"),
        ({"loaded": loaded() * np.nan}, "^loaded: all values are missing"),
        ({"layer": {"registration": True}}, r"^study: layer\.registration = true"),
        (
            {"loaded": {"map": "nowhere.npy"}},
            r"^study: loaded\.map .* there is no \S+nowhere\.npy$",
        ),
        ({"sample": PRESSED | {"relief": 0 * loaded() * np.nan}}, r"^sample: sample\.relief: all"),
        (
            {"sample": PRESSED | {"earlier": [{"map": loaded() * np.nan, "compression": 0.1}]}},
            r"^sample\.earlier\[1\]: sample\.earlier\[1\]\.map: all values",
        ),
        ({"sample": {"motion": loaded()}}, r"sample\.motion = DataArray"),
    ],
)
def test_errors_of_a_study_in_memory_name_what_was_given_and_no_file(changes, message):
    with pytest.raises(InputError, match=message) as caught:
        study(**changes).run()
    for name in (".toml", ".nc", "study file", "optical-palpation-"):
        assert name not in str(caught.value)


def test_a_load_that_a_study_in_memory_does_not_reach_names_no_file(monkeypatch):
    def unreached(*given, **options):
        raise ConvergenceError("loaded to 80 % only")

    monkeypatch.setattr("optical_palpation.study.compute.computational_stress", unreached)
    with pytest.raises(ConvergenceError, match=r"^study: loaded to 80 % only"):
        study().run()


@pytest.mark.parametrize("value", [np.float32(0.5), np.float64(0.5), np.int64(1)])
def test_a_study_takes_the_numbers_of_numpy(value):
    assert study(unloaded=value).parameters["unloaded"] == {"thickness": float(value)}


def test_advice_about_a_map_in_micrometres_can_be_taken():
    given = loaded().assign_attrs(layer_extent=[float(X[1]), float(X[-1]), 0.0, 0.5])
    wrong = (given * 1000).assign_attrs(given.attrs, units="um")
    with pytest.raises(InputError, match="give mm") as caught:
        op.algebraic_result(wrong, 0.5, op.MooneyRivlin(2.23))
    advice = str(caught.value).split("give mm: ")[1].partition(",")[0]
    right = eval(advice, {"map": wrong, "thickness_map": op.thickness_map})
    xr.testing.assert_allclose(right, given)
    assert list(right.attrs["layer_extent"]) == given.attrs["layer_extent"]
    assert op.algebraic_result(right, 0.5, op.MooneyRivlin(2.23))
    wrong = loaded().assign_coords(x=("x", 1000 * X, {"units": "um"}))
    with pytest.raises(InputError, match="x is in um") as caught:
        op.algebraic_result(wrong, 0.5, op.MooneyRivlin(2.23))
    advice = str(caught.value).split("give mm: ")[1].partition(",")[0]
    right = eval(advice, {"map": wrong, "thickness_map": op.thickness_map})
    np.testing.assert_allclose(right["x"], X)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"material": (2.23, 0.7)}, "material: a law such as MooneyRivlin"),
        ({"window_friction": "0.1"}, "window_friction must be a number"),
        ({"window_friction": True}, "window_friction must be a number"),
        ({"window_friction": np.ones(2)}, "window_friction must be a number"),
        ({"window_friction": None}, "window_friction must be a number"),
        ({"element_size": "fine"}, "element_size must be"),
        ({"imprint_smoothing": "a"}, "imprint_smoothing"),
        ({"threads": "4"}, "threads must be a whole number"),
        ({"loaded": np.ones((3, 3))}, "DataArray, not ndarray"),
        ({"initial_thickness": [0.5]}, "number of mm, or a map"),
        ({"input_errors": {"modulus": 0.1}}, r"input_errors: palpation\.InputErrors or None"),
        ({"progress": "yes"}, "progress: a function"),
    ],
)
def test_errors_of_a_solution_name_the_argument(changes, message):
    given = {
        "loaded": loaded(),
        "initial_thickness": 0.5,
        "material": op.MooneyRivlin(2.23),
        "window_friction": 0.1,
        "sample_friction": 0.1,
        "element_size": 0.25,
    }
    with pytest.raises(InputError, match=message):
        op.computational_stress(**given | changes)


RECTANGLE = op.Region.rectangle("middle", 0.5, 1.5, 0.5, 1.0)


def sample_stress(sample):
    friction = {"window_friction": 0.1, "sample_friction": 0.1}
    return op.sample_stress(
        loaded(), 0.5, op.MooneyRivlin(2.23), sample, **friction, element_size=1
    )


def uncertainty(**changes):
    given = {"window_friction": 0.1, "sample_friction": 0.1, "element_size": 0.25}
    return op.stress_uncertainty(loaded(), 0.5, op.MooneyRivlin(2.23), **given | changes)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: op.MooneyRivlin("2.23"), "c10 = '2.23' is no number"),
        (lambda r: op.MooneyRivlin(None), "c10 = None is no number"),
        (lambda r: op.algebraic_result(loaded(), "0.5", op.MooneyRivlin(2)), "initial thickness: "),
        (lambda r: op.algebraic_result(loaded().astype(str), 0.5, op.MooneyRivlin(2)), "lengths"),
        (lambda r: op.algebraic_result(loaded()[:0], 0.5, op.MooneyRivlin(2)), "0 values"),
        (lambda r: op.clean_thickness(loaded().values), "DataArray, not ndarray"),
        (lambda r: op.find_layer("loaded.oct"), r"volume: an opened volume \(open_volume\)"),
        (lambda r: op.open_volume(None), "path: the name of a file, not None"),
        (lambda r: op.read_result(None), "path: the name of a file, not None"),
        (lambda r: op.read_result("."), "is a folder; a result is a file in it"),
        (lambda r: op.read_thickness_map(3), "path: the name of a file, not int 3"),
        (lambda r: op.read_regions(None, r.maps), "path: the name of a file"),
        (lambda r: op.Study.read(None), "path: the name of a file"),
        (lambda r: op.StressResult(np.zeros(3)), "maps: an xarray.Dataset .* not ndarray"),
        (lambda r: op.StressResult(xr.Dataset()), "maps: .* axial_stress"),
        (lambda r: r.save(None), "path: the name of a file"),
        (lambda r: r.regions(["middle"]), "regions: a list of Region .*, not 'middle'"),
        (lambda r: r.regions(None), "regions: a list of Region .*, not None"),
        (lambda r: r.regions(xr.DataArray(3)), "regions: a list of Region .*, not DataArray"),
        (lambda r: r.plot(["axial_stress"]), "name: that of a map, .* not list"),
        (lambda r: r.profile(((0, 0), (0, 0))), r"same place, \(0, 0\) mm"),
        (lambda r: study(loaded=loaded() * np.nan).run(), "^loaded: all values are missing"),
        (lambda r: study(unloaded=500).run(), "^unloaded.thickness: a layer of 500 mm"),
        (lambda r: op.Region.rectangle("a", "0", 1, 0, 1), "region 'a', x0: a number of mm"),
        (lambda r: op.Region.rectangle("a", 0, 1), "missing .* 'y0'. It needs .*y0: float"),
        (lambda r: op.Region.rectangle("a", x=0, x1=1), "no argument 'x'; did you mean x0"),
        (lambda r: op.Region.rectangle((0, 1), 0, 1, 0, 1), "name: a region is called by a text"),
        (lambda r: op.Region.ellipse("a", 1, (1, 1)), "centre: two numbers"),
        (lambda r: op.Region.ellipse("a", (1, 1), "1"), "semi_axes: two positive numbers"),
        (lambda r: op.Region.ellipse_in_box("a", None), "corners: the four corners"),
        (lambda r: op.Region.polygon("a", "b"), "vertices: a polygon needs at least three"),
        (lambda r: op.Region("a", [(0, 0)]), "outlines: polygons of x and y"),
        (lambda r: op.computational_stress(loaded(), 0.5), "It needs .*material: Law"),
        (lambda r: op.Study(loaded=loaded()), "Study: missing .*'unloaded'"),
        (lambda r: op.find_layer(np.ones((40, 8, 8)), spacing=1, scale="dB"), "spacing: three"),
        (lambda r: op.find_layer(np.ones((40, 8, 8)), window=None), "window: 'line', 'fall'"),
        (lambda r: op.find_layer(np.ones((40, 8, 8)), sample="up"), "sample: 'rise', 'line' or"),
        (lambda r: op.algebraic_result(loaded("um"), 0.5, op.MooneyRivlin(2)), "loaded: map is in"),
        (lambda r: op.algebraic_result(loaded(), 0.5, op.MooneyRivlin(2), glued=0), "glued: True"),
        (lambda r: op.algebraic_result(loaded(), loaded("um"), op.MooneyRivlin(2)),
         "initial thickness: map is in um"),
        (lambda r: op.Sample(1.0, 0.2, 0.1, sze=(3, 3)), "Sample: .*'sze'; did you mean size"),
        (lambda r: op.MooneyRivlin(c1=2.0), "MooneyRivlin: .* did you mean c10"),
        (lambda r: op.Sample(1.0, 0.2, 0.1, law=(1, 2)), "sample: law: a law such as"),
        (lambda r: op.Sample(1.0, 0.2, 0.1, size=3), "sample: size: two positive numbers"),
        (lambda r: r.profile("x", width="wide"), "width: a number of mm"),
        (lambda r: r.plot(ax="axes"), "ax: matplotlib axes, not 'axes'"),
        (lambda r: r.plot(limits=3), "limits: lowest and highest value, .* not int 3"),
        (lambda r: r.plot(limits=(0, -5)), "lowest and highest value, .*, not 0 and -5"),
        (lambda r: r.profile(map="axial_stress"), "profile: there is no argument 'map'"),
        (lambda r: study().run(threads=1), "Study.run: there is no argument 'threads'"),
        (lambda r: op.present.write_maps(r, "b.pdf", 3), "names: that of a map.* not int 3"),
        (lambda r: op.compare_results([r, r]), r"results: maps of results by name"),
        (lambda r: op.compare_results({"a": r, "b": r}), r"results\['a'\]: .* \(\.maps\)"),
        (lambda r: op.sweep(study(), [("friction.window", [0.1])]), "parameters: a mapping"),
        (lambda r: op.sweep(study(), {"friction.window": [0.1]}, workers="2"), "workers: a whole"),
        (lambda r: study().with_("friction.window"), "changes: a mapping"),
        (lambda r: study().with_({3: 4}), "changes: a name such as"),
        (lambda r: study(loaded=loaded().to_dataset(name="t")), "loaded: .*DataArray over y and x"),
        (lambda r: study().with_(fricton=1), "study: there is no table 'fricton'; .*friction"),
        (lambda r: study().with_({"fricton.window": 1}), "no table 'fricton'; did you mean frict"),
        (lambda r: study().with_(windw=1),
         r"no table 'windw'; did you mean volumes\.window or friction\.window\?"),
        (lambda r: study().with_({"c1O": 1}), r"no table 'c1O'; did you mean material\.c10\?"),
        (lambda r: study().with_(zzz=1), "no table 'zzz'; it takes title, .*, material"),
        (lambda r: study(girid=0.2), "no argument 'girid'; did you mean grid"),
        (lambda r: study(title=3), "study: cannot be used:\n  title = 3"),
        (lambda r: sample_stress({"thickness": 1}), "sample: an optical_palpation.Sample"),
        (lambda r: sample_stress(op.Sample("1", 0.2, 0.1)), "sample: thickness must be a number"),
        (lambda r: uncertainty(nominal="r.nc"), "nominal: a StressResult"),
        (lambda r: uncertainty(window_friction_error="a"), "window_friction_error: a number"),
        (lambda r: uncertainty(window_friction_error=0, sample_friction_error=0), "at least one"),
        (lambda r: op.submodel_stress(None, loaded(), 0.5, region=(0, 1, 0, 1), element_size=0.1),
         "coarse: a StressResult"),
        (lambda r: op.present.write_maps("a.nc", "b.pdf"), "result: a StressResult"),
        (lambda r: op.present.write_maps(r, "b.pdf", regions="x.zip"), "regions: a list of Region"),
    ],
)  # fmt: skip
def test_errors_of_everything_else_name_the_argument(call, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short = op.algebraic_result(loaded(), 0.5, op.MooneyRivlin(2.23))
    with pytest.raises(op.OpticalPalpationError, match=message) as caught:
        call(short)
    assert "optical-palpation-" not in str(caught.value)  # a temporary folder
    assert not list(tmp_path.iterdir())


def test_a_sweep_has_the_parameters_as_dimensions(result):
    found = op.sweep(study(), {"friction.window": [0.15, 0.3], "material.c10": [2.23]})
    assert found["axial_stress"].dims == ("friction_window", "material_c10", "y", "x")
    point = {"friction_window": 0.15, "material_c10": 2.23}
    np.testing.assert_array_equal(found["axial_stress"].sel(point), result.maps["axial_stress"])
    assert float(found["window_force"].sel(point)) == result.maps.attrs["window_force_mN"]
    forces = found["sample_force"].values.ravel()
    assert forces[1] > forces[0]
    assert found["friction_window"].attrs["parameter"] == "friction.window"
    assert (found["failure"] == "").all()
    assert float(found["force_error"].sel(point)) == result_columns(result)["force_error_mN"]
    assert str(found["warnings"].sel(point).values) == "; ".join(warnings_about(result))
    assert "sides of the layer" in str(found["warnings"].sel(point).values)
    found.to_netcdf(engine="h5netcdf")  # can be kept


def test_table_summary_and_report_give_the_numbers_of_the_layer():
    gaps = loaded().where((loaded()["x"] > 0.07) & (abs(loaded()["y"] - 0.7) > 0.02))
    within = study(loaded=gaps).with_(
        {"layer.extent": [0.13, 1.87, 0.09, 1.46], "errors.estimates": False}
    )
    found = within.run()
    row, said = result_columns(found), op.present.summarise(found)
    for name in ("mean", "first_percentile", "most_compressed"):
        assert plain(rounded(row[f"algebraic_{name}_axial_stress_kPa"])) in said
    thickness = within.thickness()
    layer = thickness.rename(loaded_thickness="thickness")[["thickness", "filled"]]
    figures = dict(key_figures(found, layer, None))
    assert f"interpolated pixels: {figures['Interpolated pixels, loaded']}" in said
    assert row["interpolated_fraction"] == found.maps.attrs["filled_share"]
    seen = layer["thickness"].sel(x=slice(0.13, 1.87), y=slice(0.09, 1.46))
    assert figures["Loaded thickness, median"] == f"{rounded(seen.median())} mm"
    assert rounded(seen.median()) != rounded(layer["thickness"].median())


def test_points_of_a_sweep_on_other_elements_have_values_up_to_the_border():
    layer = {"layer.extent": [0.13, 1.87, 0.09, 1.46], "errors.estimates": False}
    sizes = [[0.25, 0.2, 0.25], 0.25]
    found = op.sweep(study().with_(layer), {"grid.element_size": sizes})
    assert found["axial_stress"].notnull().all()
    assert found["contact_state"].dtype.kind == "i"
    extents = [[0.13, 1.87, 0.09, 1.46], [0.33, 1.87, 0.09, 1.46]]
    found = op.sweep(study().with_(layer), {"layer.extent": extents})
    beyond = found["x"] < 0.33
    for name in ("axial_stress", "contact_state"):
        gaps = found[name][1].isnull()
        assert (gaps == beyond).all()


@pytest.mark.parametrize("kind", [ConvergenceError, InputError])
def test_a_point_without_a_solution_does_not_lose_the_others(monkeypatch, result, kind):
    solve = python.run_study

    def sometimes(asked, **options):
        if asked.friction.window > 0.2:
            raise kind("loaded to 80 % only")
        return solve(asked, **options)

    monkeypatch.setattr(python, "run_study", sometimes)
    told = []
    found = op.sweep(study(), {"friction.window": [0.15, 0.3]}, progress=told.append)
    assert np.isnan(found["axial_stress"].sel(friction_window=0.3)).all()
    assert "80 %" in str(found["failure"].sel(friction_window=0.3).values)
    np.testing.assert_array_equal(found["axial_stress"][0], result.maps["axial_stress"])
    assert told[0].stage.startswith("1 of 2: ")
    with pytest.raises(kind, match="no point"):
        op.sweep(study(), {"friction.window": [0.3]})


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "name at least one"),
        ({"friction.window": 0.1}, "a list of values"),
        ({"friction.window": []}, "at least one"),
        ({"friction.wind": [0.1]}, "did you mean window"),
        ({"friction.window": [0.1, 5]}, "friction.window"),
        ({"title.text": [0.1]}, "title"),
    ],
)
def test_a_sweep_refuses_what_it_cannot_solve_before_it_solves(parameters, message, monkeypatch):
    monkeypatch.setattr(python, "run_study", None)
    with pytest.raises(InputError, match=message):
        op.sweep(study(), parameters)
    with pytest.raises(InputError, match=r"study: an optical_palpation\.Study"):
        op.sweep("study.toml", {"friction.window": [0.1]})


def force_of(window):
    return study().with_(friction={"window": window}).run().maps.attrs["window_force_mN"]


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
def test_a_pool_after_a_solution_does_not_hang():
    """In a process of its own, since a hang is what is looked for."""
    code = (
        "import multiprocessing, test_python\n"
        "before = test_python.force_of(0.15)\n"
        "with multiprocessing.get_context('fork').Pool(2) as pool:\n"
        "    after = pool.map(test_python.force_of, [0.15, 0.15])\n"
        "assert after == [before, before], (after, before)\n"
    )
    folder = Path(__file__).parent
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=300)
