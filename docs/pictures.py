"""The pictures of README, docs/index.md and docs/report.md (``make pictures``).

``relief.png`` is what ``optical-palpation run`` draws of the sample *relief*; ``report.png`` is the
upper part of its report in Chromium, with a line and a rectangle drawn by the mouse.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

HERE = Path(__file__).parent
#: Ends in the map, as fractions of its width and height from its upper left corner.
RECTANGLE = (0.38, 0.36), (0.62, 0.64)
LINE = (0.1, 0.75), (0.9, 0.3)


def main() -> None:
    """Make the sample, run its study, and keep its pictures."""
    with tempfile.TemporaryDirectory() as folder:
        for arguments in (("sample", "relief"), ("run", "relief/study.toml")):
            command = [sys.executable, "-m", "optical_palpation", *arguments]
            subprocess.run(command, cwd=folder, check=True)
        results = Path(folder) / "relief" / "results"
        shutil.copy(results / "stress.png", HERE / "relief.png")
        draw_report(results / "report.html", HERE / "report.png")


def draw_report(report: Path, picture: Path) -> None:
    """Open a report, draw into its map, and take its picture."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1366, "height": 1500})
        page.goto(report.as_uri())
        page.wait_for_selector("html[data-ready]", state="attached")
        drag(page, "rectangle", RECTANGLE)
        drag(page, "line", LINE)
        page.wait_for_timeout(500)
        page.screenshot(path=picture)
        browser.close()


def drag(page: Page, tool: str, ends: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """Draw something into the first map with the mouse."""
    page.get_by_label(tool, exact=True).check()
    box = page.locator("svg rect.frame").first.bounding_box()
    assert box is not None
    for n, (right, down) in enumerate(ends):
        page.mouse.move(box["x"] + right * box["width"], box["y"] + down * box["height"], steps=5)
        page.mouse.down() if n == 0 else page.mouse.up()


if __name__ == "__main__":
    main()
