"""Scenes: what a virtual experiment is made of, read from small TOML files.

A layer lies between the window and a sample, which rests on a rigid plate. Lateral positions are
those of the unloaded layer, x and y from 0 to its size in mm; the sample is centred below it. A
``depth`` is counted from the mean surface of the sample, away from the window.
"""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy.ndimage import gaussian_filter, map_coordinates

from optical_palpation import material
from optical_palpation.arguments import toml_fault
from optical_palpation.errors import InputError
from optical_palpation.thickness.frames import smooth_map
from optical_palpation.volume.contents import translated_errors
from optical_palpation.volume.labels import labelled
from optical_palpation.volume.opening import MAP_READERS, open_contents
from optical_palpation.volume.units import is_unit_key, stated_unit

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Coefficient = Annotated[float, Field(ge=0, le=2, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Range = tuple[Finite, Finite]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Law(_Part):
    """Law of a body: coefficients in kPa, ratio of bulk to shear modulus.

    Without any coefficient it is the Mooney-Rivlin law of the paper's layer.
    """

    law: Literal["mooney-rivlin", "neo-hookean", "yeoh"] = "mooney-rivlin"
    c10: Finite = 2.23
    c01: Finite | None = None
    c20: Finite | None = None
    c30: Finite | None = None
    bulk_to_shear: Positive = 1e4

    @property
    def material(self) -> material.Law:
        """The law as the solver takes it."""
        given = self.model_dump(include={"c10", "c01", "c20", "c30"})
        if self.law == "mooney-rivlin" and self.c01 is None:
            given["c01"] = 0.703
        return material.make_law(self.law, self.bulk_to_shear, **given)


def _in_one_unit(body: Any) -> Any:
    """Refuse a body that is so flat or so high that one of its lengths must be in another unit."""
    for width in body.size:
        if not 0.01 <= width / body.thickness <= 500:
            raise ValueError(
                f"size {width:g} mm and thickness {body.thickness:g} mm: one of them is probably "
                "not in mm"
            )
    return body


class Layer(Law):
    """The compliant layer: ``size`` (x, y) and ``thickness``, mm."""

    size: tuple[Positive, Positive]
    thickness: Positive = 0.5

    @model_validator(mode="after")
    def _in_one_unit(self) -> Self:
        return _in_one_unit(self)


class Sinusoid(_Part):
    """Ridges: ``amplitude`` sin(2 pi s / ``wavelength`` + ``phase``), s along ``direction``.

    Lengths in mm, angles in degrees, the direction from x towards y.
    """

    kind: Literal["sinusoid"]
    amplitude: Finite
    wavelength: Positive
    direction: Finite = 0.0
    phase: Finite = 0.0

    def height(self, x: Array, y: Array) -> Array:
        """Height at points, mm."""
        angle = np.deg2rad(self.direction)
        s = x * np.cos(angle) + y * np.sin(angle)
        return self.amplitude * np.sin(2 * np.pi * s / self.wavelength + np.deg2rad(self.phase))


class RandomRelief(_Part):
    """Gaussian random relief of standard deviation ``rms`` and ``correlation_length``, mm."""

    kind: Literal["random"]
    rms: Positive
    correlation_length: Positive
    seed: int = 0

    def height(self, x: Array, y: Array) -> Array:
        """Height at points, mm."""
        return self.rms * _random_field((y, x), self.correlation_length, self.seed)


class ReliefFile(_Part):
    """Height from a map file (formats of ``read_height_map``), on the layer's x and y.

    Heights and coordinates are mm unless the file says another unit; they may be negative.
    """

    kind: Literal["file"]
    path: Path

    def height(self, x: Array, y: Array) -> Array:
        """Height at points, mm."""
        from optical_palpation.thickness import read_height_map

        try:
            return map_height(read_height_map(self.path), x, y)
        except InputError as error:
            raise _named(self.path, error) from None


class Box(_Part):
    """Inclusion or column: where x, y and depth are within the ranges, stiffer by ``factor``."""

    kind: Literal["box"]
    factor: Positive
    x: Range = (-1e6, 1e6)
    y: Range = (-1e6, 1e6)
    depth: Range = (-1e6, 1e6)

    def apply(self, stiffness: Array, x: Array, y: Array, depth: Array) -> Array:
        """Stiffness with this feature at points."""
        inside = np.ones(x.shape, bool)
        for values, (low, high) in ((x, self.x), (y, self.y), (depth, self.depth)):
            inside &= (values >= low) & (values < high)
        return np.where(inside, self.factor, stiffness)


class Ellipsoid(_Part):
    """Inclusion of ``centre`` and ``radii`` (x, y, depth), mm, stiffer by ``factor``."""

    kind: Literal["ellipsoid"]
    factor: Positive
    centre: tuple[Finite, Finite, Finite]
    radii: tuple[Positive, Positive, Positive]

    def apply(self, stiffness: Array, x: Array, y: Array, depth: Array) -> Array:
        """Stiffness with this feature at points."""
        scaled = [
            (values - c) / r
            for values, c, r in zip((x, y, depth), self.centre, self.radii, strict=True)
        ]
        return np.where(sum(s**2 for s in scaled) < 1, self.factor, stiffness)


class RandomStiffness(_Part):
    """Log-normal random factor: ``spread`` is the standard deviation of its natural logarithm."""

    kind: Literal["random"]
    spread: Positive
    correlation_length: Positive
    seed: int = 0

    def apply(self, stiffness: Array, x: Array, y: Array, depth: Array) -> Array:
        """Stiffness with this feature at points."""
        field = _random_field((depth, y, x), self.correlation_length, self.seed)
        return stiffness * np.exp(self.spread * field)


class StiffnessFile(_Part):
    """Factor from a variable ``stiffness`` on (y, x) or (z, y, x) of a file with coordinates.

    NetCDF, HDF5, MATLAB or .npz. Coordinates are mm unless the file says another unit; z is the
    depth. Beyond its ends the nearest value holds.
    """

    kind: Literal["file"]
    path: Path

    def apply(self, stiffness: Array, x: Array, y: Array, depth: Array) -> Array:
        """Stiffness with this feature at points."""
        try:
            return stiffness * volume_factor(_read_factor(self.path), x, y, depth)
        except InputError as error:
            raise _named(self.path, error) from None


Relief = Annotated[Sinusoid | RandomRelief | ReliefFile, Field(discriminator="kind")]
Feature = Annotated[Box | Ellipsoid | RandomStiffness | StiffnessFile, Field(discriminator="kind")]


class Sample(Law):
    """The sample: a block of ``thickness`` with a relief, and features of other stiffness.

    ``size`` (x, y) and ``thickness`` (plate to mean surface) in mm, the law that of a factor 1.
    Reliefs add up; features apply in order.
    """

    size: tuple[Positive, Positive]
    thickness: Positive
    relief: tuple[Relief, ...] = ()
    stiffness: tuple[Feature, ...] = ()

    @model_validator(mode="after")
    def _in_one_unit(self) -> Self:
        return _in_one_unit(self)


class Friction(_Part):
    """Coulomb coefficients at the window, between layer and sample, and at the plate."""

    window: Coefficient = 0.3
    sample: Coefficient = 0.1
    plate: Coefficient = 0.3


class Mesh(_Part):
    """Elements: lateral ``element_size`` in mm, elements through the layer and the sample.

    ``layer_elements`` are of equal height; those of the sample grow away from the layer by
    ``growth`` each, from the height of the layer's. ``edge_size``: width of the outermost elements,
    narrower where the stress at an edge matters, wider to calm a free edge that rolls.
    """

    element_size: Positive
    layer_elements: Annotated[int, Field(ge=2)] | None = None
    growth: Annotated[float, Field(ge=1, le=2)] = 1.25
    edge_size: Positive | None = None


class Scene(_Part):
    """A virtual experiment (section 6 of the paper).

    ``compression``: how far, in mm, the plate moves towards the window after the highest point of
    the sample has touched the layer. ``pixel_spacing``: that of the maps, mm; by default a fifth of
    the elements.
    """

    title: str = ""
    compression: Positive
    pixel_spacing: Positive | None = None
    layer: Layer
    sample: Sample
    friction: Friction = Friction()
    mesh: Mesh


def scene_names() -> list[str]:
    """Names of the scenes that come with the package."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in files("optical_palpation.experiment").joinpath("scenes").iterdir()
        if entry.name.endswith(".toml")
    )


def read_scene(name: str | Path) -> Scene:
    """Read a scene: a TOML file, or one of :func:`scene_names`.

    Paths in a file are relative to its folder.

    Raises
    ------
    InputError
        If there is no such scene, or an entry is missing, unknown or cannot be used.
    """
    path = Path(name)
    if str(name) in scene_names():
        source = files("optical_palpation.experiment").joinpath("scenes", f"{name}.toml")
        text = source.read_text(encoding="utf-8")
    else:
        try:
            text = path.read_text(encoding="utf-8-sig")
        except OSError as error:
            raise InputError(
                f"{name}: neither a readable scene file ({error.strerror}) nor one of the scenes "
                f"{', '.join(scene_names())}"
            ) from None
        except UnicodeDecodeError:
            raise InputError(f"{name}: is no scene file, which is UTF-8 text") from None
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{name}: is no valid TOML: {toml_fault(error, text)}") from None
    try:
        scene = Scene.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{name}: {_reasons(error)}") from None
    return _located(scene, path.parent)


def with_element_size(scene: Scene, element_size: float) -> Scene:
    """Return the scene on other elements, mm; those at the edges in proportion.

    Raises
    ------
    InputError
        If the size is not positive.
    """
    if not (np.isfinite(element_size) and element_size > 0):
        raise InputError(f"element_size must be a positive number in mm, not {element_size!r}")
    mesh = scene.mesh
    edge = mesh.edge_size and mesh.edge_size * element_size / mesh.element_size
    update = {"element_size": element_size, "edge_size": edge}
    return scene.model_copy(update={"mesh": mesh.model_copy(update=update)})


def with_compression(scene: Scene, compression: float) -> Scene:
    """Return the scene with another travel of the plate, mm.

    Raises
    ------
    InputError
        If it is not positive.
    """
    if not (np.isfinite(compression) and compression > 0):
        raise InputError(f"compression must be a positive number in mm, not {compression!r}")
    return scene.model_copy(update={"compression": compression})


def _reasons(error: ValidationError) -> str:
    return "; ".join(
        f"{'.'.join(map(str, problem['loc'])) or 'scene'}: {problem['msg']}"
        for problem in error.errors()
    )


def _located(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the paths of its files resolved."""

    def located(parts: tuple) -> tuple:
        return tuple(
            part.model_copy(update={"path": folder / part.path}) if hasattr(part, "path") else part
            for part in parts
        )

    sample = scene.sample
    update = {"relief": located(sample.relief), "stiffness": located(sample.stiffness)}
    return scene.model_copy(update={"sample": sample.model_copy(update=update)})


def _read_factor(path: Path) -> xr.DataArray:
    """Read ``stiffness`` with its coordinates in mm."""
    reader, contents = open_contents(path, readers=MAP_READERS)
    with contents, translated_errors(path, reader.FORMAT):
        if "stiffness" not in contents.variables:
            held = ", ".join(contents.variables) or "none"
            raise InputError(f"{path}: has no variable named stiffness; it holds {held}")
        variable = contents.variables["stiffness"]
        axes = "zyx"[-len(variable.shape) :]
        if variable.dtype.kind not in "iuf" or len(axes) != len(variable.shape) or len(axes) < 2:
            raise InputError(
                f"{path}: stiffness is {variable.dtype} of shape {variable.shape}; real numbers on "
                "(y, x) or (z, y, x) are needed"
            )
        for key in filter(is_unit_key, variable.attrs):
            if str(variable.attrs[key]).strip() not in ("", "1", "-"):
                raise InputError(
                    f"{path}: stiffness is in {variable.attrs[key]}; it must be a factor, without "
                    "a unit, of the sample's law"
                )
        found = labelled(path, contents, "stiffness", axes)
    absent = [axis for axis, at in found.positions.items() if at is None]
    if absent:
        raise InputError(f"{path}: has no coordinates {', '.join(absent)} of stiffness, in mm")
    positions = {axis: (axis, at) for axis, at in found.positions.items()}
    return xr.DataArray(found.values, positions, tuple(axes)).sortby(list(axes))


def _named(path: Path, error: InputError) -> InputError:
    """The error with the file in it."""
    return error if str(path) in str(error) else InputError(f"{path}: {error}")


def map_height(height: xr.DataArray, x: Array, y: Array) -> Array:
    """Cubic interpolation of a map on (y, x), mm, at points; level beyond its ends."""
    unit = stated_unit("", height.attrs, "the relief")
    if unit not in (None, "mm"):
        raise InputError(f"the relief is in {unit}; give it in mm")
    _check_axes(height, ("y", "x"))
    return smooth_map(height)(x, y)


def volume_factor(volume: xr.DataArray, x: Array, y: Array, depth: Array) -> Array:
    """Nearest value of a stiffness map (y, x) or volume (z, y, x) at points."""
    dims = ("z", "y", "x")[-volume.ndim :]
    _check_axes(volume, dims)
    data = volume.transpose(*dims).values.astype(float)
    places = []
    for dim, points in zip(dims, (depth, y, x)[-volume.ndim :], strict=True):
        axis = volume[dim].values.astype(float)
        places.append(np.interp(points, axis, np.arange(axis.size)))
    values = map_coordinates(data, places, order=0, mode="nearest")
    if not (np.isfinite(data).all() and (values > 0).all()):
        raise InputError("stiffness: the factors must be positive and finite")
    return values


def _check_axes(field: xr.DataArray, dims: tuple[str, ...]) -> None:
    """Refuse a field without ascending coordinates in mm."""
    if set(field.dims) != set(dims):
        raise InputError(f"a field on ({', '.join(dims)}) is needed, not on {field.dims}")
    for dim in dims:
        if dim not in field.coords:
            raise InputError(f"the field has no coordinates along {dim}, in mm")
        unit = stated_unit(dim, field[dim].attrs, f"the field, coordinate {dim}")
        if unit not in (None, "mm"):
            raise InputError(f"the {dim} coordinates of the field are in {unit}; give them in mm")
        axis = field[dim].values
        if axis.size < 2 or not (np.diff(axis) > 0).all():
            raise InputError(f"the {dim} coordinates must ascend and be two at least")


def _random_field(points: tuple[Array, ...], length: float, seed: int) -> Array:
    """Gaussian random field of unit variance at points; the same at any mesh.

    White noise on a grid of a quarter of the correlation length, filtered so that the
    autocorrelation exp(-r^2 / length^2) falls to 1/e at the correlation length.
    """
    step = 0.25 * length
    low = [values.min() - 4 * length for values in points]
    shape = [
        int(np.ceil((values.max() + 4 * length - start) / step)) + 1
        for values, start in zip(points, low, strict=True)
    ]
    if np.prod(shape, dtype=float) > 1e8:
        raise InputError(f"correlation_length {length:g} mm is too short for a sample of this size")
    noise = np.random.default_rng(seed).standard_normal(shape)
    sigma = 0.5 * length / step
    smooth = gaussian_filter(noise, sigma, mode="wrap")
    smooth *= (2 * np.sqrt(np.pi) * sigma) ** (0.5 * len(shape))  # of unit variance again
    positions = [(values - start) / step for values, start in zip(points, low, strict=True)]
    return map_coordinates(smooth, positions, order=3, mode="nearest")
