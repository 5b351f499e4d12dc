"""A study as one self-contained HTML file, to look at in any browser."""

from optical_palpation.present.report.document import write_report

__all__ = ["write_report"]
