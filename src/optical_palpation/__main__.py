"""The command ``optical-palpation`` from its first moment on: signals, streams, exit status.

Imports nothing but the standard library until signals and streams are taken care of.
"""

import os
import signal

_INTERRUPTED, _TERMINATED = 130, 143


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

    if interrupted:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if terminated:
        signal.signal(signal.SIGTERM, _terminate)
    command()


def _leave(number: int, frame: object) -> None:
    """End at once: nothing has been begun, and an exception in an import may be lost."""
    try:
        os.write(2, b"interrupted; no file is left half-written\n")
    finally:
        os._exit(_INTERRUPTED if number == signal.SIGINT else _TERMINATED)


def _terminate(number: int, frame: object) -> None:
    """End as after Ctrl-C, so that nothing half-written is left."""
    raise SystemExit(_TERMINATED)


if __name__ == "__main__":
    main()
