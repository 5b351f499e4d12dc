"""Every command and every Python example of README and docs, run as a reader would run them.

The blocks of a page run in order in one empty folder, with third-party data at ``../shared/data``
where there are some. Shell blocks are fenced ``console`` (commands after ``$``) or ``bash``,
examples ``python``; the examples of a page share their names. A block below
``<!-- no-test: reason -->`` may hold only ``make`` commands (which would install the project into
a fresh environment): their targets are looked up instead.

A shell block that is nothing but commands of this software is run in this process, which spares
each command its start and the loading of compiled code, half of the time of many pages; the start
itself is what test_command.py is for. All other shell blocks go to bash and so start the program.
"""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from optical_palpation.cli import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").glob("**/*.md")) if "_generated" not in page.parts),
]
DATA = ROOT / ".." / "shared" / "data"
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>[\w-]*)[^\n]*\n(?P<code>.*?)^(?P=indent)```", re.M | re.S
)
#: What makes a line more than words: variables, patterns, redirections, several commands.
SHELL = set("$`*?[]{}()<>|&;~!#")


@dataclass(frozen=True)
class Block:
    language: str
    code: str
    place: str
    untested: bool


def blocks(page):
    text = page.read_text()
    found = []
    for match in FENCE.finditer(text):
        indent = len(match["indent"])
        code = "".join(line[indent:] for line in match["code"].splitlines(keepends=True))
        before = text[: match.start()]
        place = f"{page.name}:{before.count(chr(10)) + 1}"
        untested = before.rstrip().splitlines()[-1:] and re.fullmatch(
            r"\s*<!-- no-test: .+ -->", before.rstrip().splitlines()[-1]
        )
        found.append(Block(match["language"], code, place, bool(untested)))
    return found


def commands(block):
    """Return the commands of a shell block as one script."""
    if block.language != "console":
        return block.code
    script, continued = [], False
    for line in block.code.splitlines():
        if line.startswith("$ ") or continued:
            script.append(line if continued else line[2:])
            continued = line.endswith("\\")
    assert script, f"{block.place}: a console block has its commands after '$ '"
    return "\n".join(script)


def check_make_targets(block):
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    for line in commands(block).splitlines():
        program, _, target = line.partition(" ")
        assert program == "make", f"{block.place}: only make commands may go untested: {line}"
        assert target in targets, f"{block.place}: the Makefile has no target {target!r}"


def own_commands(script):
    """Return the arguments of each command, or None if the script needs a shell or a program."""
    lines = [line for line in script.replace("\\\n", " ").splitlines() if line.strip()]
    if any(set(line) & SHELL for line in lines):
        return None
    commands = [shlex.split(line) for line in lines]
    if any(words[0] != "optical-palpation" for words in commands):
        return None
    return [words[1:] for words in commands]


def run_shell(block, folder):
    script = commands(block)
    own = own_commands(script)
    if own is None:
        return run_script(script, block.place, folder)
    for arguments in own:
        with pytest.raises(SystemExit) as leaving:
            main(arguments)
        status = leaving.value.code or 0
        assert status == 0, f"{block.place}: {' '.join(arguments)} exits with {status}"


def run_script(script, place, folder):
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    }
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{place} exits with {done.returncode}:\n{done.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_runs(page, tmp_path, monkeypatch):
    folder = tmp_path / "work"
    folder.mkdir()
    if DATA.is_dir():
        (tmp_path / "shared").mkdir()
        (tmp_path / "shared" / "data").symlink_to(DATA.resolve())
    monkeypatch.chdir(folder)
    names = {"__name__": "__main__"}
    skipped = []
    for block in blocks(page):
        assert block.language, f"{block.place}: say what the block is (console, python, text, ...)"
        if block.untested:
            check_make_targets(block)
        elif skipped or ("../shared" in block.code and not DATA.is_dir()):
            skipped.append(block.place)  # what follows may use what this one would have made
        elif block.language in ("console", "bash", "sh", "shell"):
            run_shell(block, folder)
        elif block.language == "python":
            exec(
                compile("\n" * int(block.place.rpartition(":")[2]) + block.code, page, "exec"),
                names,
            )
    if skipped:
        pytest.skip(f"third-party data not found in ../shared/data for {', '.join(skipped)}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_local_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        # what the site makes itself is looked up in the site
        if "://" not in target and not target.startswith("_generated/"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
