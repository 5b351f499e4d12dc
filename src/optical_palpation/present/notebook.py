"""A result as a notebook shows it."""

from __future__ import annotations

import base64
import io

from markupsafe import escape

from optical_palpation.palpation.result import StressResult
from optical_palpation.present.figure import new_figure
from optical_palpation.present.panel import draw_panel, panel_height
from optical_palpation.present.summary import summarise

_DPI = 110


def result_html(result: StressResult) -> str:
    """Return the panel of a result as a picture, and below it the summary in words."""
    picture = ""
    if {"axial_stress", "loaded_thickness"} <= set(result.maps.data_vars):
        stream = io.BytesIO()
        with new_figure("double", panel_height(result.maps)) as figure:
            draw_panel(result.maps, figure, result.pixels)
            figure.savefig(stream, format="png", dpi=_DPI)
        data = base64.b64encode(stream.getvalue()).decode("ascii")
        picture = (
            f'<img alt="thickness, stress, contact and profiles" style="max-width: 100%" '
            f'src="data:image/png;base64,{data}">'
        )
        words = str(escape(summarise(result)))
    else:
        words = str(escape(repr(result)))
    return f'<div>{picture}<pre style="white-space: pre-wrap">{words}</pre></div>'
