"""What all commands have in common in the way they are written and explained."""

from __future__ import annotations

from typing import Any

from typer.core import TyperArgument, TyperCommand


class Command(TyperCommand):
    """A command whose help names what it takes and no types of Python."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        for parameter in self.params:
            if isinstance(parameter, TyperArgument) and hasattr(parameter, "display_type_rich"):
                parameter.display_type_rich = lambda ctx: None  # type: ignore[method-assign]
