"""Results as self-describing NetCDF-4 files: maps at the root, the layer in a group."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.arguments import explained, file_path
from optical_palpation.errors import InputError
from optical_palpation.files import netcdf
from optical_palpation.palpation.result import CONTACT_FLAGS, StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.result_checks import check_layer, check_maps, check_points
from optical_palpation.present.state import GROUPS, read_state, state_groups
from optical_palpation.volume import hdf5

_MM = {"units": "mm"}
_KPA = {"units": "kPa"}
_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "x": {**_MM, "long_name": "lateral position x", "axis": "X"},
    "y": {**_MM, "long_name": "lateral position y", "axis": "Y"},
    "axial_stress": {**_KPA, "long_name": "axial Cauchy stress at the sample, tension positive"},
    "axial_stress_mesh_error": {
        **_KPA,
        "long_name": "discretisation error of the axial stress, estimated",
    },
    "contact_pressure": {**_KPA, "long_name": "contact pressure of the sample on the layer"},
    "traction_x": {**_KPA, "long_name": "x component of the traction of the sample on the layer"},
    "traction_y": {**_KPA, "long_name": "y component of the traction of the sample on the layer"},
    "traction_z": {**_KPA, "long_name": "z component of the traction of the sample on the layer"},
    "contact_state": {**CONTACT_FLAGS, "long_name": "contact between layer and sample"},
    "window_contact_state": {**CONTACT_FLAGS, "long_name": "contact between layer and window"},
    "loaded_thickness": {**_MM, "long_name": "loaded thickness of the layer"},
    "algebraic_axial_stress": {**_KPA, "long_name": "axial stress by the algebraic method"},
    "edge_influence": {"units": "1", "long_name": "influence of the layer's sides"},
    "position": {**_MM, "long_name": "deformed position of the nodes"},
    "displacement": {**_MM, "long_name": "displacement of the nodes"},
    "cauchy_stress": {**_KPA, "long_name": "Cauchy stress, mean of each element"},
    "sample_traction": {**_KPA, "long_name": "traction of the sample on the layer"},
    "window_traction": {**_KPA, "long_name": "traction of the window on the layer"},
    "sample_contact_state": {**CONTACT_FLAGS, "long_name": "contact between layer and sample"},
}
# Inside the file the nodes of the layer need axis names of their own: tools that read the groups
# of a file as one tree (such as xarray.open_datatree) take equal names for equal axes.
_NODE_AXES = {axis: f"node_{axis}" for axis in ("x", "y", "z")}
_PIXEL_AXES = {axis: f"pixel_{axis}" for axis in ("x", "y")}


def write_result(result: StressResult, path: str | Path) -> None:
    """Write a result as a NetCDF-4 file.

    The maps are at the root, the deformed layer, if the result has one, in the group ``layer``
    (in single precision, its axes named ``node_z``, ``node_y``, ``node_x`` there); the maps of each
    load of a series in ``series``; the problem and its state, if the result holds these, in
    ``problem`` and ``state``.
    Units, signs, axis order, origin, spacing, software version and all parameters are attributes.
    The file replaces an older one only when it is complete.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    maps = _described(result.maps)
    maps.attrs = {"Conventions": "CF-1.11", **provenance(result.maps)}
    groups, encoding = {"/": maps}, {"/": _compression(maps)}
    if result.layer is not None:
        layer = _described(result.layer)
        groups["/layer"] = layer.rename({a: b for a, b in _NODE_AXES.items() if a in layer.dims})
        encoding["/layer"] = _compression(layer, dtype=np.float32)
    if result.pixels is not None:
        groups["/pixels"] = _described(result.pixels).rename(_PIXEL_AXES)
        encoding["/pixels"] = _compression(groups["/pixels"], dtype=np.float32)
    if result.sensitivities is not None:  # on the points of the maps
        groups["/sensitivities"] = result.sensitivities.drop_vars(["y", "x"])
        encoding["/sensitivities"] = _compression(groups["/sensitivities"])
    if result.series is not None:
        series = _described(result.series)
        groups["/series"], encoding["/series"] = series.drop_vars(["y", "x"]), _compression(series)
    for name, group in state_groups(result).items():
        groups[f"/{name}"], encoding[f"/{name}"] = group, _compression(group)
    # By way of memory, because the HDF5 library can crash on a disk that fills up under it.
    content = netcdf(xr.DataTree.from_dict(groups), encoding=encoding)
    with atomic(path, "result") as temporary:
        temporary.write_bytes(content)


@explained
def read_result(path: str | Path) -> StressResult:
    """Read back what :func:`write_result` wrote.

    Raises
    ------
    InputError
        The file is missing, damaged or no NetCDF-4 file, or holds no stress result; or another
        program has changed its units, the order of its axes, or what its layer is made of.
    """
    import h5py

    path = file_path(path)
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; a result is a file in it, such as stress.nc")
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file")
    with path.open("rb") as stream:
        if not hdf5.recognises(path, stream.read(2056)):
            raise InputError(f"{path}: is no result, which is a NetCDF file such as stress.nc")
    try:
        with hdf5.open_file(path) as file:  # refuses what is no NetCDF-4 file, or damaged
            inside = {
                name
                for name in ("layer", "pixels", "sensitivities", "series", *GROUPS)
                if file.get(name, getclass=True) is h5py.Group  # and no map of that name
            }
        maps = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
        groups = {
            name: xr.load_dataset(path, engine="h5netcdf", group=name, decode_times=False)
            for name in inside
        }
    except InputError:
        raise
    except Exception as error:  # whatever the libraries make of damaged data
        raise InputError(f"{path}: is a damaged result ({error})") from error
    if "compared" in maps.dims:
        raise InputError(
            f"{path}: holds a comparison of results and no result; 'optical-palpation compare' "
            "draws one with --plot"
        )
    if "axial_stress" not in maps:
        found = ", ".join(map(str, maps.data_vars)) or "nothing"
        raise InputError(f"{path}: holds no stress result (no variable axial_stress, but {found})")
    units = {name: str(attrs.get("units", "")) for name, attrs in _ATTRIBUTES.items()}
    check_maps(maps, units, str(path))
    layer = groups.pop("layer", None)
    if layer is not None:
        layer = layer.rename({b: a for a, b in _NODE_AXES.items() if b in layer.dims})
        check_layer(layer, units, str(path))
    pixels = groups.pop("pixels", None)
    if pixels is not None:
        pixels = pixels.rename({b: a for a, b in _PIXEL_AXES.items() if b in pixels.dims})
        check_maps(pixels, units, f"{path}, group pixels")
    derivatives = groups.pop("sensitivities", None)
    if derivatives is not None:
        check_points(derivatives, maps, f"{path}, group sensitivities")
        derivatives = derivatives.assign_coords({axis: maps[axis] for axis in "yx"})
    series = groups.pop("series", None)
    if series is not None:
        check_points(series, maps, f"{path}, group series")
        series = series.assign_coords({axis: maps[axis] for axis in "yx"})
    return StressResult(
        maps,
        layer,
        **read_state(groups),
        pixels=pixels,
        sensitivities=derivatives,
        series=series,
    )


def _described(dataset: xr.Dataset) -> xr.Dataset:
    """Return a shallow copy whose variables carry units and meaning."""
    dataset = dataset.copy()
    for name, variable in dataset.variables.items():
        defaults = _ATTRIBUTES.get(str(name), {})
        if "flag_values" in defaults:
            dataset[name] = variable.astype(np.int8)
        dataset[name].attrs = {**defaults, **variable.attrs}
    return dataset


def _compression(dataset: xr.Dataset, dtype: Any = None) -> dict[Any, dict[str, Any]]:
    encoding: dict[Any, dict[str, Any]] = {}
    for name, variable in dataset.data_vars.items():
        encoding[name] = {"zlib": True, "complevel": 4, "shuffle": True} if variable.ndim else {}
        if dtype is not None and variable.dtype.kind == "f":
            encoding[name]["dtype"] = dtype
    return encoding
