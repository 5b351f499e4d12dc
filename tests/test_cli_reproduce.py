"""``optical-palpation reproduce`` by the page it leaves and its exit status."""

import json
import re
import shutil
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from optical_palpation.cli import main
from optical_palpation.reproduce import PAGES

ONLY = ("--only", "friction", "--only", "resolution")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def two_parts(tmp_path_factory):
    """The folder of a page of two parts, made quickly, and what the command said; to be copied."""
    folder = tmp_path_factory.mktemp("two-parts") / "page"
    said = StringIO(), StringIO()
    with redirect_stdout(said[0]), redirect_stderr(said[1]), pytest.raises(SystemExit) as leaving:
        main(["reproduce", "--output", str(folder), *ONLY, "--quick"])
    assert not leaving.value.code, said[1].getvalue()
    return folder, *(stream.getvalue() for stream in said)


def cells(page, what):
    """Cells of the row of a table whose second cell begins so."""
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    (row,) = (row for row in rows if row[1].startswith(what))
    return row


@pytest.mark.slow
def test_parts_and_page(here, run, two_parts):
    folder, out, err = two_parts
    assert out == f"page: {folder / 'validation.md'}\n"
    assert "resolution: " in err
    shutil.copytree(folder, here / "page")
    page = (here / "page/validation.md").read_text()
    assert page.count("--quick`: the coarsest grids") == 3  # at the top and in both parts
    pictures = re.findall(r"!\[.+\]\((.+)\)", page)
    assert pictures == ["validation/figure-2a.png", "validation/section-7.png"]
    assert all((here / "page" / name).stat().st_size > 10000 for name in pictures)
    assert page.count("Not made: choose it by") == len(PAGES[0].chapters) - 2

    # Even on coarse grids the physics is there: the coefficient comes back, the algebraic edge is
    # as wide as the closed form says, and the computational one two or three elements of 62.5 um.
    _, _, _, found, _ = cells(page, "coefficient recovered")
    true, estimate = map(float, re.fullmatch(r"([\d.]+) as ([\d.]+)", found).groups())
    assert estimate == pytest.approx(true, abs=0.05)
    algebraic = float(cells(page, "10-90 % edge response, algebraic")[3].split()[0])
    assert algebraic == pytest.approx(315, rel=0.03)
    computational = float(cells(page, "10-90 % edge response, computational")[3].split()[0])
    assert 60 < computational < 180
    level = float(cells(page, "stress on the square")[3].split(";")[0])
    assert level == pytest.approx(-0.2, rel=0.03)

    # What is there already is kept, whatever else is asked for.
    record = here / "page/validation/resolution.json"
    made = record.stat().st_mtime_ns
    assert run("reproduce", "--output", "page", *ONLY, "--quick", "--quiet") == (0, "", "")
    assert record.stat().st_mtime_ns == made
    # A picture that is gone is made again.
    record = here / "page/validation/friction.json"
    made = record.stat().st_mtime_ns
    (here / "page/validation/figure-2a.png").unlink()
    assert run("reproduce", "--output", "page", "--only", "friction", "--quick")[0] == 0
    assert record.stat().st_mtime_ns > made
    assert (here / "page/validation/figure-2a.png").exists()


def test_parts_from_third_party_data(here, run, shared_data):
    data = ["--data", shared_data]
    status, _, _ = run(
        "reproduce", "--output", "page", "--only", "material", "--only", "phase", *data
    )
    assert status == 0
    page = (here / "page/validation.md").read_text()
    assert "--quick`" not in page
    assert float(cells(page, "Mooney-Rivlin coefficients")[3].split()[2]) < 0.1  # Pa
    moduli = [float(v) for v in cells(page, "initial Young's modulus")[3].split(", ")]
    assert len(moduli) == 3
    assert max(moduli) / min(moduli) < 1.03
    for layer in ("1", "2"):
        row = cells(page, f"compressive strain of layer {layer}")
        assert float(row[3].split(" ± ")[0]) == pytest.approx(float(row[2]), rel=0.02)

    # A quick part does not stand for a whole one, nor the reverse.
    record = here / "page/validation/phase.json"
    assert json.loads(record.read_text())["quick"] is False
    run("reproduce", "--output", "page", "--only", "phase", *data, "--quick")
    assert json.loads(record.read_text())["quick"] is True
    assert "--quick`" in (here / "page/validation.md").read_text()
    run("reproduce", "--output", "page", "--only", "phase", *data)
    assert json.loads(record.read_text())["quick"] is False
    made = record.stat().st_mtime_ns
    run("reproduce", "--output", "page", "--only", "phase", *data, "--again")
    assert record.stat().st_mtime_ns > made


@pytest.mark.slow
def test_everything_quickly(here, run, shared_data, two_parts):
    shutil.copytree(two_parts[0], here / "page")  # the others are made
    data = ["--data", shared_data, "--references", Path(__file__).parent / "data" / "references"]
    status, out, _ = run("reproduce", "--output", "page", *data, "--quick")
    assert (status, out) == (0, "page: page/validation.md\npage: page/verification.md\n")
    for name in ("validation.md", "verification.md"):
        page = (here / "page" / name).read_text()
        assert "Not made" not in page
        assert "nan" not in page
        for picture in re.findall(r"!\[.+\]\((.+)\)", page):
            assert (here / "page" / picture).stat().st_size > 10000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "figure-9"], "figure-9"),
        (["--data", "absent"], "absent"),
        (["--references", "absent"], "absent"),
        (["--threads", "0"], "--threads"),
    ],
)
def test_bad_input_is_named_and_nothing_written(here, run, arguments, message):
    status, out, err = run("reproduce", "--output", "page", *arguments)
    assert status == 2
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    assert list(here.iterdir()) == []


def test_output_that_is_a_file(here, run):
    (here / "page").write_text("mine")
    status, _, err = run("reproduce", "--output", "page", "--only", "phase")
    assert status == 2
    assert "page" in err
    assert (here / "page").read_text() == "mine"


def test_part_without_its_data(here, run):
    status, _, err = run("reproduce", "--output", "page", "--only", "phase")
    assert status == 2
    assert "--data" in err
    page = (here / "page/validation.md").read_text()
    assert "Not made: lpl2024" not in page
    assert "third-party data are not there" in page
    assert not (here / "page/validation/phase.json").exists()
