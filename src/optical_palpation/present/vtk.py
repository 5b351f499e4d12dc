"""The deformed layer as a VTK XML structured grid, for ParaView."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.output import atomic, provenance

_VTK_TYPES = {"f4": "Float32", "f8": "Float64", "i1": "Int8"}
# VTK wants all nine components of a tensor; the layer holds the six independent ones.
_TENSOR = ("xx", "xy", "xz", "xy", "yy", "yz", "xz", "yz", "zz")


def write_vtk(result: StressResult, path: str | Path) -> None:
    """Write the deformed layer as ``.vts`` (VTK XML structured grid, opened by ParaView).

    Points are the deformed positions in mm, z = 0 at the window. Point data: ``displacement_mm``
    and, on the two faces of the layer, ``traction_kPa`` (NaN inside) and ``contact_state``
    (0 open, 1 slip, 2 stick, -1 inside). Cell data: ``cauchy_stress_kPa`` as a full tensor, tension
    positive, and ``stiffness`` where each element has its own. Software, version and all parameters
    are in the field data as JSON.

    Raises
    ------
    InputError
        The result has no layer (the algebraic method makes none).
    OutputError
        The file cannot be written.
    """
    layer = result.layer
    if layer is None:
        raise InputError(
            "the algebraic method has no deformed layer to write as a VTK file; "
            "use the computational method"
        )
    nz, ny, nx = (layer.sizes[axis] for axis in ("z", "y", "x"))
    extent = f"0 {nx - 1} 0 {ny - 1} 0 {nz - 1}"
    root = ET.Element(
        "VTKFile",
        type="StructuredGrid",
        version="1.0",
        byte_order="LittleEndian",
        header_type="UInt64",
    )
    grid = ET.SubElement(root, "StructuredGrid", WholeExtent=extent)
    _add_text(ET.SubElement(grid, "FieldData"), "provenance", json.dumps(provenance(result.maps)))
    piece = ET.SubElement(grid, "Piece", Extent=extent)

    point_data = ET.SubElement(piece, "PointData", Vectors="displacement_mm")
    _add_array(point_data, "displacement_mm", _nodes(layer["displacement"]))
    _add_array(point_data, "traction_kPa", _on_faces(layer, "traction", np.nan))
    _add_array(point_data, "contact_state", _on_faces(layer, "contact_state", -1))

    stress = layer["cauchy_stress"].transpose("cell_z", "cell_y", "cell_x", "tensor")
    nine = stress.sel(tensor=list(_TENSOR)).values.astype("<f4")
    cell_data = ET.SubElement(piece, "CellData", Tensors="cauchy_stress_kPa")
    _add_array(cell_data, "cauchy_stress_kPa", nine)
    if "stiffness" in layer:
        stiffness = layer["stiffness"].transpose("cell_z", "cell_y", "cell_x")
        _add_array(cell_data, "stiffness", stiffness.values.astype("<f4"))

    _add_array(ET.SubElement(piece, "Points"), "position_mm", _nodes(layer["position"]))
    with atomic(path, "ParaView file") as temporary:
        ET.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def _nodes(vector: xr.DataArray) -> np.ndarray:
    # VTK lets x run fastest, then y, then z: the memory order of (z, y, x) arrays.
    ordered = vector.transpose("z", "y", "x", "component").sel(component=["x", "y", "z"])
    return ordered.values.astype("<f8")


def _on_faces(layer: xr.Dataset, what: str, inside: float) -> np.ndarray:
    """Return node values that are those of window and sample on the faces, ``inside`` elsewhere."""
    window, sample = layer[f"window_{what}"], layer[f"sample_{what}"]
    if "component" in window.dims:
        window, sample = (
            face.transpose("y", "x", "component").sel(component=["x", "y", "z"])
            for face in (window, sample)
        )
    values = np.full((layer.sizes["z"], *window.shape), inside)
    values[0], values[-1] = window.values, sample.values
    return values.astype("<i1" if what == "contact_state" else "<f4")


def _add_array(parent: ET.Element, name: str, values: np.ndarray) -> None:
    """Append an array of shape (z, y, x) or (z, y, x, components)."""
    components = values.shape[3] if values.ndim == 4 else 1
    data = np.ascontiguousarray(values).tobytes()
    element = ET.SubElement(
        parent,
        "DataArray",
        type=_VTK_TYPES[values.dtype.str[1:]],
        Name=name,
        NumberOfComponents=str(components),
        format="binary",
    )
    element.text = base64.b64encode(np.array(len(data), "<u8").tobytes() + data).decode()


def _add_text(parent: ET.Element, name: str, text: str) -> None:
    element = ET.SubElement(
        parent, "DataArray", type="String", Name=name, NumberOfTuples="1", format="ascii"
    )
    element.text = " ".join(str(byte) for byte in (*text.encode(), 0))
