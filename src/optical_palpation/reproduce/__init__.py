"""Pages of evidence: the paper's figures and statements, and the verification of the solver."""

from optical_palpation.reproduce.check import check_pages
from optical_palpation.reproduce.run import PAGES, reproduce

__all__ = ["PAGES", "check_pages", "reproduce"]
