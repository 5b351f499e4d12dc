"""A place for compiled kernels where numba, finding none, would refuse to define them."""

from __future__ import annotations

import os


def provide_kernel_cache() -> None:
    """Let kernels be kept in a temporary folder if neither package nor home can be written to.

    So it is for a package installed read-only and used by somebody without a home, as in many
    containers. Numba keeps compiled kernels beside their source, else in the user's cache folder.
    """
    places = [os.environ.get("NUMBA_CACHE_DIR"), os.path.dirname(__file__)]
    places += [os.environ.get("XDG_CACHE_HOME"), os.path.expanduser("~/.cache")]
    if any(_writable(place) for place in places if place):
        return
    import atexit
    import tempfile

    folder = tempfile.TemporaryDirectory(prefix="optical-palpation-kernels-")
    atexit.register(folder.cleanup)
    os.environ["NUMBA_CACHE_DIR"] = folder.name


def _writable(place: str) -> bool:
    """Whether a folder can be written to, or made."""
    while not os.path.exists(place):
        place, child = os.path.split(place)
        if not child:
            return False
    return os.path.isdir(place) and os.access(place, os.W_OK | os.X_OK)
