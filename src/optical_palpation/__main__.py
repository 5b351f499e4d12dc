"""The command ``optical-palpation`` from its first moment on: signals, streams, exit status.

Imports nothing but the standard library until signals and streams are taken care of.
"""

import os
import signal
import sys
from threading import Timer
from types import FrameType

_INTERRUPTED, _TERMINATED = 130, 143
_SAID = b"interrupted; no file is left half-written\n"
_AGAIN = 0.02
"""Seconds until a signal is looked at again."""
_ended = False
"""Whether a signal has ended the command."""


def main() -> None:
    """Run the command line and leave with its exit status."""
    # The parent may want either to be ignored.
    interrupted = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    terminated = signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if interrupted:
        signal.signal(signal.SIGINT, _leave)
    if terminated:
        signal.signal(signal.SIGTERM, _leave)
    # Pictures are files: whatever draws on the screen here has no part in it.
    os.environ["MPLBACKEND"] = "agg"

    from optical_palpation.runtime.streams import take_over_streams

    take_over_streams()
    from optical_palpation.cli import main as command

    try:
        if interrupted:
            signal.signal(signal.SIGINT, _end)
        if terminated:
            signal.signal(signal.SIGTERM, _end)
        sys.unraisablehook = _unraisable
        command()
    except KeyboardInterrupt:  # before the command takes it up, or after
        os.write(2, _SAID)
        sys.exit(_INTERRUPTED)


def _leave(number: int, frame: object) -> None:
    """End at once, as long as nothing has been begun."""
    try:
        os.write(2, _SAID)
    finally:
        os._exit(_INTERRUPTED if number == signal.SIGINT else _TERMINATED)


def _end(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that nothing half-written is left."""
    global _ended
    # An extension that is being imported may lose the exception, or make an ImportError of it.
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return _send_again(number)
        frame = frame.f_back
    _ended = True
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(_TERMINATED)


def _unraisable(lost: "sys.UnraisableHookArgs") -> None:
    """Keep a signal whose exception came where none can be raised, as in a callback from C.

    What a signal leaves half-made fails as it is cleared away, of which nobody needs to read.
    """
    if lost.exc_type is KeyboardInterrupt:
        _send_again(signal.SIGINT)
    elif lost.exc_type is SystemExit:
        _send_again(signal.SIGTERM)
    elif not _ended:
        sys.__unraisablehook__(lost)


def _send_again(number: int) -> None:
    timer = Timer(_AGAIN, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


if __name__ == "__main__":
    main()
