"""``reproduce --check`` tells a page that is true from one that is not."""

import json

import pytest

from optical_palpation.reproduce.check import check_pages, compared
from optical_palpation.reproduce.page import Chapter, Page, write_page
from optical_palpation.reproduce.record import Part, Row, Setting, run_part


def record(ours, reference="1.5", tolerance=0.01, why=""):
    row = {"where": "here", "statement": "force", "reference": reference, "ours": ours, "why": why}
    return {"text": "as usual", "rows": [row | {"tolerance": tolerance}]}


@pytest.mark.parametrize(
    ("old", "new", "agree"),
    [
        ("127.2 (+1.2 %), 122.9 (-0.4 %)", "127.9 (+1.8 %), 122.5 (-0.7 %)", True),
        ("127.2 (+1.2 %)", "129.2 (+1.2 %)", False),  # beyond 1 %
        ("127.2 (+1.2 %)", "127.2 (+3.2 %)", False),  # beyond a point
        ("-12.7264 (+5.6e-07)", "-12.7264 (-2e-04)", True),  # an error: of no size of its own
        ("-12.7264 (+5.6e-07)", "12.7264 (+5.6e-07)", False),
        ("102,010 elements", "102,010 elements", True),
        ("102,010 elements", "202,010 elements", False),
        ("0.3", "0.3 ± 0.1", False),
        ("order 1.95, 1.92", "order 1.94, 1.93", True),
        ("not computed", "1.2", False),
        ("5", "nan", False),
    ],
)
def test_numbers_within_the_tolerance_of_their_row(old, new, agree):
    count, said = compared(record(old), record(new))
    assert (said == []) is agree, said
    assert count >= sum(c.isdigit() for c in "1.5") - 1
    if not agree:
        assert "a fresh run has" in said[0]
        assert new in said[0]


def test_what_the_machine_decides_is_not_compared():
    assert compared(record("7 s"), record("90 s", tolerance=float("inf"))) == (0, [])
    assert compared(record("7 s"), record("90 s"))[1] != []


def test_other_words_and_other_rows_are_differences():
    other = record("1")
    other["text"] = "otherwise"
    assert "introduction" in compared(record("1"), other)[1][0]
    other = record("1")
    other["rows"] *= 2
    assert "fresh run has 2" in compared(record("1"), other)[1][0]


def test_a_true_page_passes_and_a_changed_one_does_not(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    make = ["reproduce", "--output", "pages", "--only", "compression", "--quick"]
    quick = ["reproduce", "--output", "pages", "--only", "not-yet"]
    assert run(*make)[0] == 0
    files = sorted(tmp_path.rglob("*.*"))
    before = [file.read_bytes() for file in files]
    status, out, err = run(*make, "--check")
    assert status == 0, err
    assert int(out.split("compared: ")[1].split()[0]) >= 9
    assert [file.read_bytes() for file in files] == before
    # the record of another solver
    path = tmp_path / "pages/verification/compression.json"
    changed = json.loads(path.read_text("utf-8"))
    changed["rows"][0]["reference"] = "-12.1"
    path.write_text(json.dumps(changed), "utf-8")
    status, _, err = run(*make, "--check")
    assert status == 5
    assert "'-12.1', a fresh run has '-12.7" in err
    # a page changed by hand
    assert run(*quick)[0] == 0
    assert run(*quick, "--check")[0] == 0
    page = tmp_path / "pages/verification.md"
    page.write_text(page.read_text("utf-8").replace("28.6", "28.7"), "utf-8")
    status, _, err = run(*quick, "--check")
    assert status == 5
    assert "verification.md does not say what its records do" in err
    # made quickly is not made, and a folder without pages is no page
    assert run(*make[:-1], "--check")[0] == 5
    assert run("reproduce", "--output", "elsewhere", "--check")[0] == 2
    assert run(*make, "--check", "--again")[0] == 2


def test_rows_that_need_data_are_left_out_without_them(tmp_path):
    def make(setting):
        rows = [Row("here", "always", "1", "1")]
        return Part("How.", rows + [Row("there", "from data", "2", "2")] * bool(setting.data))

    pages = [Page("page", "# Page", ("a", "b", "c", "d", "e"), {"part": Chapter("Part", make)})]
    (tmp_path / "page").mkdir()
    run_part("part", make, Setting(tmp_path / "page", False, tmp_path, print))
    write_page(tmp_path, pages[0], {})
    found = check_pages(tmp_path, pages)
    assert found.numbers == 2
    assert not found.differences
    assert "1 of its rows need third-party data" in str(found.left_out["part"])
    found = check_pages(tmp_path, pages, data=tmp_path)
    assert (found.numbers, found.differences, found.left_out) == (4, {}, {})
