"""Reading OCT volumes: one protocol, one module per format."""

from .metadata import VolumeMetadata
from .opening import open_volume
from .volume import Volume

__all__ = ["Volume", "VolumeMetadata", "open_volume"]
