"""Part of the panel: material, friction and elements, and the stress that follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qtpy.QtCore import Qt, QTimer
from qtpy.QtGui import QResizeEvent
from qtpy.QtWidgets import (
    QCheckBox,
    QComboBox,
    QFileDialog,
    QFormLayout,
    QGroupBox,
    QHBoxLayout,
    QLabel,
    QPushButton,
)

from optical_palpation.analysis import compare_results
from optical_palpation.arguments import LARGEST_FRICTION
from optical_palpation.errors import InputError, OpticalPalpationError
from optical_palpation.palpation.result import StressResult
from optical_palpation.present import read_result
from optical_palpation.present.comparison import comparison_in_words
from optical_palpation.present.summary import (
    force_error,
    mean_stress,
    mean_stress_error,
    of_unknown_sample,
    without_inputs,
)
from optical_palpation.present.terms import rounded, term
from optical_palpation.study import warnings_about
from optical_palpation.viewer.buttons import button_row
from optical_palpation.viewer.correction import Correction
from optical_palpation.viewer.layers import map_layers, region_layer
from optical_palpation.viewer.measurement import Measurement, show_found
from optical_palpation.viewer.numbers import Number
from optical_palpation.viewer.workbench import Workbench

_SHOWN = (
    "traction_x",
    "traction_y",
    "window_contact_state",
    "contact_state",
    "contact_pressure",
    "algebraic_axial_stress",
    "axial_stress",
)
#: Shown with the layer that was found already, or of little use to the eye.
_HIDDEN = ("loaded_thickness", "filled", "quality", "traction_z")
_LAWS = {
    "mooney-rivlin": ("c10", "c01"),
    "neo-hookean": ("c10",),
    "yeoh": ("c10", "c20", "c30"),
}
_COEFFICIENTS = ("c10", "c01", "c20", "c30")
_WAIT = 150  # ms after which a change counts as made


class Solving(QGroupBox):
    """What the study needs besides the layer, and solving it."""

    def __init__(self, bench: Workbench, measurement: Measurement, correction: Correction) -> None:
        super().__init__("Stress")
        self._bench, self._measurement, self._correction = bench, measurement, correction
        form = QFormLayout(self)
        self.law = QComboBox()
        self.law.addItems(list(_LAWS))
        form.addRow("material", self.law)
        self.numbers = {
            "material.c10": Number(0.0, 1e5, (0.0, 10.0), "kPa"),
            "material.c01": Number(-1e5, 1e5, (0.0, 10.0), "kPa"),
            "material.c20": Number(-1e5, 1e5, (-1.0, 1.0), "kPa"),
            "material.c30": Number(-1e5, 1e5, (-1.0, 1.0), "kPa"),
            "friction.window": Number(0.0, LARGEST_FRICTION, (0.0, 1.0), word="glued"),
            "friction.sample": Number(0.0, LARGEST_FRICTION, (0.0, 1.0), word="glued"),
            "grid.element_size": Number(0.001, 10.0, (0.05, 0.5), "mm", 4),
        }
        labels = {"window": "friction, window", "sample": "friction, sample"}
        for name, number in self.numbers.items():
            key = name.partition(".")[2]
            form.addRow(labels.get(key, key.replace("_", " ")), number)
            number.changed.connect(self._changed)
        self.edges = QComboBox()
        self.edges.addItems(["free", "roller", "padded"])
        form.addRow("edges", self.edges)
        self.live = QCheckBox("solve as I change")
        row = QHBoxLayout()
        self.button = QPushButton("Solve")
        self.button.clicked.connect(lambda: self.solve())
        row.addWidget(self.button)
        row.addWidget(self.live)
        form.addRow(row)
        self.outcome = _Text()
        form.addRow(self.outcome)
        row = button_row(
            ("Compare with…", "the stress of another result, stress.nc", self._ask_to_compare)
        )
        self.align = QCheckBox("aligned by the relief")
        self.align.setToolTip(
            "take back a lateral shift of the other result, found from the loaded thickness"
        )
        row.addWidget(self.align)
        form.addRow(row)
        self._form = form
        self._shown: list[Any] = []
        self._size: Any = None  # three element sizes as the study gives them, or None
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(_WAIT)
        self._timer.timeout.connect(self._solve_if_live)
        self.law.currentTextChanged.connect(self._show_law)
        self.edges.currentTextChanged.connect(lambda _: self._changed())
        self.live.toggled.connect(lambda on: self._changed() if on else None)
        measurement.changed.connect(self._changed)
        bench.opened.connect(self._show)
        bench.background.failed.connect(lambda _: self.outcome.setText("no stress: see below"))
        self._show_law()

    def apply(self) -> None:
        """Put what is chosen into the study.

        Raises
        ------
        InputError
            If an input has not been chosen, or a correction lies outside of its volume.
        """
        self._measurement.apply()
        self._correction.apply()
        law = self.law.currentText()
        changes: dict[str, Any] = {"material.law": law, "grid.edges": self.edges.currentText()}
        for name, number in self.numbers.items():
            table, _, key = name.partition(".")
            fits = table != "material" or key in _LAWS[law]
            changes[name] = number.value() if fits else None
        size = self._size
        if size is not None and changes["grid.element_size"] == size[0]:
            changes["grid.element_size"] = size
        self._bench.session.change(changes)

    def solve(self, live: bool = False) -> None:
        """Compute the stress in the background, and show it; `live` as in `Session.solve`."""
        bench = self._bench
        try:
            self.apply()
            bench.session.study()
        except OpticalPalpationError as error:
            bench.said.emit(str(error))
            return
        session = bench.session
        bench.background.run(lambda tell: session.solve(tell, live=live), self._show_result)

    def compare(self, path: str) -> None:
        """Show how the stress of another result differs from this one, on the points of this.

        If so chosen, the other one is first aligned by the relief that its loaded thickness shows.

        Raises
        ------
        InputError
            If there is no stress yet, the file holds none, or the two cannot be compared or
            aligned.
        """
        bench = self._bench
        if bench.result is None:
            raise InputError("solve first: there is no stress yet to compare with another")
        other = read_result(path)
        both = {"this": bench.result.maps, Path(path).name: other.maps}
        found = compare_results(both, register=self.align.isChecked())
        bench.show_difference(found)
        bench.said.emit(comparison_in_words(found))

    def _ask_to_compare(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Result", filter="*.nc")
        self._bench.attempt(self.compare, path)

    def _show_result(self, result: StressResult) -> None:
        bench = self._bench
        first = bench.result is None
        others = [str(name) for name in result.maps.data_vars if name not in _SHOWN + _HIDDEN]
        layers = map_layers(result.maps, only=[*others, *_SHOWN])
        for layer in layers[:-1]:
            layer.keywords["visible"] = False
        with bench.at_once():
            for side, found in bench.session.found.items():
                known = side in bench.seen
                if found is not bench.seen.get(side):  # with corrections that were drawn since
                    show_found(bench, side, found)
                if not known:
                    bench.hide_found(side)
            bench.result = result
            bench.forget_difference()
            self._forget(keep=bench.show(layers))
            if not list(bench.layers("regions")):
                bench.show([region_layer(result.maps)])
            bench.raise_regions()
        if first:
            bench.view_maps([term(result.maps, "axial_stress").label])
        self.outcome.setText(_in_words(result))
        bench.solved.emit()

    def _forget(self, keep: Sequence[Any]) -> None:
        """Remove the maps of an earlier result that this one has not."""
        for layer in self._shown:
            if layer not in keep and layer in self._bench.viewer.layers:
                self._bench.viewer.layers.remove(layer)
        self._shown = list(keep)

    def _changed(self) -> None:
        if self.live.isChecked():
            self._timer.start()

    def _solve_if_live(self) -> None:
        if self.live.isChecked():
            self.solve(live=True)

    def _show_law(self) -> None:
        used = _LAWS[self.law.currentText()]
        for key in _COEFFICIENTS:
            self._form.setRowVisible(self.numbers[f"material.{key}"], key in used)
        self._changed()

    def _show(self) -> None:
        """Show what another study says."""
        tables = self._bench.session.tables
        material, grid = tables.get("material", {}), tables.get("grid", {})
        live = self.live.isChecked()
        self.live.setChecked(False)
        self.law.setCurrentText(material.get("law", "mooney-rivlin"))
        self.edges.setCurrentText(grid.get("edges", "free"))
        self._size = None
        for name, number in self.numbers.items():
            table, _, key = name.partition(".")
            value = tables.get(table, {}).get(key)
            if key == "element_size" and isinstance(value, list):
                self._size, value = value, value[0]
            number.set(value)
        self._forget(keep=())
        self._bench.forget_difference()
        self.live.setChecked(live)
        self.outcome.setText("")


class _Text(QLabel):
    """A text over several lines with room for all of them, which a form does not give it."""

    def __init__(self) -> None:
        super().__init__()
        self.setWordWrap(True)
        self.setAlignment(Qt.AlignmentFlag.AlignTop)

    def setText(self, text: str | None) -> None:
        """Show a text."""
        super().setText(text)
        self._make_room()

    def resizeEvent(self, event: QResizeEvent | None) -> None:
        """Make room for more lines where they get shorter."""
        super().resizeEvent(event)
        self._make_room()

    def _make_room(self) -> None:
        self.setMinimumHeight(0)  # it counts for the height that the text asks for
        lines = 3 * self.fontMetrics().lineSpacing()
        self.setMinimumHeight(max(lines, self.heightForWidth(self.width())))


def _in_words(result: StressResult) -> str:
    """Key figures to what their error leaves, and what casts doubt on them."""
    maps, stress = result.maps, result.maps["axial_stress"]
    force = rounded(maps.attrs["sample_force_mN"], force_error(maps.attrs))
    error = mean_stress_error(maps)
    points = f"{stress.sizes['y']} x {stress.sizes['x']} points"
    figures = f"force {force} mN, mean axial stress {rounded(mean_stress(maps), error)} kPa"
    alone = f" (± by the {of} alone)" if (of := without_inputs(maps.attrs)) else ""
    figures += f"{alone}, {points}"
    warnings = [*warnings_about(result), of_unknown_sample(maps)]
    said = [figures, *(f"Warning: {text}" for text in warnings if text)]
    if "guided_by_similar_layer" in maps.attrs:
        said.append("Solved live, from the solution before; Solve computes it anew, with errors")
    return "\n".join(said)
