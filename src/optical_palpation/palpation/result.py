"""The common result of the algebraic and the computational method."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from optical_palpation.arguments import check_instance, explained, in_words
from optical_palpation.errors import InputError
from optical_palpation.mechanics.problem import LayerProblem, LayerState

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from optical_palpation.analysis import Region


class ContactState(IntEnum):
    """State of a surface point in the ``contact_state`` maps: 0 open, 1 slip, 2 stick, 3 glued."""

    OPEN = 0
    SLIP = 1
    STICK = 2
    GLUED = 3


#: What the numbers of ``contact_state`` maps mean, as CF has it: values of the type of the maps.
CONTACT_FLAGS = {
    "flag_values": np.array(list(ContactState), dtype=np.int8),
    "flag_meanings": " ".join(state.name.lower() for state in ContactState),
}


class Status(StrEnum):
    """How a solution ended, as the attribute ``status`` says; of tiles, the worst of them."""

    CONVERGED = "converged"
    NEARLY = "nearly converged"
    COARSE_EDGES = "converged with coarse free edges"
    COARSER = "converged on coarser elements"
    INCOMPLETE = "incomplete"


@dataclass(frozen=True, repr=False)
class StressResult:
    """Tactile stress as maps in the frame of the imaging system, and the layer behind them.

    The methods call :mod:`optical_palpation.analysis` and :mod:`optical_palpation.present`, which
    can do more.

    Attributes
    ----------
    maps
        Variables on ``(y, x)``, laboratory coordinates in mm, stress in kPa (tension positive):
        ``axial_stress``, ``contact_pressure`` (compression positive; negative where a glued sample
        pulls), ``traction_x``, ``traction_y``, ``traction_z``, ``contact_state`` and
        ``window_contact_state`` (:class:`ContactState`),
        ``loaded_thickness`` (mm), ``algebraic_axial_stress``, ``edge_influence`` (fraction of the
        contact pressure by which other sides of the layer would change it; NaN where the coarse
        solutions behind it did not arrive). The attributes hold the total forces
        ``window_force_mN`` and ``sample_force_mN``, all parameters, the convergence record, and of
        the sides ``edge_influence_fraction`` (of the field, where it is above 5 %) and
        ``edge_influence_force`` (change of the force), or ``edge_influence_unknown`` (why).
        The algebraic method fills only ``axial_stress`` (equal to ``algebraic_axial_stress``),
        and ``loaded_thickness``: it knows no contact.
    layer
        The deformed layer on its own (reference) grid, or ``None`` for the algebraic method.
        Node variables on ``(z, y, x)``: ``position`` and ``displacement`` (trailing dimension
        ``component`` = x, y, z; mm; z = 0 at the window). Element means on
        ``(cell_z, cell_y, cell_x)``: ``cauchy_stress`` (trailing dimension ``tensor`` =
        xx, yy, zz, yz, xz, xy; kPa). Surface node variables on ``(y, x)``: ``sample_traction``
        and ``window_traction`` (trailing ``component``; kPa per deformed area),
        ``sample_contact_state``, ``window_contact_state``.
    pixels
        What the algebraic method makes of the pixels that were given, on their ``(y, x)``:
        ``algebraic_axial_stress`` (kPa) and ``loaded_thickness`` (mm); ``None`` where the maps lie
        on these pixels themselves.
    sensitivities
        Derivatives by each ``input``, per its ``unit``: ``force`` (mN) and ``axial_stress`` (kPa,
        on ``(input, y, x)``); ``None`` where they were not computed.
    series
        Of several loads: the maps of each, on ``(load, y, x)``, its forces and the ``compression``
        (mm); ``None`` of one load. ``maps`` are those of the last one.
    problem
        The boundary-value problem that was solved, for export to other codes; ``None`` for the
        algebraic method.
    state
        The state of that problem at full load; likewise ``None``.
    """

    maps: xr.Dataset
    layer: xr.Dataset | None = None
    pixels: xr.Dataset | None = field(default=None, kw_only=True)
    sensitivities: xr.Dataset | None = field(default=None, kw_only=True, repr=False)
    series: xr.Dataset | None = field(default=None, kw_only=True, repr=False)
    problem: LayerProblem | None = None
    state: LayerState | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        whole = isinstance(self.maps, xr.Dataset) and "axial_stress" in self.maps
        if not whole:
            raise InputError(
                "maps: an xarray.Dataset on (y, x) with axial_stress in kPa, not "
                f"{in_words(self.maps)}"
            )

    # What follows only hands on. The packages it calls are built on this one, hence they are
    # imported where they are needed.

    def __repr__(self) -> str:
        from optical_palpation.present.summary import (
            force_error,
            mean_stress,
            mean_stress_error,
            touching_share,
        )
        from optical_palpation.present.terms import percent, plain, rounded

        stress = self.maps["axial_stress"]
        parts = [f"{' x '.join(map(str, stress.shape))} points"]
        if (force := self.maps.attrs.get("sample_force_mN")) is not None:
            parts.append(f"force {rounded(force, force_error(self.maps.attrs))} mN")
        mean = rounded(mean_stress(self.maps), mean_stress_error(self.maps))
        parts.append(f"mean axial stress {mean} kPa")
        if "contact_state" in self.maps:
            parts.append(f"in contact {percent(touching_share(self.maps))}")
        method = self.maps.attrs.get("method", "unknown method")
        return plain(f"<StressResult, {method}: {', '.join(parts)}>")

    def _repr_html_(self) -> str:
        from optical_palpation.present.notebook import result_html

        return result_html(self)

    def plot(self, name: str = "axial_stress", *, ax: Axes | None = None, **options: Any) -> Axes:
        """Draw a map.

        Parameters
        ----------
        name
            Which of the maps.
        ax
            Matplotlib axes; those of a new figure by default.
        options
            ``limits``, ``colours``, ``scale_bar``, ``colour_bar`` and ``regions``, as for
            :func:`~optical_palpation.present.write_maps`.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            If there is no such map, or an option cannot be used.
        """
        from optical_palpation.present.figure import plot_map

        return plot_map(self, name, ax, **options)

    @explained
    def profile(
        self, line: str | Sequence[Sequence[float]] = "x", width: float = 0.0
    ) -> xr.Dataset:
        """Read the maps along a line.

        Parameters
        ----------
        line
            Its ends, ((x, y), (x, y)) in mm; or ``"x"`` or ``"y"``, through the centre.
        width
            Average over a band of this width about it, mm.

        Returns
        -------
        xarray.Dataset
            As from :func:`~optical_palpation.analysis.line_profile`.

        Raises
        ------
        InputError
            If it is no such line, or misses the maps.
        """
        from optical_palpation.analysis import line_profile

        if isinstance(line, str):
            if line not in ("x", "y"):
                raise InputError(f"line: 'x', 'y' or two points (x, y) in mm, not {line!r}")
            x, y = (self.maps[axis].values for axis in "xy")
            middle = (x[0] + x[-1]) / 2, (y[0] + y[-1]) / 2
            line = (
                ((x[0], middle[1]), (x[-1], middle[1]))
                if line == "x"
                else ((middle[0], y[0]), (middle[0], y[-1]))
            )
        try:
            start, end = line
        except (TypeError, ValueError):
            raise InputError(
                f"line: 'x', 'y' or two points ((x, y), (x, y)) in mm, not {line!r}"
            ) from None
        return line_profile(self.maps, start, end, width)

    @explained
    def regions(
        self,
        regions: Region | Sequence[Region] | str | os.PathLike[str],
        variable: str = "axial_stress",
        background: Any = "rest",
    ) -> xr.Dataset:
        """Tell what a map says in regions of interest.

        Parameters
        ----------
        regions
            A region, several, or a file of them (:func:`~optical_palpation.analysis.read_regions`).
        variable, background
            As for :func:`~optical_palpation.analysis.region_statistics`.

        Returns
        -------
        xarray.Dataset
            As from that function; ``.to_dataframe()`` makes a table of it.

        Raises
        ------
        InputError
            If the regions cannot be read or do not fit.
        """
        from optical_palpation.analysis import Region, read_regions, region_statistics

        if isinstance(regions, str | os.PathLike):
            regions = read_regions(regions, self.maps)
        elif isinstance(regions, Region):
            regions = [regions]
        return region_statistics(self.maps, regions, variable, background)

    @explained
    def compare(
        self, other: StressResult, variable: str = "axial_stress", *, register: bool = False
    ) -> xr.Dataset:
        """Compare with another result, on the points of this one.

        Parameters
        ----------
        other
            The other result; its difference from this one is what is found.
        variable, register
            As for :func:`~optical_palpation.analysis.compare_results`.

        Returns
        -------
        xarray.Dataset
            As from that function, for the results ``this`` and ``other``.

        Raises
        ------
        InputError
            If the two cannot be compared.
        """
        from optical_palpation.analysis import compare_results

        check_instance(other, StressResult, "other", "a StressResult (op.read_result reads one)")
        pair = {"this": self.maps, "other": other.maps}
        return compare_results(pair, variable, register=register)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file of the kind that its name's ending says.

        ``.nc`` keeps all of it, :func:`~optical_palpation.present.read_result` reads it back, with
        the problem and its state. The rest is listed at
        :func:`~optical_palpation.present.write`.

        Raises
        ------
        OutputError
            If there is no such kind, or the file cannot be written.
        """
        from optical_palpation.present import write

        write(self, path)
