"""``optical-palpation demo``: the main job on a thickness map that the program makes itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    output: Annotated[Path, typer.Option(help="Folder for the results; made if need be.")] = Path(
        "demo-output"
    ),
) -> None:
    """Make a thickness map, compute the stress behind it by both methods, and draw it."""
