"""The panel that napari shows beside its layers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qtpy.QtWidgets import (
    QFileDialog,
    QHBoxLayout,
    QLabel,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from optical_palpation.viewer.buttons import button_row
from optical_palpation.viewer.correction import Correction
from optical_palpation.viewer.measurement import Measurement
from optical_palpation.viewer.regions import Regions
from optical_palpation.viewer.session import Session
from optical_palpation.viewer.solving import Solving
from optical_palpation.viewer.workbench import Workbench


class Panel(QWidget):
    """From volumes to the stress in regions of interest, step by step.

    Parameters
    ----------
    napari_viewer
        The viewer, which napari gives.
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__()
        self.bench = bench = Workbench(napari_viewer, self)
        self.measurement = Measurement(bench)
        self.correction = Correction(bench)
        self.solving = Solving(bench, self.measurement, self.correction)
        self.regions = Regions(bench)
        inner = QWidget()
        column = QVBoxLayout(inner)
        row = button_row(
            ("Open study…", "", self._ask_to_open), ("Save study…", "", self._ask_to_save)
        )
        column.addLayout(row)
        for part in (self.measurement, self.correction, self.solving, self.regions):
            column.addWidget(part)
        column.addStretch()
        scroll = QScrollArea()
        scroll.setWidgetResizable(True)
        scroll.setWidget(inner)
        outer = QVBoxLayout(self)
        outer.addWidget(scroll)
        self.message = QLabel()
        self.message.setWordWrap(True)
        self.bar = QProgressBar()
        self.bar.setRange(0, 1000)
        self.cancel = QPushButton("Cancel")
        self.cancel.clicked.connect(self._stop)
        self._stopped = False
        row = QHBoxLayout()
        row.addWidget(self.bar, 1)
        row.addWidget(self.cancel)
        outer.addWidget(self.message)
        outer.addLayout(row)
        self.setMinimumWidth(330)
        bench.said.connect(self._say)
        bench.background.failed.connect(self._say)
        bench.background.progressed.connect(self._progress)
        bench.background.busy.connect(self._busy)
        self._busy(False)

    def open_study(self, path: str) -> None:
        """Take up a study file.

        Raises
        ------
        InputError
            If it cannot be used.
        """
        self.bench.take_up(Session.open(path))
        self._say(f"opened {Path(path).name}")

    def try_open_study(self, path: str) -> None:
        """Take up a study file, and say what is wrong with one that cannot be used."""
        self.bench.attempt(self.open_study, path)

    def save_study(self, path: str) -> None:
        """Write what was done as a study file, which ``optical-palpation run`` repeats.

        Raises
        ------
        InputError, OutputError
            If something is still missing, or a file cannot be written.
        """
        self.solving.apply()
        self.bench.session.save(path)
        self._say(f"saved; to repeat it: optical-palpation run {path}")

    def closeEvent(self, event: Any) -> None:
        """End what runs."""
        self.bench.background.cancel()
        super().closeEvent(event)

    def _say(self, text: str) -> None:
        self.message.setText(text)

    def _progress(self, stage: str, share: float) -> None:
        self.bar.setFormat(f"{stage}: %p%")
        self.bar.setValue(round(1000 * share))

    def _stop(self) -> None:
        self._stopped = True
        self.bench.background.cancel()

    def _busy(self, busy: bool) -> None:
        stopped, self._stopped = self._stopped and not busy, False
        self.cancel.setEnabled(busy)
        self.bar.setValue(0)
        self.bar.setFormat("starting" if busy else "")
        if busy:
            self.message.setText("")
        elif stopped and self.bench.result is not None:
            self._say("cancelled; the figures are those of the last solution")
        elif stopped:
            self._say("cancelled")

    def _ask_to_open(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Study", filter="*.toml")
        self.try_open_study(path)

    def _ask_to_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Study", "study.toml", filter="*.toml")
        self.bench.attempt(self.save_study, path)
