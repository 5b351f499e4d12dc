"""What all commands have in common in the way they are written and explained."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

_PROMPT = "$ "
#: Of click, or of the copy of it in typer.
_UsageError: Any = typer.BadParameter.__mro__[1]
#: What typer says of values by way of pydantic, and plain words for it.
_PLAIN = {
    r"Value error, (.*)": r"\1",
    r"Input should be a valid integer.*": "must be a whole number",
    r"Input should be a valid number.*": "must be a number",
    r"Input should be greater than or equal to (.*)": r"must be at least \1",
    r"Input should be less than or equal to (.*)": r"must be at most \1",
}


def epilog(examples: Sequence[str], cost: str = "") -> str:
    """Return the end of a help, in Markdown: examples, and what the command costs if it is long."""
    lines = [f"Example{'s' if len(examples) > 1 else ''}:", "", "```console"]
    lines += [f"{_PROMPT}optical-palpation {example}" for example in examples]
    lines += ["```"]
    return "\n".join([*lines, "", f"Cost: {cost}"] if cost else lines)


class Command(TyperCommand):
    """A command whose help and errors name what it takes and no types of Python."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        for parameter in self.params:
            if isinstance(parameter, TyperArgument) and hasattr(parameter, "display_type_rich"):
                parameter.display_type_rich = lambda ctx: None  # type: ignore[method-assign]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse; all that is missing is told at once."""
        try:
            return super().parse_args(ctx, list(args))
        except typer.BadParameter as error:
            given, *_ = self.make_parser(ctx).parse_args(args=list(args))
            missing = [
                parameter
                for parameter in self.get_params(ctx)
                if parameter.required and _is_missing(parameter, given.get(str(parameter.name)))
            ]
            if type(error).__name__ == "MissingParameter" and missing:
                names = ", ".join(_name(parameter) for parameter in missing)
                raise _UsageError(f"missing: {names}", ctx) from None
            for said, words in _PLAIN.items():
                error.message = re.sub(f"^{said}$", words, error.message)
            if error.param is not None and error.param.nargs > 1:
                error.message += f"; it takes {error.param.nargs} values, {error.param.metavar}"
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command; of what does not go together no single value is invalid."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            if error.param is None and error.param_hint is None:
                raise _UsageError(error.message, ctx) from None
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Name the arguments as their help does; in brackets what may be left out."""
        names = []
        for parameter in self.get_params(ctx):
            if isinstance(parameter, TyperArgument):
                name = str(parameter.metavar or parameter.name).upper()
                names.append(name if parameter.required else f"[{name}]")
        return ["[OPTIONS]", *names]

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples so that a terminal gives them back to a shell."""
        for line in (self.epilog or "").splitlines():
            if line.startswith(_PROMPT):
                formatter.write("\n".join(_broken(line.removeprefix(_PROMPT), formatter.width)))
                formatter.write("\n")
            elif line and not line.startswith("```"):
                formatter.write_paragraph()
                formatter.write_text(line)


class Group(TyperGroup):
    """Commands of which the help says in a whole sentence what each does."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the commands; an overview that breaks off tells nothing."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, of.get_short_help_str(limit=200)) for name, of in commands if of is not None]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def _is_missing(parameter: Any, value: Any) -> bool:
    """Whether a parameter was not given, for what versions of click and typer call nothing."""
    return value in (None, (), []) or bool(parameter.value_is_missing(value))


def _name(parameter: Any) -> str:
    """What to call a parameter that is missing."""
    metavar = str(parameter.metavar or parameter.name).upper()
    if isinstance(parameter, TyperArgument):
        return metavar
    return f"{max(parameter.opts, key=len)} {metavar}"


def _broken(command: str, width: int) -> Iterator[str]:
    """Lines of a command, broken before options where they would be too long."""
    before, line = "  ", ""
    for part in command.replace(" --", "\n--").split("\n"):
        if line and len(before) + len(line) + len(part) + 3 > width:
            yield f"{before}{line} \\"
            before, line = "      ", ""
        line = f"{line} {part}".strip()
    yield before + line
