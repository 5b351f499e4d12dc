"""What every run stands on, whatever it computes: which code it is."""

from optical_palpation.runtime.source import source_digest
from optical_palpation.runtime.version import software_version

__all__ = ["software_version", "source_digest"]
