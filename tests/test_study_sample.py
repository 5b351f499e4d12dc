"""A study that gives the sample: found stiffness, what it depends on, and what is refused."""

import json
import re

import numpy as np
import pytest
import tifffile
import xarray as xr
from scipy.io import loadmat

import optical_palpation as op
from optical_palpation.analysis import region_statistics
from optical_palpation.errors import InputError, MaterialError
from optical_palpation.experiment import Scene, run_experiment
from optical_palpation.material import Yeoh
from optical_palpation.palpation import StressResult
from optical_palpation.palpation.plausibility import SOFT_SAMPLE
from optical_palpation.present import read_result, summarise, write_profiles, write_tiff
from optical_palpation.present.figure import new_figure
from optical_palpation.present.panel import draw_panel, panel_height
from optical_palpation.present.report import write_report
from optical_palpation.present.report.content import key_figures
from optical_palpation.present.summary import INPUTS
from optical_palpation.present.tables import result_columns
from optical_palpation.stiffness.maps import SAMPLE_MAPS
from optical_palpation.study import describe_inputs, read_study, run_study
from optical_palpation.study.inputs import facts, parameters
from optical_palpation.study.run import check_study
from optical_palpation.study.script import reproducing_lines
from optical_palpation.study.stages import Stages
from optical_palpation.thickness import thickness_map, write_thickness_map

SAMPLE = """
[sample]
thickness = 1.0
compression = 0.25
plate_friction = 0.3
"""
EARLIER = """
[[sample.earlier]]
map = "before.nc"
compression = 0.15
"""
STUDY = """
[loaded]
map = "loaded.nc"
[unloaded]
thickness = 0.5
[material]
c10 = 2.23
c01 = 0.703
[friction]
window = 0.3
sample = 0.3
[grid]
element_size = 0.25
threads = 1
"""
MODULUS = 6 * (2.23 + 0.703)


def heights(size=3.0):
    x = np.linspace(0.0, size, 31)
    values = 0.02 * np.cos(2 * np.pi * x)[None] * np.cos(x)[:, None]
    return xr.DataArray(values, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})


def write_heights(field, path):
    field.to_dataset(name="height").to_netcdf(path, engine="h5netcdf")


def experiment(compression):
    """The loaded thickness of a virtual experiment: noisy, and with a gap."""
    scene = Scene.model_validate(
        {
            "compression": compression,
            "layer": {"size": (3.0, 3.0), "thickness": 0.5},
            "sample": {"size": (3.0, 3.0), "thickness": 1.0},
            "friction": {"window": 0.3, "sample": 0.3, "plate": 0.3},
            "mesh": {"element_size": 0.3},
            "pixel_spacing": 0.06,
        }
    )
    maps = run_experiment(scene).maps
    values = maps["loaded_thickness"].values
    values = values + 1e-3 * np.random.default_rng(0).normal(size=values.shape)
    middle = values.shape[0] // 2
    values[middle - 2 : middle + 2, middle - 8 : middle - 4] = np.nan
    measured = thickness_map(
        values, x=maps["x"].values, y=maps["y"].values, layer_extent=(0.0, 3.0, 0.0, 3.0)
    )
    return measured.rename("thickness")


@pytest.fixture(scope="session")
def pressed(tmp_path_factory):
    """A folder with the loaded thickness of a virtual experiment."""
    folder = tmp_path_factory.mktemp("sample")
    write_thickness_map(experiment(0.25), folder / "loaded.nc")
    write_heights(heights(), folder / "relief.nc")
    return folder


@pytest.fixture(scope="session")
def finished(pressed):
    (pressed / "study.toml").write_text(STUDY + SAMPLE)
    return run_study(read_study(pressed / "study.toml")).folder


@pytest.fixture
def given(pressed):
    """Read a study of the same maps with other text."""

    def read(old="", new="", sample=SAMPLE):
        text = STUDY + sample
        assert old in text
        path = pressed / "other.toml"
        path.write_text(text.replace(old, new) if old else text)
        return read_study(path)

    return read


@pytest.mark.slow
def test_stiffness_is_found_and_the_file_says_everything(finished):
    maps = read_result(finished / "stress.nc").maps
    modulus = maps["sample_youngs_modulus"]
    inside = {axis: slice(0.5, 2.5) for axis in "xy"}
    assert float(modulus.sel(inside).median()) == pytest.approx(MODULUS, rel=0.15)
    for name in SAMPLE_MAPS:
        assert maps[name].attrs["units"] in ("kPa", "mm", "1")
        assert maps[name].attrs["long_name"]
    attrs = maps.attrs
    assert attrs["compression_mm"] == 0.25
    assert attrs["plate_friction"] == 0.3
    assert attrs["input"] == "loaded.nc"
    assert {"stress.nc", "stress.png", "report.html", "layer.vts"} <= {
        path.name for path in finished.iterdir()
    }
    record = json.loads((finished / "provenance.json").read_text())
    assert record["parameters"]["sample"]["plate_friction"] == 0.3
    assert record["complete"]


def test_what_was_filled_is_not_taken_as_measured(finished):
    """The gap is filled for the thickness map, and the algebraic method says nothing there."""
    maps = read_result(finished / "stress.nc").maps
    gap = maps["filled"].sel(x=slice(0.5, 2.5), y=slice(0.5, 2.5))
    assert bool(gap.any())
    assert maps["axial_stress"].sel(x=slice(0.5, 2.5), y=slice(0.5, 2.5)).notnull().all()
    assert maps["algebraic_axial_stress"].where(gap).isnull().all()


def test_python_lines_give_the_same(finished, monkeypatch):
    monkeypatch.chdir(finished.parent)
    names = {}
    exec(reproducing_lines(read_study("study.toml")), names)
    of_file, again = read_result(finished / "stress.nc").maps, names["result"].maps
    for name in ("axial_stress", "sample_youngs_modulus"):
        np.testing.assert_allclose(of_file[name], again[name], rtol=1e-9)


def stress_stage(study):
    inputs = {side: facts(study, source) for side, source in study.inputs.items()}
    return {stage.file: stage for stage in Stages(study).plan(inputs)}["stress.nc"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("thickness = 1.0", "thickness = 1.1"),
        ("compression = 0.25", "compression = 0.26"),
        ("compression = 0.25", "total_force = 90.0"),
        ("plate_friction = 0.3", "plate_friction = 0.2"),
        ("[sample]", "[sample]\nrelief = 'relief.nc'"),
        ("[sample]", "[sample]\nsize = [4.0, 3.0]"),
        ("[sample]", "[sample]\nlaw = 'layer'"),
        ("[sample]", "[sample]\nstiffness_smoothing = 0.1"),
    ],
)
def test_stress_depends_on_every_key_of_the_sample(given, old, new):
    before, after = stress_stage(given()), stress_stage(given(old, new))
    assert before.facts != after.facts
    assert "stiffness" in after.code


def test_stress_depends_on_what_the_relief_is_and_not_on_its_name(given, pressed):
    study = given("[sample]", "[sample]\nrelief = 'relief.nc'")
    before = stress_stage(study)
    write_heights(heights(), pressed / "same.nc")
    same = stress_stage(given("[sample]", "[sample]\nrelief = 'same.nc'"))
    assert same.facts == before.facts
    write_heights(0.5 * heights(), pressed / "relief.nc")
    after = stress_stage(study)
    write_heights(heights(), pressed / "relief.nc")
    assert after.facts != before.facts


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("thickness = 1.0", "thickness = -1.0", ["sample.thickness = -1.0 (mm)", "greater than 0"]),
        ("thickness = 1.0", "", ["thickness (mm): missing", "as compression says"]),
        ("compression = 0.25", "", ["compression (mm, or total_force, mN): missing"]),
        ("plate_friction = 0.3", "plate_friction = 3.0", ["sample.plate_friction", "less than"]),
        ("compression", "compresion", ["did you mean compression?"]),
        ("[sample]", "[sample]\nmotion = 0.1", ["motion and thickness exclude each other"]),
        ("[sample]", "[sample]\nrelief = 'lost.nc'", ["sample.relief", "there is no"]),
        ("[sample]", "[sample]\nsize = [3.0]", ["sample.size", "mm, x and y"]),
        ("[sample]", "[sample]\nlaw = 'yeoh'", ["sample.law", "'neo-hookean' or 'layer'"]),
        ("[sample]", "[sample]\nlaw = { law = 'yeoh' }", ["sample.law.c10: is missing (kPa)"]),
        ("[sample]", "[sample]\nstiffness_smoothing = 0", ["about 0.001", "greater than 0"]),
        ("threads = 1", "edges = 'padded'", ['grid.edges = "padded"', "free"]),
        ("threads = 1", "imprint_smoothing = 0.1", ["grid.imprint_smoothing", "no imprint"]),
        ("threads = 1", "solver = 'direct'", ['grid.solver = "direct"']),
        ("element_size = 0.25", "element_size = [0.2, 0.2, 0.1]", ["element_size of three"]),
        ("element_size = 0.25", "accuracy = 0.1", ["grid.accuracy"]),
        ("window = 0.3", "window = 'glued'", ['friction.window = "glued"', "slip"]),
        ("sample = 0.3", "sample = 0.3\nslip_length = 0.001", ["friction.slip_length"]),
        ("[sample]", "[errors]\ncompression = 1.5\n[sample]", ["errors.compression", "less"]),
    ],
)
def test_samples_that_cannot_be_used_are_refused_on_reading(given, old, new, words):
    with pytest.raises(InputError) as error:
        given(old, new)
    for word in ["other.toml", *words]:
        assert word in str(error.value)


def test_errors_of_a_study_with_a_sample_are_its_own(given, run):
    given()
    status, out, err = run("uncertainty", given().file)
    assert (status, out) == (2, "")
    assert "carries its errors already" in err


def test_an_unstable_law_is_refused(given):
    with pytest.raises(MaterialError, match=r"sample\.law: unstable"):
        given("[sample]", "[sample]\nlaw = { c10 = -1.0 }")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("compression = 0.25", "compression = 1.6", "more than layer and sample together"),
        ("compression = 0.25", "compression = 0.02", "plate cannot have moved less"),
        ("thickness = 1.0", "thickness = 2000.0", "divide by 1000 if it is in um"),
        ("thickness = 0.5", "thickness = 0.3", "nowhere thinner|nothing is pressed"),
        ("[sample]", "[sample]\nsize = [3000.0, 3000.0]", "size: the field of view"),
        ("element_size = 0.25", "element_size = 0.4", "larger than an eighth of the smaller"),
        ("[sample]", "[sample]\nsize = [3.0, 1.9]", "along y, 0.2375 mm"),
        ("[sample]", "[sample]\nrelief = 'narrow.nc'", "the relief spans x 0 to 2 mm"),
        ("[sample]", "[sample]\nrelief = 'gap.nc'", "the relief has 3 missing values"),
        ("[sample]", "[sample]\nrelief = 'high.nc'", "relief is 4 mm from its lowest"),
        ("[sample]", "[sample]\nrelief = 'damaged.nc'", "damaged.nc"),
    ],
)
def test_check_refuses_a_sample_that_does_not_fit_to_the_maps(given, pressed, old, new, match):
    write_heights(heights(2.0), pressed / "narrow.nc")
    gap = heights()
    gap[3, 3:6] = np.nan
    write_heights(gap, pressed / "gap.nc")
    write_heights(100 * heights(), pressed / "high.nc")
    (pressed / "damaged.nc").write_bytes(b"CDF damaged")
    study = given(old, new)
    with pytest.raises(InputError, match=match) as error:
        describe_inputs(study)
    assert "other.toml" in str(error.value)
    assert not study.folder.exists()


@pytest.fixture(scope="session")
def before(pressed):
    """The map of a smaller load of the same sample, beside that of the full one."""
    write_thickness_map(experiment(0.15), pressed / "before.nc")
    return pressed / "before.nc"


@pytest.mark.slow
def test_a_series_of_loads_in_a_study(pressed, before):
    """Found are the relief, which is flat, the stiffness and the force at both loads."""
    (pressed / "series.toml").write_text(STUDY + SAMPLE + EARLIER)
    folder = run_study(read_study(pressed / "series.toml")).folder
    result = read_result(folder / "stress.nc")
    maps, inside = result.maps, {axis: slice(0.5, 2.5) for axis in "xy"}
    modulus = maps["sample_youngs_modulus"].sel(inside)
    assert float(modulus.median()) == pytest.approx(MODULUS, rel=0.2)
    assert float(maps["sample_relief"].sel(inside).std()) < 0.01
    np.testing.assert_array_equal(result.series["compression"], [0.15, 0.25])
    assert json.loads(maps.attrs["earlier_source"]) == ["before.nc"]
    assert "relief of the unloaded sample" in (folder / "report.html").read_text().lower()
    record = json.loads((folder / "provenance.json").read_text())
    assert record["inputs"]["sample-earlier-1"]["map"] == "before.nc"
    lines = reproducing_lines(read_study(pressed / "series.toml"))
    assert "compression=[0.15, 0.25]" in lines


def test_a_total_force_in_a_study(finished, pressed):
    """That of the study with the travel leads back to the travel and to the same stress."""
    known = read_result(finished / "stress.nc").maps
    force = known.attrs["window_force_mN"]
    text = STUDY + SAMPLE.replace("compression = 0.25", f"total_force = {force:.3f}")
    (pressed / "force.toml").write_text(text + "[outputs]\nwrite = []\n")
    folder = run_study(read_study(pressed / "force.toml")).folder
    maps = read_result(folder / "stress.nc").maps
    assert maps.attrs["window_force_mN"] == pytest.approx(force, rel=0.02)
    assert abs(maps.attrs["compression_mm"] - 0.25) < maps.attrs["compression_error_mm"]
    inside = {axis: slice(0.5, 2.5) for axis in "xy"}
    off = maps["axial_stress"].sel(inside) - known["axial_stress"].sel(inside)
    assert float(np.abs(off).mean()) < 0.05 * float(np.abs(known["axial_stress"]).mean())


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("before.nc", "lost.nc", ["sample.earlier[1].map", "there is no"]),
        ("compression = 0.15", "", ["compression: given for some of the 2 loads"]),
        ("compression = 0.15", "compression = -0.15", ["compression", "greater than 0"]),
        ("map =", "file =", ["earlier", "map"]),
    ],
)
def test_earlier_loads_that_cannot_be_used_are_refused(given, before, old, new, words):
    with pytest.raises(InputError) as error:
        given(old, new, SAMPLE + EARLIER)
    for word in words:
        assert word in str(error.value)


def test_stress_depends_on_the_earlier_loads(given, before, pressed):
    alone, study = given(), given(sample=SAMPLE + EARLIER)
    facts_of_it = stress_stage(study).facts
    assert facts_of_it != stress_stage(alone).facts
    assert stress_stage(given("0.15", "0.16", SAMPLE + EARLIER)).facts != facts_of_it
    (pressed / "same.nc").write_bytes(before.read_bytes())
    same = given("before.nc", "same.nc", SAMPLE + EARLIER)
    assert stress_stage(same).facts == facts_of_it
    with pytest.raises(InputError, match=r"must rise from map to map"):
        describe_inputs(given("0.15", "0.26", SAMPLE + EARLIER))


def test_the_record_has_no_errors_of_inputs_that_are_not_used(given):
    assert parameters(given())["errors"]["compression"] == 0.05
    alone = given(sample="")
    assert set(parameters(alone)["errors"]) == {
        "estimates",
        "window_friction",
        "sample_friction",
        "modulus",
        "thickness",
        "initial_thickness",
    }
    with pytest.raises(InputError, match="compression: only with the sample in the model"):
        given(sample="[errors]\ncompression = 0.02")


def test_the_stress_depends_on_the_errors_of_the_inputs(given):
    other = "[errors]\nsample_thickness = 0.01\n[sample]"
    study = given("[sample]", other)
    assert stress_stage(study).facts != stress_stage(given()).facts
    lines = reproducing_lines(study)
    assert "errors = palpation.InputErrors(sample_thickness=0.01)" in lines
    assert "input_errors=errors" in lines


def test_without_estimates_the_errors_of_the_inputs_do_not_matter(given):
    bare, other = (
        given("[sample]", f"[errors]\nestimates = false\nmodulus = {error}\n[sample]")
        for error in (0.01, 0.02)
    )
    assert stress_stage(bare).facts == stress_stage(other).facts != stress_stage(given()).facts
    assert parameters(bare)["errors"] == {"estimates": False}
    assert "input_errors=None" in reproducing_lines(bare)


def test_check_takes_what_can_be_used(given):
    study = given("[sample]", "[sample]\nrelief = 'relief.nc'\nlaw = 'layer'\nsize = [4.0, 4.0]")
    assert "loaded map" in describe_inputs(study)
    assert "relief=relief" in reproducing_lines(study)
    check_study(study, {})


def test_a_study_in_python_takes_a_sample(pressed, tmp_path):
    sample = op.Sample(1.0, 0.25, 0.3, relief=heights(), size=(3.0, 2.0), law=Yeoh(2.0, 1.0))
    study = op.Study(
        loaded={"map": str(pressed / "loaded.nc")},
        unloaded=0.5,
        material=op.MooneyRivlin(2.23, 0.703),
        friction={"window": 0.3, "sample": 0.3},
        grid=0.25,
        sample=sample,
    )
    told = study.parameters["sample"]
    assert (told["thickness"], told["compression"], told["plate_friction"]) == (1.0, 0.25, 0.3)
    assert told["law"]["c20"] == 1.0
    saved = study.save(tmp_path / "study.toml")
    assert saved.parameters["sample"]["size"] == [3.0, 2.0]
    assert 'relief = "study-relief.nc"' in (tmp_path / "study.toml").read_text()
    assert (tmp_path / "study-relief.nc").is_file()
    assert "loaded map" in describe_inputs(read_study(tmp_path / "study.toml"))
    thicker = study.with_(sample={"thickness": 1.2})
    assert thicker.parameters["sample"]["compression"] == 0.25
    assert thicker.parameters["sample"]["thickness"] == 1.2
    with pytest.raises(InputError, match=r"sample\.thickness = -1"):
        study.with_(sample={"thickness": -1})


def test_a_series_in_python(pressed, before, tmp_path):
    loads = [{"map": str(before), "compression": 0.15}]
    sample = {"thickness": 1.0, "compression": 0.25, "plate_friction": 0.3, "earlier": loads}
    tables = {
        "loaded": {"map": str(pressed / "loaded.nc")},
        "unloaded": 0.5,
        "material": op.MooneyRivlin(2.23, 0.703),
        "friction": {"window": 0.3, "sample": 0.3},
        "grid": 0.25,
    }
    study = op.Study(sample=sample, **tables)
    saved = study.save(tmp_path / "study.toml")
    assert saved.parameters["sample"]["earlier"][0]["map"] == str(before)
    loads[0]["map"] = xr.load_dataset(before, engine="h5netcdf")["thickness"]
    op.Study(sample=sample, **tables).save(tmp_path / "other.toml")
    assert 'map = "other-earlier-1.nc"' in (tmp_path / "other.toml").read_text()
    assert "loaded map" in describe_inputs(read_study(tmp_path / "other.toml"))
    one = op.Study(sample=op.Sample(1.0, [0.25], 0.3), **tables)
    assert one.parameters["sample"]["compression"] == 0.25
    with pytest.raises(InputError, match=r'give a mapping.*"earlier"'):
        op.Study(sample=op.Sample(1.0, (0.15, 0.25), 0.3), **tables)


def titles(maps):
    with new_figure("double", panel_height(maps)) as figure:
        draw_panel(maps, figure)
        return {axes.get_title("left"): axes for axes in figure.axes}


def as_rigid(maps):
    """The same maps as of a sample of whose stiffness nothing can be told."""
    names = [name for name in SAMPLE_MAPS if not name.startswith("sample_displacement")]
    known = ("error_bands", "inversion", "misfit_over_tolerance", "force_error_mN")
    rigid = maps.assign({name: maps[name] * np.nan for name in names})
    rigid.attrs = {k: v for k, v in maps.attrs.items() if k not in known} | {"sample_rigid": "yes"}
    return rigid


def test_the_picture_has_the_modulus_where_there_is_one(finished):
    maps = read_result(finished / "stress.nc").maps
    unknown = (maps["x"] < 0.5) & (maps["y"] < 0.5)
    maps["sample_youngs_modulus"] = maps["sample_youngs_modulus"].where(~unknown)
    drawn = titles(maps)
    assert "95 % band of the axial stress, \u00b1 (kPa)" in drawn
    shown = drawn["Young's modulus of the sample (kPa)"].collections[0].get_array()
    masked = np.ma.getmaskarray(np.ma.masked_invalid(shown)).reshape(unknown.shape)
    np.testing.assert_array_equal(masked, maps["sample_youngs_modulus"].isnull())
    assert masked.any()
    assert not any("modulus" in title for title in titles(as_rigid(maps)))


def page_data(path):
    text = path.read_text(encoding="utf-8").replace("\u00a0", " ")
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    return text, json.loads(found[1])


def test_summary_and_report_round_alike_what_was_found_of_the_sample(finished):
    result = read_result(finished / "stress.nc")
    known = {"thickness": {"half_width": 0.002}, "initial_thickness": {"half_width": 0.004}}
    result.maps.attrs["error_bands"] = json.dumps(known)
    figures = dict(key_figures(result, None, None))
    assert figures["Loaded thickness, median"].endswith(" \u00b1 0.0020 mm")
    assert figures["Unloaded thickness, mean"].endswith(" \u00b1 0.0040 mm")
    modulus = figures["Young's modulus of the sample, median"]
    assert " \u00b1 " in modulus
    assert f"Young's modulus of the sample: median {modulus}" in summarise(result)


def test_bands_that_leave_the_inputs_out_are_told(finished):
    """They are a part of the error, and no error in a table."""
    result = read_result(finished / "stress.nc")
    alone = "Force on the sample, 95 % band, \u00b1 by the noise and mesh alone"
    assert "force_error_mN" in result_columns(result)
    assert "alone" not in summarise(result)
    assert alone not in dict(key_figures(result, None, None))
    result.maps.attrs["error_bands"] = "{}"
    assert not any("error" in name for name in result_columns(result))
    assert "kPa (median), of noise and mesh alone" in summarise(result)
    assert alone in dict(key_figures(result, None, None))


def test_the_report_has_layers_numbers_and_parameters(finished):
    text, data = page_data(finished / "report.html")
    shown = {key: (entry["title"], entry["scale"]) for key, entry in data["maps"].items()}
    assert shown["sample_youngs_modulus"][0] == "Young's modulus of the sample"
    assert shown["sample_modulus_error"][0] == "95 % band of the modulus, \u00b1"
    assert shown["axial_stress_error"][0] == "95 % band of the axial stress, \u00b1"
    assert shown["thickness_misfit"][0] == "Computed less measured thickness"
    assert set(shown) <= set(data["stage"])
    assert data["scales"]["modulus"]["units"] == "kPa"
    maps = read_result(finished / "stress.nc").maps
    figures = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))
    force = figures["Force on the sample, 95 % band"].split(" \u00b1 ")
    assert float(force[0]) == pytest.approx(maps.attrs["sample_force_mN"], rel=0.1)
    assert float(force[1].removesuffix(" mN")) == pytest.approx(
        maps.attrs["force_error_mN"], rel=0.06
    )
    modulus = figures["Young&#39;s modulus of the sample, median"]
    assert modulus.endswith("kPa")
    assert figures["Forward solutions"] == str(maps.attrs["forward_solutions"])
    for row in ('<th scope="row">compression</th><td>0.25 mm', "<td>0.3 (coefficient)"):
        assert row in text
    for name in json.loads(maps.attrs["error_bands"]):
        assert f'<th scope="row">{INPUTS[name]}</th>' in text
    assert "taken not to move sideways" not in text


def test_a_rigid_sample_and_an_unknown_one_are_said_in_the_report(finished, tmp_path):
    result = read_result(finished / "stress.nc")
    texts = {"parameters": {}, "python": "", "title": "Study", "warnings": []}
    nothing = {"loaded": None, "unloaded": None, "volumes": None}
    rigid = StressResult(as_rigid(result.maps), result.layer)
    write_report(tmp_path / "rigid.html", rigid, **nothing, **texts)
    text, data = page_data(tmp_path / "rigid.html")
    assert "as good as rigid" in text
    assert "is taken not to move sideways" not in text
    assert not {"sample_youngs_modulus", "thickness_misfit"} & set(data["maps"])
    alone = StressResult(as_rigid(result.maps).drop_vars(list(SAMPLE_MAPS)), result.layer)
    del alone.maps.attrs["sample_rigid"]
    write_report(tmp_path / "alone.html", alone, **nothing, **texts)
    page = re.sub("</?span[^>]*>", "", page_data(tmp_path / "alone.html")[0])
    assert f"<summary>{SOFT_SAMPLE[0].upper()}{SOFT_SAMPLE[1:]}</summary>" in page
    alone.maps.attrs["sample_motion_largest_mm"] = 0.1
    write_report(tmp_path / "moved.html", alone, **nothing, **texts)
    assert "is taken not to move sideways" in SOFT_SAMPLE
    assert "is taken not to move sideways" not in page_data(tmp_path / "moved.html")[0]


def test_other_formats_and_regions_have_the_modulus(finished, tmp_path):
    result = read_result(finished / "stress.nc")
    result.save(tmp_path / "a.mat")
    content = loadmat(tmp_path / "a.mat", squeeze_me=True, struct_as_record=False)
    np.testing.assert_array_equal(
        content["sample_youngs_modulus"], result.maps["sample_youngs_modulus"]
    )
    assert content["units"].sample_youngs_modulus == "kPa"
    write_tiff(result, tmp_path / "a.tif", ["sample_youngs_modulus"])
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert "Young's modulus of the sample (kPa)" in str(file.imagej_metadata["Labels"])
    write_profiles(result, tmp_path / "a.csv")
    assert "sample_youngs_modulus_kPa" in (tmp_path / "a.csv").read_text()
    region = op.Region.rectangle("middle", 1.0, 2.0, 1.0, 2.0)
    found = region_statistics(result.maps, [region], "sample_youngs_modulus")
    inside = result.maps["sample_youngs_modulus"].sel(x=slice(1, 2), y=slice(1, 2))
    assert float(found["mean"][0]) == pytest.approx(float(inside.mean()), rel=0.05)
