"""What a study file may say, table by table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, Union

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PrivateAttr,
    Strict,
    Tag,
    model_validator,
)
from pydantic_core import PydanticCustomError

from optical_palpation.arguments import LARGEST_FRICTION
from optical_palpation.material import Law, make_law
from optical_palpation.palpation.accuracy import HIGHEST, LOWEST
from optical_palpation.palpation.input_errors import INPUT_ERRORS, InputErrors

Positive = Annotated[float, Field(gt=0)]
Text = Annotated[str, Field(min_length=1)]
# TOML has arrays and no tuples: the tuple is not strict, the numbers in it are.
Pair = Annotated[tuple[Positive, Positive], Strict(False)]
Range = Annotated[tuple[float, float], Strict(False)]
Three = Annotated[tuple[Positive, Positive, Positive], Strict(False)]
Extent = Annotated[tuple[float, float, float, float], Strict(False)]
Output = Literal["panel", "vtk", "profiles", "report"]
Coefficient = Annotated[float, Field(ge=0, le=LARGEST_FRICTION)]
Hold = Coefficient | Literal["glued"]


class Table(BaseModel):
    """A table of the file, which has the keys named here and no others."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Spacing(Table):
    """Distance between samples along the axes, mm."""

    z: Positive | None = None
    y: Positive | None = None
    x: Positive | None = None


class Origin(Table):
    """Position of the first sample, mm."""

    z: float | None = None
    y: float | None = None
    x: float | None = None


class Volumes(Table):
    """How volumes are read and what the layer's boundaries look like in them."""

    variable: Text | None = None
    axes: Text | None = None
    spacing: Spacing | None = None
    scale: Literal["linear", "amplitude", "intensity", "dB"] | None = None
    refractive_index: Annotated[float, Field(ge=1, le=4)] | None = None
    origin: Origin | None = None
    untrusted: bool | None = None
    window: Literal["line", "fall", "rise"] | float = "line"
    sample: Literal["rise", "line", "fall"] = "rise"
    window_range: Range | None = None
    sample_range: Range | None = None
    method: Literal["surface", "canny"] = "surface"


class VolumeInput(Volumes):
    """An OCT volume in which the layer is found."""

    volume: Text
    corrections: Text | None = None


class MapInput(Table):
    """A thickness map."""

    map: Text
    variable: Text | None = None
    length_unit: Literal["mm", "um"] | None = None
    field_of_view: Pair | None = None
    pixel_spacing: Pair | None = None
    untrusted: bool | None = None


class NumberInput(Table):
    """A thickness that is the same everywhere, mm."""

    thickness: Positive


def kind_of_input(given: Any) -> str:
    """Tell the kind of an input by its key; of none or several, the kind that says so best."""
    keys = given if isinstance(given, Mapping) else vars(given) if isinstance(given, Table) else {}
    return next((kind for kind in ("volume", "map", "thickness") if kind in keys), "volume")


Loaded = Annotated[
    Union[Annotated[VolumeInput, Tag("volume")], Annotated[MapInput, Tag("map")]],  # noqa: UP007
    Discriminator(lambda given: "map" if kind_of_input(given) == "map" else "volume"),
]
Unloaded = Annotated[
    Union[  # noqa: UP007
        Annotated[VolumeInput, Tag("volume")],
        Annotated[MapInput, Tag("map")],
        Annotated[NumberInput, Tag("thickness")],
    ],
    Discriminator(kind_of_input),
]


class Layer(Table):
    """Where the layer lies in the maps, and whether these are registered to each other."""

    extent: Extent | None = None
    registration: bool = False


class Material(Table):
    """Law of the layer and its coefficients, kPa; which it takes, ``make_law`` says."""

    law: Literal["mooney-rivlin", "neo-hookean", "yeoh"] = "mooney-rivlin"
    c10: float
    c01: float = 0.0
    c20: float = 0.0
    c30: float = 0.0
    bulk_to_shear: float = 1e4

    def make(self) -> Law:
        """Return the law; raises MaterialError as ``make_law`` does."""
        return make_law(**self.model_dump())


class Friction(Table):
    """Coulomb coefficients of both sides of the layer, or that they are glued."""

    window: Hold
    sample: Hold
    slip_length: Positive | None = None

    @property
    def sample_glued(self) -> bool:
        """Whether the sample is glued to the layer, and may pull it."""
        return self.sample == "glued"


SampleLaw = Annotated[
    Union[  # noqa: UP007
        Annotated[Literal["neo-hookean", "layer"], Tag("name")], Annotated[Material, Tag("table")]
    ],
    Discriminator(lambda given: "table" if isinstance(given, Mapping | Table) else "name"),
]


class EarlierLoad(MapInput):
    """A load before that of ``[loaded]``: a thickness map, and how far the sample was pressed."""

    compression: Positive | None = None
    total_force: Positive | None = None

    @property
    def reading(self) -> dict[str, Any]:
        """How the map is read."""
        return self.model_dump(exclude={"map", "compression", "total_force"})


class Sample(Table):
    """How the sample's surface moves sideways; or the sample itself, which tells that.

    ``motion`` is the strain by which the surface spreads, or a file. The other keys put the sample
    into the model (:class:`~optical_palpation.stiffness.Sample`), mm and mN; ``relief`` is a
    file of heights, or "flat", ``law`` "layer" that of the layer, ``earlier`` the loads of a series
    before that of ``[loaded]``.
    """

    motion: Annotated[float, Field(gt=-0.5, lt=1)] | Text | None = None
    thickness: Positive | None = None
    compression: Positive | None = None
    total_force: Positive | None = None
    plate_friction: Coefficient | None = None
    relief: Text | None = None
    size: Pair | None = None
    law: SampleLaw = "neo-hookean"
    stiffness_smoothing: Positive | None = None
    earlier: Annotated[tuple[EarlierLoad, ...], Strict(False)] = ()

    @property
    def modelled(self) -> bool:
        """Whether the sample is in the model."""
        return self.thickness is not None

    def make_law(self, of_layer: Law) -> Law | None:
        """Return the law of the sample, None for the default; raises MaterialError."""
        if isinstance(self.law, Material):
            return self.law.make()
        return of_layer if self.law == "layer" else None

    @property
    def files(self) -> dict[str, str]:
        """The files that it names, by key."""
        relief = None if self.relief == "flat" else self.relief
        both = {"motion": self.motion, "relief": relief}
        named = {key: name for key, name in both.items() if isinstance(name, str)}
        return named | {f"earlier-{n}": load.map for n, load in enumerate(self.earlier, start=1)}


class Grid(Table):
    """The finite elements and their solver; their size, or the accuracy that chooses it."""

    element_size: Positive | Three | None = None
    accuracy: Annotated[float, Field(ge=LOWEST, le=HIGHEST)] | None = None
    edges: Literal["free", "roller", "padded"] = "free"
    imprint_smoothing: Annotated[float, Field(ge=0)] | None = None
    solver: Literal["auto", "multigrid", "direct"] = "auto"
    threads: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.element_size is None) == (self.accuracy is None):
            raise PydanticCustomError("one_of_two", "element_size (mm) or accuracy")
        return self


Fraction = Annotated[float, Field(ge=0, lt=1)]


class Errors(Table):
    """Half-widths of the 95 % intervals of the inputs; no error bands if all are 0.

    Those of plate friction, compression, sample thickness and total force need a sample in the
    model. ``estimates`` tells whether what they do to the stress is estimated at all, and what mesh
    and sides do.
    """

    estimates: bool = True
    window_friction: Coefficient = INPUT_ERRORS.window_friction
    sample_friction: Coefficient = INPUT_ERRORS.sample_friction
    modulus: Fraction = INPUT_ERRORS.modulus
    thickness: Annotated[float, Field(ge=0)] = INPUT_ERRORS.thickness
    initial_thickness: Annotated[float, Field(ge=0)] = INPUT_ERRORS.initial_thickness
    plate_friction: Coefficient = INPUT_ERRORS.plate_friction
    compression: Fraction = INPUT_ERRORS.compression
    sample_thickness: Fraction = INPUT_ERRORS.sample_thickness
    total_force: Fraction = INPUT_ERRORS.total_force

    @property
    def of_inputs(self) -> InputErrors:
        """The errors of the inputs."""
        return InputErrors(**self.model_dump(exclude={"estimates"}))


class Outputs(Table):
    """The result folder and what is written besides the results themselves."""

    folder: Text | None = None
    write: Annotated[tuple[Output, ...], Strict(False)] = ("panel", "vtk", "profiles", "report")


class Study(Table):
    """A validated study file; made by :func:`read_study`."""

    title: Text | None = None
    volumes: Volumes = Volumes()
    unloaded: Unloaded
    loaded: Loaded
    layer: Layer = Layer()
    material: Material
    friction: Friction
    sample: Sample = Sample()
    grid: Grid
    errors: Errors = Errors()
    outputs: Outputs = Outputs()
    _file: Path = PrivateAttr()
    _in_memory: bool = PrivateAttr(False)
    _sha256: str = PrivateAttr()

    @property
    def file(self) -> Path:
        """The study file."""
        return self._file

    def where(self, part: str = "") -> str:
        """What errors call the study, or a part of it such as ``[grid]``: by its file, if any."""
        if self._in_memory:
            return part[1:-1] if part.startswith("[") else part or "study"
        return f"{self._file}, {part}" if part else str(self._file)

    @property
    def sha256(self) -> str:
        """SHA-256 of the study file as it was read, or of its tables if it was not; hex."""
        return self._sha256

    @property
    def folder(self) -> Path:
        """The result folder; by default named after the study file, beside it."""
        return self.path(self.outputs.folder or f"{self._file.stem}-results")

    @property
    def inputs(self) -> dict[str, VolumeInput | MapInput]:
        """The inputs that are files, by ``unloaded`` and ``loaded``."""
        both = {"unloaded": self.unloaded, "loaded": self.loaded}
        return {side: it for side, it in both.items() if not isinstance(it, NumberInput)}

    def path(self, name: str) -> Path:
        """A path that the file names, which counts from the folder of the file."""
        return self._file.parent / name
