"""Part of the panel: regions of interest, drawn on the maps, and what the maps say there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import (
    QAbstractItemView,
    QComboBox,
    QFileDialog,
    QGroupBox,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
)

from optical_palpation.analysis import (
    Region,
    read_regions,
    region_statistics,
    traced,
    write_regions,
)
from optical_palpation.errors import InputError
from optical_palpation.present.tables import region_figure, write_table
from optical_palpation.present.terms import is_map, rounded, term
from optical_palpation.viewer.buttons import button_row
from optical_palpation.viewer.layers import free_name, region_layer, regions_from, whole_of
from optical_palpation.viewer.workbench import Workbench

_COLUMNS = {
    "mean": "mean",
    "mean_error": "mean ±",
    "minimum": "lowest",
    "maximum": "highest",
    "force": "force",
    "force_error": "force ±",
    "contrast": "contrast",
    "area": "area",
}
_WAIT = 200  # ms


class Regions(QGroupBox):
    """A table of what a map says in the shapes that are drawn on it."""

    def __init__(self, bench: Workbench) -> None:
        super().__init__("Regions of interest")
        self._bench = bench
        box = QVBoxLayout(self)
        self.variable = QComboBox()
        self.variable.currentIndexChanged.connect(lambda _: self.update_table())
        box.addWidget(self.variable)
        row = button_row(
            ("Draw", "draw rectangles, ellipses or polygons on a map", self.draw),
            ("Name", "call the chosen shapes by the text below", self.name_selected),
        )
        self.name = QComboBox()
        self.name.setEditable(True)
        row.addWidget(self.name)
        box.addLayout(row)
        self.table = QTableWidget(0, len(_COLUMNS))
        self.table.setHorizontalHeaderLabels(list(_COLUMNS.values()))
        self.table.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.table.setMinimumHeight(110)
        box.addWidget(self.table)
        box.addLayout(
            button_row(
                ("Load…", "regions of ImageJ, napari, masks or outlines", self._ask_to_load),
                (
                    "Save regions…",
                    "outlines, for 'optical-palpation regions'",
                    self._ask_for_regions,
                ),
                ("Save table…", "CSV", self._ask_for_table),
            )
        )
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(_WAIT)
        self._timer.timeout.connect(self.update_table)
        bench.solved.connect(self._list)
        bench.opened.connect(self._list)
        bench.viewer.layers.events.inserted.connect(lambda event: self._watch(event.value))

    def draw(self, mode: str = "add_rectangle") -> None:
        """Let the mouse draw regions."""
        bench = self._bench
        if bench.result is None:
            bench.said.emit("solve first: regions are drawn on the stress")
            return
        if not list(bench.layers("regions")):
            bench.show([region_layer(bench.result.maps)])
        bench.view_maps([term(bench.result.maps, self.variable.currentData()).label])
        layer = next(bench.layers("regions"))
        bench.viewer.layers.selection.active = layer
        layer.mode = mode

    def regions(self) -> list[Region]:
        """The regions that are drawn.

        Raises
        ------
        InputError
            If there is none.
        """
        layer = next(self._bench.layers("regions"), None)
        if layer is None:
            raise InputError("there are no regions yet")
        features = layer.features
        wholes = list(features.get("part of", ()))  # a layer made in napari has none
        return regions_from(layer.data, layer.shape_type, list(features["name"]), wholes)

    def name_selected(self) -> None:
        """Give the shapes that are chosen in napari the name that was typed."""
        layer = next(self._bench.layers("regions"), None)
        if layer is not None and layer.selected_data:
            features = layer.features.copy()
            features.loc[list(layer.selected_data), "name"] = self.name.currentText()
            layer.features = features
            layer.refresh_text()
            self.update_table()

    def update_table(self) -> None:
        """Read the map in the regions."""
        result, variable = self._bench.result, self.variable.currentData()
        self._bench.ink_names()
        self.table.setRowCount(0)
        if result is None or variable is None:
            return
        try:
            regions = self.regions()
        except InputError:
            return
        try:
            found = region_statistics(result.maps, regions, variable)
        except InputError as error:
            self._bench.said.emit(str(error))
            return
        columns = [name for name in _COLUMNS if name in found]
        self.table.setColumnCount(len(columns))
        units = [str(found[name].attrs.get("units", "1")) for name in columns]
        self.table.setHorizontalHeaderLabels(
            [f"{_COLUMNS[n]}\n({u})" if u not in ("1", "") else _COLUMNS[n]
             for n, u in zip(columns, units, strict=True)]
        )  # fmt: skip
        self.table.setRowCount(found.sizes["region"])
        self.table.setVerticalHeaderLabels([str(name) for name in found["region"].values])
        for row in range(found.sizes["region"]):
            for column, name in enumerate(columns):
                self.table.setItem(row, column, QTableWidgetItem(_cell(found, name, row)))
        self.table.resizeColumnsToContents()

    def load(self, path: str) -> None:
        """Add the regions of a file to those that are drawn; masks get outlines.

        Raises
        ------
        InputError
            If it cannot be read, or there is no stress yet.
        """
        bench = self._bench
        if bench.result is None:
            raise InputError("solve first: regions are drawn on the stress")
        maps = bench.result.maps
        regions = [self._outlined(region) for region in read_regions(path, maps)]
        layer = next(bench.layers("regions"), None)
        if layer is None:
            bench.show([region_layer(maps)])
            layer = next(bench.layers("regions"))
        self._append(layer, regions)
        self.update_table()

    def _outlined(self, region: Region) -> Region:
        """A region that can be drawn on."""
        if region.mask is None:
            return region
        like = self._bench.result.maps["axial_stress"]  # type: ignore[union-attr]
        outlined = traced(region)
        same = np.isclose(outlined.weights(like), region.weights(like), atol=1e-6)
        if not same.all():
            self._bench.said.emit(
                f"{region.name}: the outline of this mask holds {np.count_nonzero(~same)} of "
                f"{same.size} pixels otherwise than the mask does"
            )
        return outlined

    def _append(self, layer: Any, regions: Sequence[Region]) -> None:
        """Draw regions beside those that are there, under names of their own."""
        count = len(layer.data)
        try:
            taken = {region.name for region in self.regions()}
        except InputError:
            taken = set()
        taken |= {str(it) for it in layer.features.get("part of", ())}
        shown = []
        for region in regions:
            shown.append(Region(free_name(region.name, taken), region.outlines))
            taken.add(shown[-1].name)
        layer.selected_data = set()  # else the features of these would change
        layer.add_polygons([outline[:, ::-1] for it in shown for outline in it.outlines])
        features = layer.features.copy()
        new = slice(count, None)
        features.loc[new, "name"] = [it.name for it in shown for _ in it.outlines]
        features.loc[new, "part of"] = [whole_of(it) for it in shown for _ in it.outlines]
        layer.features = features
        layer.refresh_text()

    def save_regions(self, path: str) -> None:
        """Write the outlines of the regions, which :func:`read_regions` reads.

        Raises
        ------
        InputError, OutputError
            If there is none, or the file cannot be written.
        """
        write_regions(self.regions(), path)

    def save_table(self, path: str) -> None:
        """Write the table as CSV.

        Raises
        ------
        InputError, OutputError
            If there is no region or no stress, or the file cannot be written.
        """
        if self._bench.result is None:
            raise InputError("solve first: there is no stress yet")
        maps = self._bench.result.maps
        write_table(region_statistics(maps, self.regions(), self.variable.currentData()), path)

    def _list(self) -> None:
        """Offer the maps of the result."""
        result = self._bench.result
        before = self.variable.currentData()
        self.variable.blockSignals(True)
        self.variable.clear()
        if result is not None:
            names = [str(n) for n in result.maps.data_vars if is_map(result.maps[n])]
            for name in names:
                about = term(result.maps, name)
                if about.has_limits:
                    self.variable.addItem(about.label, name)
            at = self.variable.findData(before or "axial_stress")
            self.variable.setCurrentIndex(max(at, 0))
        self.variable.blockSignals(False)
        self.update_table()

    def _watch(self, layer: object) -> None:
        """Keep the table true to what is drawn."""
        if layer in list(self._bench.layers("regions")):
            layer.events.data.connect(lambda _: self._timer.start())  # type: ignore[attr-defined]

    def _ask_to_load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(
            self, "Regions", filter="*.roi *.zip *.csv *.tif *.tiff *.png *.npy;;*"
        )  # fmt: skip
        self._bench.attempt(self.load, path)

    def _ask_for_regions(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Regions", "regions.csv")
        self._bench.attempt(self.save_regions, path)

    def _ask_for_table(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Table", "table.csv")
        self._bench.attempt(self.save_table, path)


def _cell(found: xr.Dataset, name: str, row: int) -> str:
    """A number to the digits that its error leaves; an error to two."""
    value = float(found[name][row])
    if not np.isfinite(value):
        return ""
    if name.endswith("_error"):
        return rounded(value, digits=2)
    return region_figure(found.isel(region=row), name).partition(" ")[0]
