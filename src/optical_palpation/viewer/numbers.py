"""A number with a unit that is typed or dragged, and that may not be known yet."""

from __future__ import annotations

from decimal import Decimal

from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import QCheckBox, QDoubleSpinBox, QHBoxLayout, QSlider, QWidget

_STEPS = 200
_ABSENT = "?"


class Number(QWidget):
    """A spin box with a slider beside it; without a value until one is given.

    Parameters
    ----------
    low, high
        What can be typed; a value that is set may lie beyond.
    reach
        What the slider spans; it grows where a value lies beyond.
    unit
        Shown after the number.
    decimals
        Digits after the point; more where a value that is set has more.
    value
        To begin with; None where only the user knows.
    word
        What can be ticked instead of a number.
    """

    changed = Signal()

    def __init__(
        self,
        low: float,
        high: float,
        reach: tuple[float, float],
        unit: str = "",
        decimals: int = 3,
        value: float | str | None = None,
        word: str | None = None,
    ) -> None:
        super().__init__()
        self._low, self._high, self._reach, self._decimals = low, high, reach, decimals
        self._box = QDoubleSpinBox()
        self._box.setSpecialValueText(f"{_ABSENT} {unit}".rstrip())
        self._box.setSingleStep(max(10.0**-decimals, (reach[1] - reach[0]) / 100))
        self._box.setSuffix(f" {unit}" if unit else "")
        self._box.setKeyboardTracking(False)
        self._box.setFixedWidth(140)
        self._slider = QSlider(Qt.Orientation.Horizontal)
        self._slider.setRange(0, _STEPS)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self._slider, 1)
        row.addWidget(self._box)
        self._word = QCheckBox(word or "")
        if word:
            row.addWidget(self._word)
        self.set(value)
        self._word.toggled.connect(self._typed)
        self._box.valueChanged.connect(self._typed)
        self._slider.valueChanged.connect(self._dragged)

    def value(self) -> float | str | None:
        """The number, or the word; None as long as there is none."""
        if self._word.isChecked():
            return self._word.text()
        value = self._box.value()
        return None if value <= self._absent else value

    def set(self, value: float | str | None) -> None:
        """Show another number, without a signal, to its last digit."""
        self._word.blockSignals(True)
        self._word.setChecked(isinstance(value, str))
        self._word.blockSignals(False)
        self._box.blockSignals(True)
        given = value if isinstance(value, int | float) else None
        self._make_room(given)
        self._box.setValue(self._absent if given is None else given)
        self._box.blockSignals(False)
        self._follow()

    def _make_room(self, value: float | None) -> None:
        """Let the box hold a value unrounded: what is only shown must not change the study."""
        low, high, decimals = self._low, self._high, self._decimals
        if value is not None:
            exponent = Decimal(repr(float(value))).normalize().as_tuple().exponent
            low, high, decimals = min(low, value), max(high, value), max(decimals, -int(exponent))
        self._box.setDecimals(decimals)
        self._absent = low - 10.0**-decimals  # one step below all that is allowed: nothing yet
        self._box.setRange(self._absent, high)

    def _follow(self) -> None:
        value = self.value()
        for part in (self._box, self._slider):
            part.setEnabled(not isinstance(value, str))
        if isinstance(value, str):
            return
        if value is not None:
            self._reach = min(self._reach[0], value), max(self._reach[1], value)
        low, high = self._reach
        share = 0.0 if value is None else (value - low) / (high - low)
        self._slider.blockSignals(True)
        self._slider.setValue(round(_STEPS * share))
        self._slider.blockSignals(False)

    def _typed(self) -> None:
        self._follow()
        self.changed.emit()

    def _dragged(self, at: int) -> None:
        low, high = self._reach
        self._box.blockSignals(True)
        self._box.setValue(round(low + (high - low) * at / _STEPS, self._decimals))
        self._box.blockSignals(False)
        self.changed.emit()
