"""Check of LZW streams, as the TIFF 6.0 specification (section 13) defines them.

For codes that are not in its table the decoder of imagecodecs reads memory that nobody has filled,
which sometimes takes the whole process down. It is safe on streams that pass this check.
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

_CLEAR, _END = 256, 257


@nb.njit(cache=True)
def is_valid(stream: NDArray[np.uint8]) -> bool:
    """Tell whether every code of the stream (bytes) is in the table when it comes."""
    width, entries, fresh = 9, _END + 1, True
    have, at = 0, 0
    bits = np.uint64(0)
    while True:
        while have < width:
            if at == stream.size:
                return True  # without a code for the end, as some encoders leave it
            bits = (bits << np.uint64(8)) | np.uint64(stream[at])
            have += 8
            at += 1
        code = np.int64((bits >> np.uint64(have - width)) & np.uint64((1 << width) - 1))
        have -= width
        if code == _END:
            return True
        if code == _CLEAR:
            width, entries, fresh = 9, _END + 1, True
        elif fresh:
            if code > 255:
                return False
            fresh = False
        else:
            if code > entries or entries == 4096:
                return False
            entries += 1
            if entries in (511, 1023, 2047):  # one code early, as TIFF does it
                width += 1
