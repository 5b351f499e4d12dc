"""Part of the panel: which volumes, how the layer shows in them, and finding it."""

from __future__ import annotations

import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any

from napari.layers import Image
from qtpy.QtCore import Signal
from qtpy.QtWidgets import (
    QComboBox,
    QFileDialog,
    QFormLayout,
    QGroupBox,
    QHBoxLayout,
    QLineEdit,
    QPushButton,
    QWidget,
)
from superqt import QCollapsible

from optical_palpation.errors import InputError
from optical_palpation.study.reading import as_toml
from optical_palpation.viewer.layers import KEY, boundary_layers, map_layers, volume_layer
from optical_palpation.viewer.numbers import Number
from optical_palpation.viewer.session import SIDES
from optical_palpation.viewer.workbench import Workbench
from optical_palpation.volume import open_volume

#: Keys of a study file that tell what a file does not say of itself.
_HOW = {
    "axes": ("yzx", "order of the axes, slowest first"),
    "spacing": ("{ z = 0.0035, y = 0.01, x = 0.01 }", "mm between samples"),
    "scale": ("linear", "linear (amplitude, intensity) or dB"),
    "refractive_index": ("1.4", "where the depth is an optical path"),
    "variable": ("", "name of the array, of several"),
}
_NUMBER = "a thickness"
_EDGES = ("x0", "x1", "y0", "y1")
_MAPS = ("thickness", "quality", "filled")


class Measurement(QGroupBox):
    """Inputs of the study, and the layer in them."""

    #: The extent of the layer was typed.
    changed = Signal()

    def __init__(self, bench: Workbench) -> None:
        super().__init__("Measurement")
        self._bench = bench
        form = QFormLayout(self)
        self.how = {key: QLineEdit() for key in _HOW}
        opened = QPushButton("Open volume…")
        opened.setToolTip("A volume that does not say enough about itself: fill in what it lacks")
        opened.clicked.connect(self._ask_for_volume)
        form.addRow(opened)
        unsaid = QWidget()
        fields = QFormLayout(unsaid)
        for key, (example, meaning) in _HOW.items():
            self.how[key].setPlaceholderText(example)
            self.how[key].setToolTip(f"{meaning}; only where the file does not say")
            fields.addRow(key.replace("_", " "), self.how[key])
        self.folded = QCollapsible("What the file does not say")
        self.folded.addWidget(unsaid)
        form.addRow(self.folded)
        self.choice = {side: QComboBox() for side in SIDES}
        self.thickness = Number(0.0, 100.0, (0.0, 2.0), "mm", 4)
        form.addRow("loaded", self.choice["loaded"])
        form.addRow("unloaded", self.choice["unloaded"])
        form.addRow("  thickness", self.thickness)
        self.window_edge, self.sample_edge = QComboBox(), QComboBox()
        self.window_edge.addItems(["line", "fall", "rise"])
        self.window_edge.setEditable(True)
        self.window_edge.setToolTip(
            "how the window side shows: a bright line, a fall from bright to dark; or its depth "
            "in mm where it is known"
        )
        self.sample_edge.addItems(["rise", "line", "fall"])
        self.sample_edge.setToolTip("how the sample side shows: a rise to scattering, or a line")
        self._shown_edges = self._edges()
        form.addRow("window side", self.window_edge)
        form.addRow("sample side", self.sample_edge)
        self.extent = {edge: QLineEdit() for edge in _EDGES}
        row = QHBoxLayout()
        for edge, field in self.extent.items():
            field.setPlaceholderText(edge)
            field.setToolTip(
                "where the layer itself begins and ends, mm: what the volumes show beyond it is "
                "left out of the stress; empty for a layer that fills the field of view"
            )
            field.editingFinished.connect(self.changed.emit)
            row.addWidget(field)
        form.addRow("extent (mm)", row)
        row = QHBoxLayout()
        self.find_button = QPushButton("Find the layer")
        self.find_button.clicked.connect(lambda: self.find_layer())
        self.side = QComboBox()
        self.side.addItems(["loaded", "unloaded"])
        bscans, maps = QPushButton("B-scans"), QPushButton("Maps")
        bscans.setToolTip("show the B-scans of the volume, with the boundaries")
        maps.setToolTip("show the maps, seen along the light")
        bscans.clicked.connect(lambda: bench.view_bscans(self.side.currentText()))
        maps.clicked.connect(
            lambda: bench.view_maps(first=f"{self.side.currentText()}: Thickness of the layer (mm)")
        )
        for part in (self.side, bscans, maps):
            row.addWidget(part)
        form.addRow(self.find_button)
        form.addRow("show", row)
        bench.opened.connect(self._show)
        self.choice["unloaded"].currentIndexChanged.connect(lambda _: self._enable())
        for event in ("inserted", "removed"):
            getattr(bench.viewer.layers.events, event).connect(lambda _: self._list())
        self._list()

    def open(self, path: str) -> None:
        """Open a volume as the fields above describe it.

        Raises
        ------
        InputError
            If it cannot be read, or does still not say enough.
        """
        how = self._given()
        volume = open_volume(path, **how)
        (shown,) = self._bench.show([volume_layer(volume, path, how)])
        self._bench.view_volume(shown)
        self._bench.said.emit(f"opened {Path(path).name}")

    def apply(self) -> None:
        """Put what is chosen into the study.

        Raises
        ------
        InputError
            If the loaded layer has not been chosen, or its extent is no four numbers.
        """
        session = self._bench.session
        extent = self._extent()
        if extent != session.tables.get("layer", {}).get("extent"):
            session.change({"layer.extent": extent})
        edges = self._edges()
        for side in reversed(SIDES):  # the loaded layer first: without it there is no study
            chosen = self.choice[side].currentData()
            if chosen == _NUMBER:
                value = self.thickness.value()
                if value is None or value == 0:
                    raise InputError("give the thickness of the unloaded layer in mm, or a volume")
                session.change({side: {"thickness": value}})
            elif isinstance(chosen, dict):
                other = session.input(side).get("volume") != chosen["volume"]
                if other:
                    session.change({side: dict(chosen)})
                    session.corrections.pop(side, None)
                    self._bench.forget_found(side)
                before = session.input(side)
                # the fields show the loaded volume; what the study says of the other one stays
                # until they are changed
                typed = {k: v for k, v in edges.items() if other or v != self._shown_edges[k]}
                session.change(
                    {f"{side}.{k}": v for k, v in typed.items() if before.get(k, _USUAL[k]) != v}
                )
            elif not session.input(side):
                raise InputError(f"choose the {side} layer: {self._how_to_choose()}")
        self._shown_edges = edges

    def find_layer(self) -> None:
        """Find the layer in the volumes of the study, and show it."""
        bench = self._bench
        try:
            self.apply()
        except InputError as error:
            bench.said.emit(str(error))
            return
        sides = [side for side in reversed(SIDES) if "volume" in bench.session.input(side)]
        if not sides:
            bench.said.emit("the study starts from maps of the thickness: there is nothing to find")
            return

        def then(found: dict[str, Any]) -> None:
            with bench.at_once():
                for side, layer in found.items():
                    show_found(bench, side, layer)
            if found:
                bench.view_bscans(next(iter(found)))

        session = bench.session
        bench.background.run(lambda tell: {side: session.find(side, tell) for side in sides}, then)

    def _how_to_choose(self) -> str:
        """What to do for a volume to be listed."""
        foreign = [
            layer.name
            for layer in self._bench.viewer.layers
            if isinstance(layer, Image) and layer.ndim > 2 and KEY not in layer.metadata
        ]
        if not foreign:
            return "drop its volume on napari first"
        self.folded.expand()
        return (
            f"{', '.join(foreign)} came by another reader of napari, which does not say in mm "
            "where the samples lie; give what the file does not say above, then 'Open volume'"
        )

    def _extent(self) -> list[float] | None:
        """Where the layer lies, x0, x1, y0, y1 in mm; None for the whole field of view."""
        texts = [field.text().strip() for field in self.extent.values()]
        if not any(texts):
            return None
        try:
            return [float(text) for text in texts]
        except ValueError:
            raise InputError(
                f"the extent of the layer is four numbers of mm, {', '.join(_EDGES)}, or empty for "
                f"the whole field of view; found {', '.join(text or 'nothing' for text in texts)}"
            ) from None

    def _edges(self) -> dict[str, str | float]:
        """How both sides of the layer show, as the fields say."""
        window: str | float = self.window_edge.currentText()
        with suppress(ValueError):  # a word
            window = float(window)
        return {"window": window, "sample": self.sample_edge.currentText()}

    def _given(self) -> dict[str, Any]:
        how: dict[str, Any] = {}
        for key, field in self.how.items():
            if text := field.text().strip():
                try:
                    how[key] = tomllib.loads(f"value = {text}")["value"]
                except tomllib.TOMLDecodeError:
                    how[key] = text
        return how

    def _ask_for_volume(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "OCT volume")
        if not self._bench.attempt(self.open, path):
            self.folded.expand()

    def _list(self) -> None:
        """Offer the volumes that napari shows; keep what was chosen."""
        volumes = list(self._bench.layers("volume"))
        for side, box in self.choice.items():
            given = self._bench.session.input(side)
            chosen = box.currentData() or ({"volume": given["volume"]} if "volume" in given else "")
            if chosen == _NUMBER and self.thickness.value() is None:
                chosen = ""  # there was nothing else to choose
            file = chosen.get("volume") if isinstance(chosen, dict) else None
            box.blockSignals(True)
            box.clear()
            for layer in volumes:
                box.addItem(layer.name, layer.metadata[KEY]["input"])
            if "map" in given:
                box.addItem(self._bench.title(given), "map")
            if side == "unloaded":
                box.addItem(_NUMBER, _NUMBER)
            entries = [box.itemData(k) for k in range(box.count())]
            same = [
                k
                for k, entry in enumerate(entries)
                if entry == chosen or (isinstance(entry, dict) and entry["volume"] == file)
            ]
            named = [k for k in range(box.count()) if _named(side, box.itemText(k))]
            # One that is called after the other side was taken because there was none else.
            other = next(it for it in SIDES if it != side)
            named_other = bool(same) and _named(other, box.itemText(same[0]))
            first = named + same if named_other else same + named
            # A volume that is not called so is not taken for the unloaded one.
            box.setCurrentIndex(first[0] if first else max(box.findData(_NUMBER), 0))
            box.blockSignals(False)
        self._enable()

    def _enable(self) -> None:
        """Let a thickness be typed where it counts."""
        self.thickness.setEnabled(self.choice["unloaded"].currentData() == _NUMBER)

    def _show(self) -> None:
        """Show what another study says."""
        for box in self.choice.values():
            box.clear()
        self._list()
        session = self._bench.session
        unloaded = session.input("unloaded")
        if "thickness" in unloaded:
            box = self.choice["unloaded"]
            box.setCurrentIndex(box.findData(_NUMBER))
            self.thickness.set(unloaded["thickness"])
        if "map" in unloaded:
            self.choice["unloaded"].setCurrentIndex(self.choice["unloaded"].findData("map"))
        loaded = session.input("loaded")
        self.window_edge.setCurrentText(str(loaded.get("window", _USUAL["window"])))
        self.sample_edge.setCurrentText(loaded.get("sample", _USUAL["sample"]))
        self._shown_edges = self._edges()
        extent = session.tables.get("layer", {}).get("extent") or [""] * len(_EDGES)
        for field, value in zip(self.extent.values(), extent, strict=True):
            field.setText(str(value))
        for key, field in self.how.items():
            field.setText(as_toml(loaded[key]).strip('"') if key in loaded else "")


_USUAL = {"window": "line", "sample": "rise"}


def _named(side: str, name: str) -> bool:
    loaded = "unloaded" not in name.lower() and "loaded" in name.lower()
    return loaded if side == "loaded" else "unloaded" in name.lower()


def show_found(bench: Workbench, side: str, found: Any) -> None:
    """Show the layer that was found in a volume."""
    bench.seen[side] = found
    bench.show(boundary_layers(found, bench.session.frame(side), side))
    maps = map_layers(found, f"{side}: ", only=_MAPS)
    for layer in maps:  # they would cover the B-scans
        layer.keywords["visible"] = False
    bench.show(maps)
    bench.found.emit(side)
