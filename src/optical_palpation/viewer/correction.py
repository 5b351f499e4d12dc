"""Part of the panel: corrections with the mouse, as the file of corrections holds them."""

from __future__ import annotations

from typing import Any

import numpy as np
from qtpy.QtWidgets import QComboBox, QFileDialog, QFormLayout, QGroupBox, QPushButton

from optical_palpation.errors import OpticalPalpationError
from optical_palpation.thickness import Corrections, read_corrections, write_corrections
from optical_palpation.viewer.buttons import button_row
from optical_palpation.viewer.layers import (
    COLOURS,
    anchor_layer,
    corrections_from,
    exclusion_layer,
)
from optical_palpation.viewer.measurement import show_found
from optical_palpation.viewer.session import SIDES
from optical_palpation.viewer.workbench import Workbench

#: What is moved with the mouse moves further, and what is drawn rounds by less, samples.
_UNMOVED = 1e-3


class Correction(QGroupBox):
    """Anchors on B-scans, excluded rectangles on maps, and finding the layer again."""

    def __init__(self, bench: Workbench) -> None:
        super().__init__("Correct the boundaries")
        self._bench = bench
        form = QFormLayout(self)
        self.side, self.boundary = QComboBox(), QComboBox()
        self.side.addItems(["loaded", "unloaded"])
        self.boundary.addItems(["sample", "window"])
        self.boundary.currentTextChanged.connect(self._choose)
        form.addRow("volume", self.side)
        form.addRow("boundary", self.boundary)
        row = button_row(
            ("Set anchors", "click on a B-scan where the boundary passes", self.draw_anchors),
            ("Exclude", "draw rectangles on a map where the boundary is not seen", self.exclude),
        )
        form.addRow(row)
        self.again = QPushButton("Find again")
        self.again.setToolTip("only what the corrections change")
        self.again.clicked.connect(lambda: self.find_again())
        form.addRow(self.again)
        row = button_row(("Load…", "", self._ask_to_load), ("Save…", "", self._ask_to_save))
        form.addRow("file", row)
        bench.found.connect(self._show)

    def draw_anchors(self) -> None:
        """Let the mouse set anchors on the B-scans."""
        side = self.side.currentText()
        if self._ready(side):
            self._bench.view_bscans(side)
            self._begin(self._layer("anchors", side), "add")

    def exclude(self) -> None:
        """Let the mouse draw excluded rectangles on the maps."""
        side = self.side.currentText()
        if self._ready(side):
            self._bench.view_maps([f"{side}: Thickness of the layer (mm)"])
            self._begin(self._layer("excluded", side), "add_rectangle")

    def drawn(self, side: str) -> Corrections:
        """Corrections as they are drawn now.

        Raises
        ------
        InputError
            If one lies outside of the volume.
        """
        anchors, excluded = (self._layer(kind, side) for kind in ("anchors", "excluded"))
        return corrections_from(
            anchors.data,
            list(anchors.features["boundary"]),
            excluded.data,
            list(excluded.features["boundary"]),
            self._bench.session.frame(side),
        )

    def apply(self) -> None:
        """Put what is drawn into the study.

        Raises
        ------
        InputError
            If something lies outside of its volume.
        """
        bench = self._bench
        for side in SIDES:
            if not any(list(bench.layers(kind, side)) for kind in ("anchors", "excluded")):
                continue
            drawn = self.drawn(side)
            within = _UNMOVED * min(bench.session.frame(side).spacing)
            if not _are_same(drawn, bench.session.corrections.get(side, Corrections()), within):
                bench.session.corrections[side] = drawn

    def find_again(self) -> None:
        """Find anew what the corrections of this volume change."""
        bench, side = self._bench, self.side.currentText()
        if not self._ready(side):
            return
        try:
            self.apply()
        except OpticalPalpationError as error:
            bench.said.emit(str(error))
            return
        session = bench.session
        bench.background.run(
            lambda tell: session.find(side, tell), lambda found: show_found(bench, side, found)
        )

    def load(self, path: str) -> None:
        """Take the corrections of a file for those of the chosen volume.

        Raises
        ------
        InputError
            If they cannot be read, or lie outside of the volume.
        """
        side = self.side.currentText()
        frame = self._bench.session.frame(side)
        corrections = read_corrections(path)
        corrections.check_inside(frame.origin, frame.spacing, frame.shape)
        self._replace(side, corrections)

    def save(self, path: str) -> None:
        """Write the corrections of the chosen volume, for ``optical-palpation thickness`` too.

        Raises
        ------
        InputError, OutputError
            If one lies outside of the volume, or the file cannot be written.
        """
        write_corrections(self.drawn(self.side.currentText()), path)

    def _begin(self, layer: Any, mode: str) -> None:
        self._bench.viewer.layers.selection.active = layer
        layer.mode = mode
        self._choose()

    def _choose(self) -> None:
        """Let what is drawn next belong to the chosen boundary."""
        boundary = self.boundary.currentText()
        for kind in ("anchors", "excluded"):
            for layer in self._bench.layers(kind):
                layer.selected_data = set()  # else the features of these would change
                if kind == "anchors":
                    layer.current_face_color = COLOURS[boundary]
                else:
                    layer.current_edge_color = COLOURS[boundary]
                layer.feature_defaults = {"boundary": boundary}

    def _ready(self, side: str) -> bool:
        try:
            self._bench.session.frame(side)
        except OpticalPalpationError as error:
            self._bench.said.emit(str(error))
            return False
        return True

    def _layer(self, kind: str, side: str) -> Any:
        """The layer to draw on; a new one where it was removed in napari.

        Raises
        ------
        InputError
            If the layer has not been found in the volume yet.
        """
        bench = self._bench
        if not list(bench.layers(kind, side)):
            none, frame = Corrections(), bench.session.frame(side)
            anchors = kind == "anchors"
            bench.show(
                [anchor_layer(none, frame, side) if anchors else exclusion_layer(none, frame, side)]
            )
        return next(bench.layers(kind, side))

    def _show(self, side: str) -> None:
        """Make the layers to draw on, once the layer has been found."""
        if not list(self._bench.layers("anchors", side)):
            self._replace(side, self._bench.session.corrections.get(side, Corrections()))

    def _replace(self, side: str, corrections: Corrections) -> None:
        bench = self._bench
        for kind in ("anchors", "excluded"):
            for layer in list(bench.layers(kind, side)):
                bench.viewer.layers.remove(layer)
        frame = bench.session.frame(side)
        bench.show(
            [anchor_layer(corrections, frame, side), exclusion_layer(corrections, frame, side)]
        )
        self._choose()

    def _ask_to_load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Corrections", filter="*.txt;;*")
        self._bench.attempt(self.load, path)

    def _ask_to_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Corrections", "corrections.txt")
        self._bench.attempt(self.save, path)


def _are_same(drawn: Corrections, given: Corrections, within: float) -> bool:
    """Whether nothing was drawn, moved or deleted; a position in samples is rounded."""
    pairs = list(zip(drawn, given, strict=False))
    return (len(drawn.anchors), len(drawn.exclusions)) == (
        len(given.anchors),
        len(given.exclusions),
    ) and all(a[0] == b[0] and np.allclose(a[1:], b[1:], 0.0, within) for a, b in pairs)
