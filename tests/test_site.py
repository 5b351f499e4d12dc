"""The site of the documentation: built without a warning, complete, every link within it good."""

import html
import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest
from playwright.sync_api import sync_playwright

import optical_palpation as op

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow  # notebooks and gallery run in the build


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


def test_site_builds_without_a_warning_and_shows_every_page(site):
    docs = ROOT / "docs"
    sources = [file for kind in ("md", "rst", "ipynb") for file in docs.glob(f"**/*.{kind}")]
    expected = {
        source.relative_to(docs).with_suffix(".html")
        for source in sources
        if "_generated" not in source.parts and source.parent != docs / "gallery"
    }
    for example in docs.glob("gallery/plot_*.py"):
        expected.add(Path("_generated/gallery") / example.with_suffix(".html").name)
    made = {page.relative_to(site) for page in site.glob("**/*.html")}
    assert not expected - made


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


def test_reference_has_every_public_name_and_every_command(site):
    from optical_palpation.cli import app

    references = (page.read_text() for page in (site / "api").glob("*.html"))
    places = set(re.findall(r'id="optical_palpation\.([^"]+)"', "".join(references)))
    for package in ("", *op._SUBPACKAGES):
        module = importlib.import_module(f"optical_palpation.{package}".rstrip("."))
        for name in getattr(module, "__all__", ()):
            thing = getattr(module, name)
            if (callable(thing) or isinstance(thing, type)) and getattr(thing, "__doc__", None):
                home = {place for place in places if place.split(".")[-1] == name}
                assert home, f"{module.__name__}.{name} is not in the reference"
    table = (site / "api" / "index.html").read_text()
    for name in op.__all__:
        assert name == "__version__" or re.search(rf'href="[^"]*\.{name}"', table), name
    page = (site / "_generated" / "command-line.html").read_text()
    for command in app.registered_commands:
        assert f'id="{command.callback.__name__}"' in page


def test_site_needs_no_network(site):
    for page in site.glob("**/*.html"):
        assert not re.search(
            r'<(?:script|link|img)[^>]*\s(?:src|href)="(?:https?:)?//', page.read_text()
        )
    assert (site / "theory.html").read_text().count("<math") > 10


def test_reference_shows_nothing_that_libraries_say_of_themselves(site):
    for page in (site / "api").glob("*.html"):
        assert not re.search("Alias for field number|BaseModel", page.read_text()), page.name


def test_options_keep_their_dashes(site):
    page = (site / "_generated" / "command-line.html").read_text()
    assert "with --tile" in page
    assert "\N{EN DASH}" not in page


@pytest.mark.parametrize("width", [390, 1280])
def test_equations_stand_in_the_middle_and_begin_within_the_column(site, width):
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("no Chromium on this machine")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": 900})
        for name in ("theory", "method"):
            page.goto((site / f"{name}.html").as_uri())
            places = page.evaluate(
                """() => [...document.querySelectorAll("div.math")].map((box) =>
                    [box, box.querySelector("mrow")].flatMap((part) => {
                        const { left, right } = part.getBoundingClientRect();
                        return [left, right];
                    }))"""
            )
            assert places
            for left, right, start, end in places:
                assert start >= left - 1, name
                assert abs(start - left - (right - end)) < 3 or end > right, name
        browser.close()
