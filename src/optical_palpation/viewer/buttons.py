"""Rows of buttons of the panel."""

from __future__ import annotations

from collections.abc import Callable

from qtpy.QtWidgets import QHBoxLayout, QPushButton


def button_row(*buttons: tuple[str, str, Callable[[], object]]) -> QHBoxLayout:
    """Make a row of buttons: of each its text, its tip ("" for none) and what it calls."""
    row = QHBoxLayout()
    for text, tip, call in buttons:
        button = QPushButton(text)
        button.setToolTip(tip)
        button.clicked.connect(lambda _=False, call=call: call())
        row.addWidget(button)
    return row
