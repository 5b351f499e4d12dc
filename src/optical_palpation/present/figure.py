"""The one way in which figures are made: sizes and type of journals, maps, scale bars, letters."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.analysis import Region, traced
from optical_palpation.analysis.maps import area_mean, on_layer
from optical_palpation.arguments import check_instance, in_words
from optical_palpation.errors import InputError
from optical_palpation.palpation.edges import NOTABLE
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.terms import (
    STATES,
    Term,
    common_limits,
    in_percent,
    is_map,
    percent,
    term,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

Width = Literal["single", "double"] | float
#: Widths of one and two columns, mm; those of most journals differ by no more than 5 mm.
COLUMNS = {"single": 85.0, "double": 178.0}
_MM = 1 / 25.4
# Where the sides matter all over a map, hatching would only hide it.
_ALL, _HATCH = 0.95, "#A0A0A0"
# As in the report.
_INTERPOLATED = "#CC79A7"
# Room for the numbers of a colour bar, inches.
_NUMBERS = 0.4
# Room for the letter of a panel, inches.
_LETTER = 0.3
# Layouts until a figure stays as it is, but for a share of its size: most do after two.
_LAYOUTS, _STAYS = 6, 5e-3
_DPI = 300
_STYLE: Any = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same figure on every machine
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "legend.fontsize": 6.5,
    "figure.titlesize": 8.5,
    "axes.linewidth": 0.6,
    "axes.formatter.useoffset": False,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.2,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.4,
    "axes.axisbelow": True,
    "hatch.linewidth": 0.4,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.0,
    # Text stays text, which a journal can set anew.
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "optical-palpation",
    "savefig.dpi": _DPI,
    "figure.dpi": _DPI,
}


@contextmanager
def new_figure(width: Width = "double", height: float = 90.0) -> Iterator[Figure]:
    """Give an empty figure in the style of all figures; draw within the context.

    Parameters
    ----------
    width
        ``single`` or ``double`` column, or mm.
    height
        In mm.

    Raises
    ------
    InputError
        If the width is none of these.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        size = (width_in_mm(width) * _MM, height * _MM)
        figure = Figure(figsize=size, layout="constrained", dpi=_DPI)
        FigureCanvasAgg(figure)
        yield figure


@contextmanager
def figure_file(
    path: str | Path,
    width: Width = "double",
    height: float = 90.0,
    maps: xr.Dataset | None = None,
) -> Iterator[Figure]:
    """Give a figure as :func:`new_figure` does, and write what was drawn (PNG, PDF or SVG).

    Parameters
    ----------
    path
        The picture; its ending says which kind. Text of a PDF or SVG stays text.
    width, height
        As for :func:`new_figure`.
    maps
        The maps of the result that it shows, which tell where the figure is from.

    Raises
    ------
    InputError
        What was drawn does not fit in the width.
    OutputError
        The file cannot be written.
    """
    with atomic(path, "picture") as temporary, new_figure(width, height) as figure:
        yield figure
        about = {} if maps is None else provenance(maps)
        text = "; ".join(f"{key} {value}" for key, value in about.items() if key != "convergence")
        metadata: dict[str, dict[str, Any]] = {
            ".png": {"Description": text},
            ".pdf": {"Subject": text, "CreationDate": None},
            ".svg": {"Description": text, "Date": None},
        }
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "constrained_layout not applied")
            try:
                _settle(figure)
                # laid out as it is: savefig would do so once more, and draw it twice for that
                figure.set_layout_engine(None)
                figure.savefig(temporary, metadata=metadata[temporary.suffix.lower()])
            except UserWarning:
                raise InputError(
                    f"width: {width_in_mm(width):g} mm leave no room for the maps beside their "
                    "numbers; give more, or fewer columns"
                ) from None


def _settle(figure: Figure) -> None:
    """Lay a figure out until it stays as it is, no title longer than its room.

    One layout is not enough: a map true to scale fills its room in one direction only, and the
    colour bar beside it is in proportion to the map.
    """
    engine: Any = figure.get_layout_engine()
    before: list[Any] = []
    for _ in range(_LAYOUTS):
        engine.execute(figure)
        for axes in figure.axes:
            axes.apply_aspect()
        places = [axes.get_position().bounds for axes in figure.axes]
        if not _break_titles(figure) and before and np.allclose(before, places, atol=_STAYS):
            break
        before = places


def _break_titles(figure: Figure) -> bool:
    """Break titles that run off the figure or into the next panel; whether there were any.

    A layout keeps room for the height of a title, not for its length.
    """
    boxes = [axes.get_window_extent() for axes in figure.axes]
    broken = False
    for axes, box in zip(figure.axes, boxes, strict=True):
        line = axes.get_title(loc="left")
        if not line or "\n" in line:
            continue
        beside = [b for b in boxes if b.x0 > box.x1 and b.y0 < box.y1 and box.y0 < b.y1]
        # left of a panel is its letter; what is narrow is a colour bar
        ends = [b.x0 - _LETTER * figure.dpi for b in beside if b.width > 0.3 * box.width]
        room = min([figure.bbox.x1, *ends]) - box.x0
        length = axes.set_title(line, loc="left").get_window_extent().width
        end = line.rfind(" ", 0, int(len(line) * room / length) + 1) if length > room else 0
        if end > 0:
            axes.set_title(f"{line[:end]}\n{line[end + 1 :]}", loc="left")
            broken = True
    return broken


def width_in_mm(width: Width) -> float:
    """Return a width in mm.

    Raises
    ------
    InputError
        If it is neither ``single`` nor ``double`` nor 20 to 500 mm.
    """
    if isinstance(width, str) and width in COLUMNS:
        return COLUMNS[width]
    if isinstance(width, int | float) and 20.0 <= width <= 500.0:
        return float(width)
    raise InputError(f"width: 'single', 'double' or a number of mm from 20 to 500, not {width!r}")


def colour_map(name: str) -> Colormap:
    """Return a colour map of matplotlib, or one of Crameri's.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    from cmcrameri import cm
    from matplotlib import colormaps

    if name in colormaps:
        return colormaps[name]
    if name in cm.cmaps:
        return cm.cmaps[name]
    known = [*colormaps, *cm.cmaps]
    near = difflib.get_close_matches(name, known, 3)
    hint = f"did you mean {' or '.join(near)}?" if near else "viridis, cividis and magma are some"
    raise InputError(f"there is no colour map {name!r}; {hint}")


def draw_map(
    axes: Axes,
    field: xr.DataArray,
    what: Term,
    *,
    limits: tuple[float, float] | None = None,
    colours: str | None = None,
    scale_bar: bool = False,
    colour_bar: bool = True,
    regions: Sequence[Region] = (),
    frame: Mapping[str, tuple[float, float]] | None = None,
) -> ScalarMappable:
    """Draw a map, true to scale, with its name, unit and colour bar.

    Parameters
    ----------
    axes
        Where to draw.
    field
        Map on ``(y, x)``, coordinates in mm.
    what
        What it is called.
    limits
        Lowest and highest value of the colours; the 1st to 99th percentile by default.
    colours
        Name of another colour map.
    scale_bar
        A scale bar instead of axes in mm.
    colour_bar
        Whether to draw one.
    regions
        Regions of interest to outline.
    frame
        Limits of x and y, as from :func:`common_frame`; those of the map by default.
    """
    from matplotlib.colors import BoundaryNorm, ListedColormap

    field = field.transpose("y", "x").sortby(["y", "x"])
    values = field.values
    options: dict[str, Any] = {"shading": "nearest", "rasterized": True}
    named: dict[str, str] = {}
    if what.colours == "states":
        names = str(field.attrs.get("flag_meanings", "")).split() or [
            state.name.lower() for state in ContactState
        ]
        if not (values == ContactState.GLUED).any():  # most contacts are not
            names = [name for name in names if name != ContactState.GLUED.name.lower()]
        named = {name: STATES.get(name, f"C{k}") for k, name in enumerate(names)}
    elif what.colours == "flags":
        named = {"no": "#DDDDDD", "yes": "#D55E00"}
        values = values.astype(float)
    if named:
        options["cmap"] = ListedColormap(list(named.values()))
        options["norm"] = BoundaryNorm(np.arange(len(named) + 1) - 0.5, len(named))
    else:
        low, high = common_limits({"": field}, what.colours) if limits is None else _checked(limits)
        options |= {"cmap": colour_map(colours or what.colours), "vmin": low, "vmax": high}
    mesh = axes.pcolormesh(field["x"], field["y"], values, **options)
    axes.set_title(what.label, loc="left")
    axes.set_aspect("equal")
    if frame is not None:
        axes.set(xlim=frame["x"], ylim=frame["y"])
    if scale_bar:
        axes.set(xticks=[], yticks=[])
        _scale_bar(axes, float(np.ptp(axes.get_xlim())))
    else:
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
        _equal_ticks(axes)
    if colour_bar:
        figure: Any = axes.figure
        beside = _beside(axes)
        if named:
            bar = figure.colorbar(mesh, **beside, ticks=range(len(named)))
            shares = [area_mean(field == k) for k in range(len(named))]
            rows = zip(named, shares, strict=True)
            between = "\n" if _is_high(axes, 2 * len(named)) else " "
            bar.ax.set_yticklabels([f"{name}{between}{percent(share)}" for name, share in rows])
            bar.ax.tick_params(length=0)
        else:
            seen = values[np.isfinite(values)]
            beyond = [bool((seen < low).any()), bool((seen > high).any())]
            ends = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
            extend = ends[int(beyond[0]), int(beyond[1])]
            figure.colorbar(mesh, **beside, extend=extend, extendfrac=0.03)
    _outline(axes, regions)
    return mesh


def finest(
    maps: xr.Dataset, pixels: xr.Dataset | None, names: Iterable[str]
) -> dict[str, xr.DataArray]:
    """Maps by name, each on the pixels of the image where it is known on these."""
    fine = xr.Dataset() if pixels is None else pixels
    return {name: fine[name] if name in fine else maps[name] for name in names}


def common_frame(fields: Collection[xr.DataArray]) -> dict[str, tuple[float, float]] | None:
    """Limits of x and y (mm) of the plane that all maps cover; None where there is none.

    Points of a coarse grid stand for more around them, and maps of two grids would else begin at
    different places.
    """
    found = {}
    for axis in ("x", "y"):
        places = [np.sort(field[axis].values) for field in fields]
        if min(map(len, places)) < 2:
            return None
        low = max(float(1.5 * at[0] - 0.5 * at[1]) for at in places)
        high = min(float(1.5 * at[-1] - 0.5 * at[-2]) for at in places)
        if not low < high:
            return None
        found[axis] = (low, high)
    return found


def _beside(axes: Axes) -> dict[str, Any]:
    """Where the colour bar of a map goes: as high as the map, unless that is too low for numbers.

    A layout that knows nothing of what lies beside axes has to take the room from the axes.
    """
    if axes.figure.get_layout_engine() is None:
        from mpl_toolkits.axes_grid1 import axes_size, make_axes_locatable

        divider = make_axes_locatable(axes)
        bar = divider.append_axes("right", "5%", 0.08)
        divider.set_horizontal([*divider.get_horizontal(), axes_size.Fixed(_NUMBERS)])
        return {"cax": bar}
    aspect = float(np.ptp(axes.get_ylim()) / np.ptp(axes.get_xlim()))
    width, height = 0.05 * np.clip(aspect, 0.6, 2.0), max(1.0, 0.25 / aspect)
    return {"cax": axes.inset_axes((1.04, (1.0 - height) / 2, width, height))}


def _is_high(axes: Axes, lines: int) -> bool:
    """Whether so many lines of small text fit beside a map, as wide as its room lets it be."""
    import matplotlib

    figure: Any = axes.get_figure(root=True)
    box = axes.get_window_extent()
    aspect = float(np.ptp(axes.get_ylim()) / np.ptp(axes.get_xlim()))
    line = 1.4 * float(matplotlib.rcParams["ytick.labelsize"]) / 72 * figure.dpi
    return bool(min(box.height, box.width * aspect) >= lines * line)


def hatch_edges(axes: Axes, maps: xr.Dataset) -> None:
    """Hatch the part of a map of the computational method where the layer's sides matter.

    That is where ``edge_influence`` exceeds 5 %; a line below the axes says so.
    """
    influence = maps.get("edge_influence")
    if influence is None:
        return
    values = influence.transpose("y", "x").fillna(0.0)
    if not bool((values > NOTABLE).any()):
        if bool(influence.isnull().all()):
            axes.set_xlabel(f"{axes.get_xlabel()}\ninfluence of the sides unknown")
        return
    if bool((values > NOTABLE).mean() > _ALL):
        axes.set_xlabel(f"{axes.get_xlabel()}\nsides matter everywhere (> {100 * NOTABLE:g} %)")
        return
    _hatch(axes, values, NOTABLE, "////", _HATCH)
    axes.set_xlabel(f"{axes.get_xlabel()}\nhatched: sides matter (> {100 * NOTABLE:g} %)")


def hatch_interpolated(panels: Iterable[Axes], maps: xr.Dataset) -> list[Patch]:
    """Hatch what was interpolated instead of measured in maps, and return its key for a legend."""
    from matplotlib.patches import Patch

    if "filled" not in maps or not bool((filled := maps["filled"].fillna(0) > 0).any()):
        return []
    filled = filled.transpose("y", "x").astype(float)
    for axes in panels if min(filled.shape) > 1 else ():
        _hatch(axes, filled, 0.5, "\\\\\\\\", _INTERPOLATED)
    look: Any = {"facecolor": "none", "edgecolor": _INTERPOLATED, "hatch": "\\\\\\\\"}
    return [Patch(label="interpolated", linewidth=0.5, **look)]


def _hatch(axes: Axes, values: xr.DataArray, above: float, hatch: str, colour: str) -> None:
    """Hatch where a map is above a value, and outline that."""
    place = values["x"], values["y"], values
    drawn = axes.contourf(*place, levels=[above, np.inf], colors="none", hatches=[hatch])
    drawn.set_edgecolor(colour)
    drawn.set_linewidth(0.0)
    axes.contour(*place, [above], colors=colour, linewidths=0.5)


def _equal_ticks(axes: Axes) -> None:
    """Ticks the same distance apart along both axes, unless one is too short for them."""
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    spans = [float(np.ptp(limits)) for limits in (axes.get_xlim(), axes.get_ylim())]
    step = float(np.diff(MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0.0, max(spans)))[0])
    if min(spans) >= 2 * step:
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MultipleLocator(step))


def _scale_bar(axes: Axes, width: float) -> None:
    """A bar of a round length of about a quarter of the map."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    rough = width / 4
    power = 10.0 ** np.floor(np.log10(rough))
    length = max(m * power for m in (1, 2, 5) if m * power <= rough * 1.001)
    text = f"{length:g} mm" if length >= 0.1 else f"{1000 * length:g} µm"
    bar = AnchoredSizeBar(
        axes.transData,
        length,
        text,
        "lower right",
        pad=0.3,
        borderpad=0.4,
        sep=2,
        size_vertical=0.012 * width,
        color="black",
        label_top=True,
    )
    bar.patch.set(facecolor="white", edgecolor="none", alpha=0.75)
    axes.add_artist(bar)


def _outline(axes: Axes, regions: Sequence[Region]) -> None:
    """Draw the borders of regions, and their names."""
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.2, foreground="black")]
    centres = []
    for region in regions:
        if region.mask is None:
            outlines = region.outlines
            # of the largest: one within it is a hole
            centres.append(max(map(_centre, outlines), key=lambda found: found[0])[1])
        else:  # pixels at the rim are seen in part
            low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
            outlines = tuple(np.clip(it, low, high) for it in traced(region).outlines)
            inside = region.mask.where(region.mask >= 0.5, 0.0)
            share = [float((inside * inside[axis]).sum() / inside.sum()) for axis in "xy"]
            centres.append(np.array(share))
        for outline in outlines:
            closed = np.vstack([outline, outline[:1]])
            axes.plot(*closed.T, color="white", lw=1.0, path_effects=halo)
    if regions:
        _label(axes, [region.name for region in regions], centres)


def _centre(polygon: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Area of a polygon and the centre of that."""
    start = polygon[0]
    a, b = polygon - start, np.roll(polygon, -1, axis=0) - start
    twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = float(twice.sum()) / 2
    middle = (a + b).T @ twice / (6 * area) if area else (polygon - start).mean(0)
    return abs(area), start + middle


def _label(axes: Axes, names: Sequence[str], centres: Sequence[NDArray[np.float64]]) -> None:
    """Write names at places (x, y), shortened to half of the map, and not on each other."""
    figure: Any = axes.get_figure(root=True)
    with warnings.catch_warnings():  # should there be no room, that is told when it is written
        warnings.simplefilter("ignore", UserWarning)
        figure.draw_without_rendering()  # places and sizes are known from then on
    whole = axes.get_window_extent()
    taken = np.empty((0, 2, 2))  # corners of the names that are written
    rim = 0.05 * whole.width  # by which later maps of the figure may narrow this one
    plate = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
    for name, centre in zip(names, centres, strict=True):
        text = axes.text(
            centre[0], centre[1], name, ha="center", va="center", bbox=plate, clip_on=True
        )
        box = text.get_window_extent()
        if box.width > 0.5 * whole.width:
            kept = max(int(0.5 * len(name) * whole.width / box.width), 3)
            text.set_text(f"{name[: kept - kept // 2]}…{name[len(name) - kept // 2 :]}")
            box = text.get_window_extent()
        aside = np.clip(0.0, whole.x0 + rim - box.x0, whole.x1 - rim - box.x1)
        step = 1.3 * box.height
        most = min(len(taken), int(whole.height / step) + 1)  # further ones are off the map
        moved = (box.translated(aside, step * k) for n in range(most + 1) for k in (n, -n))
        inside = (b for b in moved if whole.y0 <= b.y0 and b.y1 <= whole.y1)
        free = (b for b in inside if not _overlaps(b.get_points(), taken).any())
        box = next(free, box.translated(aside, 0.0))
        taken = np.append(taken, box.get_points()[None], axis=0)
        middle = ((box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2)
        x, y = axes.transData.inverted().transform(middle)
        text.set_position((x, y))


def _overlaps(box: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of other boxes, (n, 2, 2), lower corner before upper, meet one, (2, 2)."""
    return ((others[:, 0] <= box[1]) & (box[0] <= others[:, 1])).all(axis=-1)


def letter(panels: Sequence[Axes]) -> None:
    """Give panels their letters, in the order in which they are read."""
    for k, axes in enumerate(panels):
        axes.annotate(
            f"({chr(ord('a') + k)})",
            (0.0, 1.0),
            xytext=(-4.0, 5.0),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="right",
            va="bottom",
            weight="bold",
        )


def write_maps(
    result: StressResult | xr.Dataset,
    path: str | Path,
    names: str | Sequence[str] = "axial_stress",
    *,
    width: Width = "single",
    columns: int | None = None,
    limits: Mapping[str, tuple[float, float]] | tuple[float, float] | None = None,
    colours: str | None = None,
    scale_bar: bool = False,
    letters: bool | None = None,
    regions: Sequence[Region] = (),
) -> None:
    """Write maps of a result as a figure for a paper (PNG, PDF or SVG by the name's ending).

    All maps have the same axes; those of one kind, such as stress by both methods, share their
    colour limits. Thickness and algebraic stress have the resolution of the image, not that of the
    elements. Names of quantities and units are in words.

    Parameters
    ----------
    result
        A result, or a Dataset of maps on ``(y, x)``.
    path
        The picture. Maps are pixels in it, at 300 dpi; all else of a PDF or SVG is vectors.
    names
        Map to show, or several in this order.
    width
        ``single`` (85 mm) or ``double`` column (178 mm), or mm.
    columns
        Maps beside each other; by default one in a single column, three in a double one.
    limits
        Colour limits of all maps, which then have one unit; or by name, and those of a name hold
        for its whole kind.
    colours
        A colour map instead of those of each quantity.
    scale_bar
        A scale bar instead of axes in mm.
    letters
        Letters on the panels; where there are several, by default.
    regions
        Regions of interest to outline.

    Raises
    ------
    InputError
        If there is no such map, or an option cannot be used.
    OutputError
        If the file cannot be written.
    """
    pixels = result.pixels if isinstance(result, StressResult) else None
    maps = result.maps if isinstance(result, StressResult) else result
    check_instance(maps, xr.Dataset, "result", "a StressResult, or a Dataset of maps")
    kind = "that of a map, such as 'axial_stress', or a list of these"
    check_instance(names, (str, Sequence), "names", kind)
    names = [names] if isinstance(names, str) else names
    for region in regions:
        check_instance(region, Region, "regions", "a list of Region (op.read_regions)")
    if "loaded_thickness" in maps:
        maps, pixels = on_layer(maps), None if pixels is None else on_layer(pixels)
    maps = in_percent(maps)
    if not names:
        raise InputError("names: give at least one map")
    terms = {name: _known_term(maps, name) for name in names}
    if limits is not None and not isinstance(limits, Mapping):
        units = {what.units for what in terms.values() if what.has_limits}
        if len(units) > 1:
            said = " and ".join(sorted(unit or "numbers without a unit" for unit in units))
            raise InputError(
                f"limits: the maps are in {said}, and one pair of limits is for one unit; draw "
                "figures of their own, or in Python give limits by map, {'axial_stress': (-5, 0)}"
            )
    fields = finest(maps, pixels, terms)
    by_scale = _limits(fields, terms, limits)
    frame = common_frame(fields.values())
    across = columns or (1 if width_in_mm(width) < 120 else 3)
    across = min(across, len(names))
    down = -(-len(names) // across)
    y, x = maps["y"].values, maps["x"].values
    aspect = float(np.clip(np.ptp(y) / max(np.ptp(x), 1e-12), 0.2, 3.0))
    margin = 10.0 if scale_bar else 18.0
    height = down * ((width_in_mm(width) / across - 20.0) * aspect + margin)
    with figure_file(path, width, height, maps if "loaded_thickness" in maps else None) as figure:
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, (name, what) in zip(panels, terms.items(), strict=False):
            draw_map(
                axes,
                fields[name],
                what,
                limits=by_scale.get(what.scale),
                colours=colours if what.has_limits else None,
                scale_bar=scale_bar,
                regions=regions,
                frame=frame,
            )
        seen = [axes for axes, what in zip(panels, terms.values(), strict=False) if what.has_limits]
        if key := hatch_interpolated(seen, maps):
            figure.legend(handles=key, loc="outside lower right")
        for axes in panels[len(names) :]:
            axes.remove()
        for k, axes in enumerate(panels[: len(names)]):
            if not scale_bar:
                axes.set_ylabel("y (mm)" if k % across == 0 else "")
                below = k + across >= len(names)
                axes.set_xlabel("x (mm)" if below else "")
                axes.tick_params(labelbottom=below, labelleft=k % across == 0)
        if letters or (letters is None and len(names) > 1):
            letter(list(panels[: len(names)]))


def _known_term(maps: xr.Dataset, name: str) -> Term:
    check_instance(name, str, "name", "that of a map, such as 'axial_stress'")
    if name not in maps or not is_map(maps[name]):
        known = ", ".join(str(n) for n, v in maps.data_vars.items() if is_map(v))
        raise InputError(f"there is no map {name!r}; known are {known}")
    return term(maps, name)


def _limits(
    fields: Mapping[str, xr.DataArray],
    terms: Mapping[str, Term],
    given: Mapping[str, tuple[float, float]] | tuple[float, float] | None,
) -> dict[str, tuple[float, float]]:
    """Colour limits by scale."""
    found: dict[str, tuple[float, float]] = {}
    for what in terms.values():
        if not what.has_limits:
            continue
        same = {n: fields[n] for n, t in terms.items() if t.scale == what.scale}
        found[what.scale] = common_limits(same, what.colours)
        if isinstance(given, Mapping):
            chosen = [given[n] for n in same if n in given]
            found[what.scale] = chosen[0] if chosen else found[what.scale]
        elif given is not None:
            found[what.scale] = given
    return {scale: _checked(pair) for scale, pair in found.items()}


def _checked(limits: object) -> tuple[float, float]:
    """Return limits of the colours, or refuse what are none."""
    try:
        low, high = map(float, limits)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        low = high = np.nan
    if not (np.isfinite([low, high]).all() and low < high):
        found = in_words(limits) if np.isnan([low, high]).any() else f"{low:g} and {high:g}"
        raise InputError(f"limits: lowest and highest value, such as -5 and 0, not {found}")
    return low, high


def plot_map(result: StressResult, name: str, axes: Axes | None = None, **options: Any) -> Axes:
    """Draw one map of a result into axes, those of a new pyplot figure by default.

    `options` are those of :func:`draw_map`.

    Raises
    ------
    InputError
        If there is no such map, or an option cannot be used.
    """
    known = {"limits", "colours", "scale_bar", "colour_bar", "regions"}
    if unknown := set(options) - known:
        raise InputError(f"{', '.join(sorted(unknown))}: options are {', '.join(sorted(known))}")
    maps = in_percent(result.maps)
    what = _known_term(maps, name)
    if axes is not None:
        from matplotlib.axes import Axes as Matplotlib

        check_instance(axes, Matplotlib, "ax", "matplotlib axes")
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.figure(layout="constrained").subplots()
    (field,) = finest(maps, result.pixels, [name]).values()
    draw_map(axes, field, what, **options)
    return axes
