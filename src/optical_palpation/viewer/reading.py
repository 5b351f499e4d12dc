"""Readers: what napari calls when a file is dropped on it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.present.terms import is_map
from optical_palpation.viewer.layers import KEY, Layer, map_layers, volume_layer
from optical_palpation.volume import open_volume
from optical_palpation.volume.opening import is_known

Read = Callable[[Any], list[Layer]]
#: What tells napari that a file was read, and that there is no layer to show for it.
_NO_LAYER = [(None,)]
#: Which of the maps of a file is seen first.
_FIRST = ("axial_stress", "thickness", "loaded_thickness")


def volume_reader(path: str | list[str]) -> Read | None:
    """Return the reader of an OCT volume, or None for what is of no known format.

    A file that does not say how its axes lie or how far its samples are apart is claimed all the
    same; reading it tells what is missing and where to give it.
    """
    if isinstance(path, list) or map_reader(path) or not is_known(Path(path)):
        return None
    return read_volume


def read_volume(path: str) -> list[Layer]:
    """Read an OCT volume as a layer in mm.

    Raises
    ------
    InputError
        If it cannot be read, or does not say enough about itself.
    """
    try:
        volume = open_volume(path)
    except InputError as error:
        raise InputError(f"{error} In napari: Plugins, Optical palpation, Open volume") from error
    return [volume_layer(volume, str(Path(path).resolve()))]


def map_reader(path: str | list[str]) -> Read | None:
    """Return the reader of a result, a thickness map or boundaries, None if it is something else.

    These are the NetCDF files that this project writes.
    """
    if isinstance(path, list) or Path(path).suffix.lower() != ".nc":
        return None
    try:
        with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as file:
            fields = list(file.data_vars.values())
    except Exception:  # whatever the libraries make of what is no such file
        return None
    volumes = [field for field in fields if len(field.dims) > 2]
    return read_maps if any(map(is_map, fields)) and not volumes else None


def read_maps(path: str) -> list[Layer]:
    """Read all maps of a NetCDF file as layers in mm."""
    maps = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    layers = map_layers(maps, f"{Path(path).stem}: ")
    names = [layer.keywords["metadata"][KEY]["variable"] for layer in layers]
    first = next((name for name in _FIRST if name in names), names[-1])
    for name, layer in zip(names, layers, strict=True):  # they lie on each other
        layer.keywords["visible"] = name == first
    return layers


def study_reader(path: str | list[str]) -> Callable[[str], list[tuple[None]]] | None:
    """Return what opens a study file, None for anything else."""
    if isinstance(path, list) or Path(path).suffix.lower() != ".toml":
        return None
    return open_study


def open_study(path: str) -> list[tuple[None]]:
    """Take up a study file in the panel, which says what is wrong with it.

    Raises
    ------
    InputError
        If there is no viewer whose panel could open it.
    """
    import napari

    viewer = napari.current_viewer()
    if viewer is None:
        raise InputError(f"{path}: a study is opened in napari's window, with the panel")
    dock, panel = viewer.window.add_plugin_dock_widget("optical-palpation")
    dock.show()  # it may have been closed
    panel.try_open_study(path)
    return _NO_LAYER
