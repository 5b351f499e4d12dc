"""The table of a batch: one row for each scan, as CSV and as Parquet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optical_palpation.batch.dispatch import Outcome
from optical_palpation.batch.reading import CSV, INDEX, PARQUET, RECORD, Batch
from optical_palpation.errors import OutputError
from optical_palpation.files import check_target, place_of, replacing
from optical_palpation.runtime import software_version

if TYPE_CHECKING:
    import pandas as pd

#: How every table begins.
_BEGINNING = "scan,status,message"


def check_folder(folder: Path) -> None:
    """Make the folder of a batch.

    Raises
    ------
    OutputError
        If it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: the folder cannot be made ({reason})") from error
    check_target(folder / CSV)


def claim_folder(batch: Batch) -> None:
    """Make the folder of a batch and note whose it is.

    Raises
    ------
    OutputError
        If it cannot be made or written, or holds the results of another batch or something else
        in the place of a table.
    """
    folder = batch.folder
    check_folder(folder)
    own = place_of(batch.source, folder)
    record = folder / RECORD
    try:
        owner = json.loads(record.read_text(encoding="utf-8"))["batch"]
    except FileNotFoundError:
        owner = own  # of the folder of an earlier version, or of a new one
        taken = [name for name in (CSV, PARQUET, INDEX) if (folder / name).exists()]
        if taken and not _is_table(folder / CSV):
            raise OutputError(
                f"{folder / taken[0]}: is no result of a batch, and would be overwritten; choose "
                "another folder"
            ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{record}: is no record of a batch; choose another folder") from error
    if owner != own:
        raise OutputError(
            f"{folder}: holds the results of another batch, {owner}; choose another folder, or "
            f"remove {record} to go on in this one"
        )
    with replacing(record) as temporary:
        about = {"software": "optical-palpation", "batch": own}
        temporary.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def _is_table(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_BEGINNING)) == _BEGINNING.encode()
    except OSError:
        return False


def table_of(batch: Batch, outcomes: Sequence[Outcome]) -> pd.DataFrame:
    """One row for each scan: name, status, what differs from its study, and what was found.

    Scans of which nothing is known have the status ``not run``. Units are in the names of the
    columns.
    """
    import pandas as pd

    found = {outcome.name: outcome for outcome in outcomes}
    # one order of columns, whichever scan comes first and whatever was found of it
    fullest = sorted(outcomes, key=lambda outcome: -len(outcome.row))
    columns = dict.fromkeys(
        [
            *("scan", "status", "message"),
            *(["name"] if any(scan.title for scan in batch.scans) else []),
            *(key for scan in batch.scans for key in scan.overrides),
            *(key for outcome in fullest for key in outcome.row),
        ]
    )
    rows: list[dict[str, Any]] = []
    for scan in batch.scans:
        outcome = found.get(scan.name)
        rows.append(
            {
                "scan": scan.name,
                "status": "not run"
                if outcome is None
                else "failed"
                if outcome.status == "failed"
                else "done",
                "message": outcome.message if outcome else "",
                "name": scan.title or scan.name,
                **{key: _cell(value) for key, value in scan.overrides.items()},
                **(outcome.row if outcome else {}),
            }
        )
    table = pd.DataFrame(rows, columns=list(columns))
    counts = [name for name in ("elements", "newton_iterations") if name in table]
    table = table.astype(dict.fromkeys(counts, "Int64"))  # a scan that failed has none
    late = [c for c in ("seconds", "warnings", "software_version", "study") if c in table]
    late += [column for column in table if str(column).endswith("_sha256")]
    return table[[column for column in table if column not in late] + late]


def write_tables(batch: Batch, outcomes: Sequence[Outcome]) -> list[Path]:
    """Write ``scans.csv`` and, if pyarrow is there, ``scans.parquet``.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    table = table_of(batch, outcomes)
    table.attrs = {
        "software": "optical-palpation",
        "software_version": software_version(),
        "source": batch.source.name,
    }
    written = [batch.folder / CSV]
    with replacing(written[0]) as temporary:
        table.to_csv(temporary, index=False)
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        return written
    written.append(batch.folder / PARQUET)
    # A column whose cells are of several kinds (0.1 here, a file there) is text in Parquet.
    for column in table:
        kinds = {type(value) for value in table[column].dropna()}
        if len(kinds) > 1:
            table[column] = table[column].map(str, na_action="ignore")
    with replacing(written[1]) as temporary:
        table.to_parquet(temporary, index=False)
    return written


def _cell(value: Any) -> Any:
    """A value as a cell of a table takes it."""
    return value if isinstance(value, bool | int | float | str) else str(value)
