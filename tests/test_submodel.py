"""A part of a layer on finer elements, held at its sides by the solution of the whole."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from optical_palpation.errors import InputError
from optical_palpation.mechanics.direct import DirectSolver, sparse_matrix
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.newton import balance
from optical_palpation.mechanics.problem import LayerState
from optical_palpation.mechanics.submodel import part_of
from optical_palpation.mechanics.system import assemble
from optical_palpation.palpation import algebraic_result, submodel_stress
from optical_palpation.palpation.submodel import settings_of
from optical_palpation.present import read_result, summarise
from optical_palpation.present.report.content import force_rows
from optical_palpation.present.terms import percent, plain
from submodel_case import GEL, SIZE, THICKNESS, error, relief, whole


@pytest.fixture(scope="module")
def coarse():
    return whole(0.1)


@pytest.fixture(scope="module")
def fine():
    return whole(0.05)


@pytest.mark.parametrize("region", [(0.8, 1.4, 1.0, 1.5), (0.0, 0.5, 1.9, 2.4)])
def test_a_region_is_that_of_the_whole_on_fine_elements(coarse, fine, region):
    """In the middle, and in a corner, where two sides are the layer's own."""
    part = submodel_stress(coarse, relief(), THICKNESS, region, element_size=0.05)
    x, y = part.maps["x"], part.maps["y"]
    assert_allclose([x[0], x[-1], y[0], y[-1]], region)
    off = error(part, fine)
    assert off < 0.025
    assert off < 0.25 * error(replace(coarse, maps=coarse.maps.interp(x=x, y=y)), fine)
    assert 0.2 * off < part.maps.attrs["submodel_sides_error"] < 0.05
    assert part.problem.grid.n_elements < 0.4 * fine.problem.grid.n_elements
    expected = fine.maps["contact_pressure"].interp(x=x, y=y).integrate(["x", "y"])
    assert part.maps.attrs["sample_force_mN"] == pytest.approx(float(expected), rel=0.025)
    for key in ("window_friction", "sample_friction", "c10_kPa", "slip_length_mm", "edges"):
        assert part.maps.attrs[key] == fine.maps.attrs[key]


def test_a_better_solution_of_the_whole_makes_a_better_part(fine):
    """The more so with a margin, over which its errors of shear fade."""
    region = 0.8, 1.4, 1.0, 1.5
    near, far = (
        submodel_stress(whole(size), relief(), THICKNESS, region, element_size=0.05, margin=0.4)
        for size in (0.12, 0.07)
    )
    assert error(far, fine) < 0.75 * error(near, fine)


def test_uniform_stress_goes_through_cut_sides_unchanged():
    flat = relief(0.0)
    solved = whole(0.2, 0.0, 0.0, flat)
    part = submodel_stress(
        solved, flat, THICKNESS, (0.9, 1.5, 0.8, 1.6), element_size=0.05, imprint_smoothing=0.0
    )
    expected = float(solved.maps["axial_stress"].mean())
    assert_allclose(part.maps["axial_stress"], expected, rtol=1e-4)
    assert_allclose(part.maps["algebraic_axial_stress"], expected, rtol=2e-3)
    assert part.maps.attrs["submodel_sides_error"] < 1e-4


def test_a_region_is_filled_by_what_has_moved_there():
    """A layer that slides: its border moves by one and a half thicknesses."""
    x = np.linspace(0, 6, 61)
    flat = xr.DataArray(np.full((61, 61), 0.28), {"y": x, "x": x}, ("y", "x"))
    flat.attrs["units"] = "mm"
    solved = whole(0.2, 0.005, 0.005, flat)
    for region in ((4.6, 5.6, 2.0, 3.0), (0.0, 1.0, 5.0, 6.0)):
        part = submodel_stress(solved, flat, THICKNESS, region, element_size=0.1)
        assert not part.maps["axial_stress"].isnull().any()
        assert error(part, solved) < 0.01


def test_a_part_under_a_pressure_of_many_shear_moduli():
    """In the middle of a layer 20 thicknesses wide; a dead load would fold its sides."""
    x = np.linspace(0, 8, 161)
    wave = np.sin(7 * x) * np.cos(6 * x)[:, None] + 0.5 * np.cos(11 * x)
    wide = xr.DataArray(0.34 + 0.01 * wave, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})
    solved = whole(0.2, 0.2, 0.2, wide)
    part = submodel_stress(solved, wide, THICKNESS, (3.5, 4.5, 3.6, 4.4), element_size=0.1)
    assert -float(part.maps["axial_stress"].mean()) > 20 * GEL.shear_modulus
    assert part.maps.attrs["submodel_change"] < 0.05


def test_a_glued_layer_that_is_pulled():
    loaded = relief() + 0.04
    solved, reference = (whole(s, "glued", "glued", loaded) for s in (0.1, 0.05))
    part = submodel_stress(solved, loaded, THICKNESS, (0.8, 1.4, 1.0, 1.5), element_size=0.05)
    assert float(part.maps["contact_pressure"].min()) < 0
    assert error(part, reference) < 0.03
    assert part.maps.attrs["sample_contact"] == "glued"


def test_the_matrix_is_the_derivative_of_the_equations(coarse):
    problem, state = coarse.problem, coarse.state
    part = part_of(problem, problem, state, (0.8, 1.4, 1.0, 1.5))
    assert part.own_sides == (False, False, False, False)
    moved = nudged(part, problem, state)
    rng = np.random.default_rng(0)
    now = balance(part, moved)
    system = assemble(part, now, DirectSolver(part.grid.node_shape, 0.0))
    du = np.where(system.free, rng.standard_normal(moved.u.shape), 0.0)
    residuals = []
    for sign in (1, -1):
        other = moved.copy()
        other.u += sign * 1e-7 * system.to_cartesian(du)
        residuals.append(balance(part, other).residual(part))
    expected = (residuals[0] - residuals[1]) / 2e-7
    product = (sparse_matrix(system.stencil, system.free) @ du.ravel()).reshape(du.shape)
    assert abs(product - expected)[:, 1:-1].max() < 1e-6 * abs(expected).max()
    sides = np.array([part.grid.x[-1] - part.grid.x[0], part.grid.y[-1] - part.grid.y[0]])
    area = 2 * sides.sum() * part.imprint.loaded.mean()
    expected_stiffness = area * part.surroundings.stiffness
    assert part.border.stiffness.sum() == pytest.approx(expected_stiffness, rel=0.1)


@pytest.mark.parametrize("waves", [1, 6])
def test_a_cut_side_resists_a_wave_by_its_springs_and_its_membrane(waves):
    """The energy of springs k and a membrane T, of a wave across one side of an unloaded part."""
    problem = whole(0.2, 0.0, 0.0, relief(0.0)).problem
    rest = LayerState.unloaded(problem.grid)
    grid = LayerGrid(
        problem.grid.x, np.linspace(0, SIZE, 97), problem.grid.depth, np.full((97, 13), THICKNESS)
    )
    part = part_of(problem.on_grid(grid, problem.imprint), problem, rest, (0.8, 1.6, 0.4, 2.0))
    part_grid = part.grid
    y = part_grid.y - part_grid.y[0]
    length = y[-1]
    u = np.zeros((3, *part_grid.node_shape))
    force = np.zeros_like(u)
    number = np.pi * waves / length
    u[0, :, :, 0] = 1e-3 * np.cos(number * y)
    part.border.add_resistance(u, force)
    side = part.border.sides[[s.nodes[2].max() for s in part.border.sides].index(0)]
    assert side.nodes[0].shape == part_grid.node_shape[:2]
    springs = part.surroundings.stiffness + part.surroundings.tension * number**2
    expected = springs * 0.5 * 1e-6 * length * THICKNESS
    # cut sides across y are held at their two edges too, which this wave moves
    along = part_grid.spacing[2]
    expected += (
        2
        * 1e-6
        * THICKNESS
        * (part.surroundings.stiffness * along / 2 + part.surroundings.tension / along)
    )
    assert (u * force).sum() == pytest.approx(expected, rel=0.02)


def nudged(part, problem, state):
    """The state of the whole on the nodes of a part, nudged."""
    from optical_palpation.mechanics.cascade import prolong

    moved = prolong(state, problem, part)
    moved.u += 1e-3 * np.random.default_rng(1).standard_normal(moved.u.shape)
    return moved


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"region": (1.0, 0.5, 1.0, 1.5)}, "x0 < x1"),
        ({"region": (1.0, 2.5, 1.0, 1.5)}, "beyond the layer"),
        ({"region": (1.0, 1.5)}, "x0, x1, y0, y1"),
        ({"element_size": 0.1}, "no smaller than those of the coarse"),
        ({"margin": 0.01}, "at least .* four elements"),
        (
            {"loaded": relief().assign_attrs(layer_extent=[0.1, 2.3, 0.0, 2.4])},
            "x 0.1 to 2.3, y 0 to 2.4 mm, that of the coarse solution x 0 to 2.4",
        ),
        ({"loaded": relief()[::2, ::2]}, "the map that it was computed from"),
        ({"loaded": relief() + 1e-3}, "the loaded thickness differs by up to 0.001 mm"),
        ({"initial_thickness": THICKNESS - 0.01}, "the initial thickness differs by up to 0.01 mm"),
    ],
)
def test_what_cannot_be_used(coarse, change, message):
    given = {
        "region": (1.0, 1.5, 1.0, 1.5),
        "element_size": 0.05,
        "loaded": relief(),
        "initial_thickness": THICKNESS,
    }
    with pytest.raises(InputError, match=message):
        submodel_stress(coarse, **given | change)


def test_what_a_part_takes_over_of_the_pressure_is_told():
    """The mesh of a layer that sticks makes its pressure too high all over."""
    wave = relief()
    solved, reference = (whole(s, 0.8, 0.8, edges="padded", loaded=wave) for s in (0.2, 0.1))
    part = submodel_stress(solved, wave, THICKNESS, (0.8, 1.6, 0.8, 1.6), element_size=0.1)
    attrs, off = part.maps.attrs, error(part, reference)
    assert attrs["submodel_sides_error"] < 0.5 * off
    assert off < attrs["submodel_sides_error"] + attrs["submodel_coarse_force_error"]
    assert f"everywhere for up to {percent(attrs['submodel_coarse_force_error'])}" in summarise(
        part
    )
    unknown = dict(solved.maps.attrs)
    del unknown["force_mesh_error_mN"]
    assert "submodel_coarse_force_error" not in settings_of(unknown)
    rows = [text for name, text in force_rows(part) if name == "Part of a layer"]
    assert all(plain(text) in summarise(part) for text in rows)
    assert len(rows) == 2


def test_only_a_solution_of_the_whole_has_parts(coarse):
    with pytest.raises(InputError, match="holds no solution"):
        submodel_stress(
            algebraic_result(relief(), THICKNESS, GEL),
            relief(),
            THICKNESS,
            (1.0, 1.5, 1.0, 1.5),
            element_size=0.05,
        )


def test_command(coarse, tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    values = relief()
    at = {"x": values["x"].values, "y": values["y"].values}
    np.savez("m.npz", L1=values.values, **at)
    gaps = (abs(values["x"] - 1.1) < 0.1) & (abs(values["y"] - 1.1) < 0.04)
    np.savez("before.npz", L0=xr.full_like(values, THICKNESS).where(~gaps).values, **at)
    coarse.save("whole.nc")
    code, out, err = run(
        *["submodel", "whole.nc", "m.npz", "--initial-thickness", "before.npz"],
        *["--region", 0.8, 1.4, 1.0, 1.5, "--element-size", 0.05, "--output", "part.nc"],
    )
    assert code == 0, err
    region = gaps.sel(x=slice(0.79, 1.41), y=slice(0.99, 1.51))
    assert f"interpolated pixels, unloaded: {percent(region.mean())} of the map" in out
    assert "region: x 0.8 to 1.4 mm, y 1 to 1.5 mm" in out
    assert "the sides of the part account for about" in out
    part = read_result("part.nc")
    again = submodel_stress(coarse, values, THICKNESS, (0.8, 1.4, 1.0, 1.5), element_size=0.05)
    assert_allclose(part.maps["axial_stress"], again.maps["axial_stress"], rtol=1e-5)
    code, _, err = run(
        *["submodel", "part.nc", "m.npz", "--initial-thickness", THICKNESS],
        *["--region", 0.9, 1.3, 1.1, 1.4, "--element-size", 0.025, "--output", "p.nc"],
    )
    assert code == 2
    assert "holds no solution" in err or "give the whole" in err
