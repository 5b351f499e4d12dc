"""The page docs/performance.md, from what benchmarks/performance.py has measured."""

from __future__ import annotations

from math import log

HEAD = """\
# Performance

`python benchmarks/performance.py` measures everything on this page but the largest case, and writes
it; `python benchmarks/performance.py --huge` measures that one.

Loaded thickness: {map}. Layer 0.5 mm thick,
C10 2.23 kPa, C01 0.703 kPa, K/mu 1e4, friction 0.15 at the window and 0.05 at the sample, free
edges.

{machines}
"""

MAPS = {
    "coin": "the measured map of a 5-cent coin (5 x 5 mm; mirrored to 7 x 7 mm)",
    "made": "an artificial map with the relief of a coin (5 x 5 mm; mirrored to 7 x 7 mm), because "
    "the measured one was not there",
}

SIZES = """\
- *Elements*: the outermost ones of free edges are finer, so there are somewhat more than the
  nominal number.
- *Unknowns*: three displacements per node and a pressure per element.
- *Seconds*: wall-clock time of the whole of `computational_stress` with compiled kernels, the
  median of all runs that start within 5 s, nine at most.
- *Memory*: the peak of the whole process (resident set). The predicted value is that of the check
  before a run plus what the process held before.
"""
WORK = """\
The same cases, by the work done:
"""
WORK_NOTES = """\
- *Floor*: the time in which the machine's memory ({bandwidth} GB/s, best of five triads) could
  pass every array that a kernel reads or writes once per call. Small grids fit into the caches and
  may be faster.
- *Newton iterations*: on all grids of the nested iteration, and on the finest.
- *Krylov iterations*: in all linear solves together, each to a relative residual of 3e-2; in the
  longest one; and how many solves stopped at their limit of 30 (100 on small grids), which happens
  where a layer snaps.
"""


def case_line(name: str, case, found: dict) -> str:
    """What a run has found, as a line for the terminal."""
    if "failed" in found:
        return f"  {case.text}: FAILED: {found['failed']}"
    shares = ", ".join(f"{phase} {100 * s:.0f} %" for phase, s in found["shares"].items())
    return (
        f"  {case.text}: {found['elements']:,} elements, {found['unknowns']:,} unknowns, "
        f"{found['seconds']:.2f} s ({_per_million(found):.2f} s per million unknowns), "
        f"{found['newton']} Newton ({found['newton_finest']} on the finest grid), "
        f"{found['krylov']} Krylov iterations (at most {found['krylov_largest']}), "
        f"{found['peak_bytes'] / 1e9:.2f} GB, {found['force_mN']:.1f} mN\n  {shares}"
    )


def page(cases: dict, record: dict) -> str:
    """Return the whole page."""
    if not record:
        return "Nothing has been measured.\n"
    machines = [found["machine"] for found in record.values()]
    parts = [
        HEAD.format(map=MAPS[machines[-1]["map"]], machines=_machines(record)),
        "## Sizes\n",
        _sizes({n: c for n, c in cases.items() if c.solver == "auto" and c.cascade}, record),
        SIZES,
        WORK,
        _work({n: c for n, c in cases.items() if c.solver == "auto" and c.cascade}, record),
        WORK_NOTES.format(bandwidth=f"{machines[-1]['bandwidth'] / 1e9:.0f}"),
        "Where the time goes, in %, and by how much measuring this changes the time:\n",
        _shares(cases, record),
        _growth(record),
        "## Other solvers and load paths\n",
        _references(cases, record),
        "## Against CalculiX\n",
        _calculix(record.get("sinusoid")),
        "## Start and compilation\n",
        _start(record.get("start")),
    ]
    return "\n".join(parts)


def _machines(record: dict) -> str:
    groups: dict[str, list[str]] = {}
    for name, found in record.items():
        m = found["machine"]
        bandwidth = f"{m['bandwidth'] / 1e9:.0f} GB/s"
        text = (
            f"{m['processor']}, {m['cores']} cores ({m['threads']} threads), "
            f"{m['memory_bytes'] / 2**30:.0f} GiB, memory bandwidth {bandwidth}, "
            f"Python {m['python']}, version {m.get('version', 'not recorded')}, {m['date']}; "
            f"load before the run {m['load_before']:.1f}"
        )
        groups.setdefault(text, []).append(name)
    if len(groups) == 1:
        return f"Machine: {next(iter(groups))}."
    return "\n".join(f"- {'; '.join(names)}: {text}." for text, names in groups.items())


def _per_million(found: dict) -> float:
    return 1e6 * found["seconds"] / found["unknowns"]


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _state(found: dict | None) -> str:
    return "not run" if found is None else f"failed: {found['failed']}"


def _sizes(cases: dict, record: dict) -> str:
    head = ["case", "elements", "unknowns", "seconds", "memory, GB", "predicted"]
    rows = []
    for name, case in cases.items():
        found = record.get(name)
        if found is None or "failed" in found:
            rows.append([case.text, name, "", _state(found), "", ""])
            continue
        rows.append(
            [
                case.text,
                f"{found['elements']:,}",
                f"{found['unknowns']:,}",
                f"{found['seconds']:.2f}",
                f"{found['peak_bytes'] / 1e9:.2f}",
                f"{found['predicted_bytes'] / 1e9:.2f}",
            ]
        )
    return _table(head, rows)


def _work(cases: dict, record: dict) -> str:
    head = [
        "case", "s per million unknowns", "floor, s", "Newton: all", "finest", "Krylov: all",
        "longest", "stopped",
    ]  # fmt: skip
    done = {n: found for n in cases if "seconds" in (found := record.get(n, {}))}
    rows = [
        [
            cases[name].text,
            f"{_per_million(found):.2f}",
            f"{found['bytes_moved'] / found['machine']['bandwidth']:.2f}",
            *(str(found[n]) for n in ("newton", "newton_finest")),
            *(str(found[n]) for n in ("krylov", "krylov_largest", "krylov_ended")),
        ]
        for name, found in done.items()
    ]
    return _table(head, rows)


def _shares(cases: dict, record: dict) -> str:
    done = {n: f for n, f in record.items() if n in cases and "shares" in f}
    phases = list(dict.fromkeys(p for f in done.values() for p in f["shares"]))
    rows = []
    for name, found in done.items():
        shares = [found["shares"].get(p, 0.0) for p in phases]
        row = [f"{100 * s:.0f}" for s in [*shares, 1 - sum(shares)]]
        change = found["watched_seconds"] / found["seconds"] - 1
        rows.append([cases[name].text, *row, f"{100 * change:+.0f}"])
    return _table(["case", *phases, "rest", "change"], rows)


def _growth(record: dict) -> str:
    small, large = (record.get(n, {}) for n in ("100,000", "1,000,000"))
    if "seconds" not in small or "seconds" not in large:
        return "How the time grows is not known: one of the two cases is missing.\n"
    power = log(large["seconds"] / small["seconds"]) / log(large["elements"] / small["elements"])
    return (
        f"From {small['elements']:,} to {large['elements']:,} elements the time grows as elements "
        f"to the power {power:.2f}.\n"
    )


def _references(cases: dict, record: dict) -> str:
    rows = []
    for name, case in cases.items():
        if case.solver == "auto" and case.cascade:
            continue
        found = record.get(name)
        if found is None or "failed" in found:
            rows.append([case.text, _state(found), "", "", ""])
            continue
        other = found.get("difference", {})
        rows.append(
            [
                case.text,
                f"{found['seconds']:.1f}",
                f"{found['peak_bytes'] / 1e9:.2f}",
                f"{other['pressure']:.1e}" if other else "not compared",
                f"{100 * other['force']:.3f} %" if other else "not compared",
            ]
        )
    text = (
        "The difference of the contact pressure (relative L2 norm) and of the total force from\n"
        "those of the default. Without nested iteration the load path is followed on the finest\n"
        "grid; friction depends on the path.\n"
    )
    head = ["case", "seconds", "peak memory, GB", "contact pressure", "force"]
    return text + "\n" + _table(head, rows)


def _calculix(found: dict | None) -> str:
    if found is None:
        return "Not run.\n"
    names = {
        "multigrid": "this solver, trilinear",
        "direct": "the same, sparse-direct",
        "calculix": "CalculiX, C3D20R",
    }
    rows = [
        [text, f"{f['elements']:,}", f"{f['seconds']:.2f}", f"{f['force_mN']:.1f}"]
        for n, text in names.items()
        if (f := found.get(n))
    ]
    text = (
        "Sinusoidal imprint of 5 x 5 mm, K/mu 100 in both, friction 0.3 and 0.05, the same number\n"
        f"of threads ({found['machine']['threads']}).\n\n"
        + _table(["code", "elements", "seconds", "force, mN"], rows)
    )
    if "failed" in found:
        return text + f"\n{found['failed']}.\n"
    ours, theirs = found["multigrid"], found["calculix"]
    return text + (
        f"\n{theirs['seconds'] / ours['seconds']:.0f} times faster, the force differs by "
        f"{100 * (ours['force_mN'] / theirs['force_mN'] - 1):+.1f} %.\n"
    )


def _start(found: dict | None) -> str:
    if found is None or "failed" in found:
        return f"{_state(found)}\n"
    compiling, compiled = found["compiling"], found["compiled"]
    return (
        f"The command begins to solve {compiled['solving_s']:.1f} s after it was called, median of "
        f"five. Where no compiled\nkernels are kept yet, a run with 250 um elements takes "
        f"{compiling['whole_s']:.0f} s instead of {compiled['whole_s']:.0f}: "
        f"{compiling['whole_s'] - compiled['whole_s']:.0f} s of compilation.\n"
    )
