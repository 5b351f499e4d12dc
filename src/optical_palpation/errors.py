"""The errors a user can meet, all derived from :class:`OpticalPalpationError`.

Every message says what was wrong, where, and what to do.
"""


class OpticalPalpationError(Exception):
    """Base of all errors this package raises on purpose."""


class InputError(OpticalPalpationError, ValueError):
    """Something the user supplied (file, map, number) cannot be used."""


class MaterialError(InputError):
    """Material parameters that describe no stable material."""


class InsufficientMemoryError(InputError):
    """A problem that needs more memory than there is."""


class OutputError(OpticalPalpationError, OSError):
    """A result could not be written."""


class FolderBusyError(OutputError):
    """Another run works in a result folder."""


class IncompleteOutputError(OutputError):
    """Some results could not be written; the message tells which were."""


class ConvergenceError(OpticalPalpationError, RuntimeError):
    """The mechanical solution could not reach the full load."""
