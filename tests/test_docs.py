"""Every command and every Python example of README and docs, run as a reader would run them.

The blocks of a page run in order in one empty folder, with third-party data at ``../shared/data``
where there are some. Shell blocks are fenced ``console`` (commands after ``$``) or ``bash``,
examples ``python``; the examples of a page share their names. A block below
``<!-- no-test: reason -->`` may hold only ``make`` commands (which would install the project into
a fresh environment): their targets are looked up instead.
"""

import html
import importlib
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import pytest

import optical_palpation as op

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").glob("**/*.md")) if "_generated" not in page.parts),
]
DATA = ROOT / ".." / "shared" / "data"
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>[\w-]*)[^\n]*\n(?P<code>.*?)^(?P=indent)```", re.M | re.S
)


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


def run_shell(block, folder):
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    }
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", commands(block)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{block.place} exits with {done.returncode}:\n{done.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_runs(page, tmp_path, monkeypatch):
    folder = tmp_path / "work"
    folder.mkdir()
    if DATA.is_dir():
        (tmp_path / "shared").mkdir()
        (tmp_path / "shared" / "data").symlink_to(DATA.resolve())
    monkeypatch.chdir(folder)
    names = {"__name__": "__docs__"}
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
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site as ``make docs`` builds it, of a copy: the build writes beside its sources."""
    folder = tmp_path_factory.mktemp("docs")
    made = shutil.ignore_patterns("_generated")
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=made)
    for name in ("CONTRIBUTING.md", "CHANGELOG.md"):
        shutil.copy(ROOT / name, folder)
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*command, folder / "docs", folder / "site"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.mark.slow
def test_site_builds_without_a_warning_and_shows_every_page(site):
    docs = ROOT / "docs"
    sources = [*PAGES[1:], *docs.glob("**/*.rst"), *docs.glob("notebooks/*.ipynb")]
    expected = {
        source.relative_to(docs).with_suffix(".html")
        for source in sources
        if "_generated" not in source.parts and source.parent != docs / "gallery"
    }
    for example in docs.glob("gallery/plot_*.py"):
        expected.add(Path("_generated/gallery") / example.with_suffix(".html").name)
    made = {page.relative_to(site) for page in site.glob("**/*.html")}
    assert not expected - made


@pytest.mark.slow
def test_every_link_within_the_site_leads_to_a_page_and_a_place_on_it(site):
    links, places = {}, {}
    for page in site.glob("**/*.html"):
        if "_static" not in page.parts:
            text = page.read_text()
            places[page] = set(re.findall(r'\sid="([^"]+)"', text))
            links[page] = set(re.findall(r'<a\s[^>]*href="([^"]+)"', text))
    assert len(places) > 40
    broken = []
    for page, targets in links.items():
        for target in targets:
            path, _, place = html.unescape(target).partition("#")
            if "://" in path or path.startswith("mailto:"):
                continue
            goal = (page.parent / unquote(path)).resolve() if path else page
            if not goal.is_file() or (place and goal in places and place not in places[goal]):
                broken.append(f"{page.relative_to(site)}: {target}")
    assert not broken


@pytest.mark.slow
def test_reference_has_every_public_name_and_every_command(site):
    from optical_palpation.cli import app

    references = (page.read_text() for page in (site / "api").glob("*.html"))
    places = set(re.findall(r'id="optical_palpation\.([^"]+)"', "".join(references)))
    for package in ("", *op._SUBPACKAGES, "batch", "experiment"):
        module = importlib.import_module(f"optical_palpation.{package}".rstrip("."))
        for name in getattr(module, "__all__", ()):
            thing = getattr(module, name)
            if (callable(thing) or isinstance(thing, type)) and getattr(thing, "__doc__", None):
                home = {place for place in places if place.split(".")[-1] == name}
                assert home, f"{module.__name__}.{name} is not in the reference"
    page = (site / "_generated" / "command-line.html").read_text()
    for command in app.registered_commands:
        assert f'id="optical-palpation-{command.callback.__name__}"' in page
