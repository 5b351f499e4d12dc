"""The paper's figures and statements, and other sources, against this software, as a page."""

from optical_palpation.reproduce.run import PARTS, reproduce

__all__ = ["PARTS", "reproduce"]
