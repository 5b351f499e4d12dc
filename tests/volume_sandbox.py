"""Opening files in a process of their own, so that crashes, time and memory can be told."""

from __future__ import annotations

import logging
import multiprocessing as mp
import resource
import traceback
import warnings
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

HANG = 60.0  # of the clock


class Outcome(NamedTuple):
    """``text`` is "read", "InputError: ..." or what went wrong; ``memory`` the growth in bytes.

    ``seconds`` are of the processor, because others may use the machine; processes that were
    waited for count.
    """

    text: str
    seconds: float
    memory: int


class Sandbox:
    """A worker process that is replaced when it crashes or hangs."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        context = mp.get_context("spawn")
        self._pipe, far = context.Pipe()
        self._process = context.Process(target=worker, args=(far,), daemon=True)
        self._process.start()
        far.close()
        self._pipe.recv()  # ready: imports on a busy machine do not count

    def open(self, path: Path, facts: dict[str, Any], what: str = "volume") -> Outcome:
        """Read a ``volume`` (at most 20 of its B-scans), a ``map``, or what else ``READ`` names."""
        try:
            self._pipe.send((what, str(path), facts))
            if self._pipe.poll(HANG):
                return Outcome(*self._pipe.recv())
            outcome = Outcome(f"hang: more than {HANG} s", HANG, 0)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            self._process.join(5)
            outcome = Outcome(f"crash: exit code {self._process.exitcode}", 0.0, 0)
        self.stop()
        self._start()
        return outcome

    def stop(self) -> None:
        self._process.kill()
        self._process.join()


def worker(pipe: Connection) -> None:
    """Open the files whose paths come through the pipe; reply with the outcome."""
    import optical_palpation.analysis
    import optical_palpation.batch
    import optical_palpation.experiment
    import optical_palpation.friction
    import optical_palpation.material
    import optical_palpation.palpation
    import optical_palpation.study
    import optical_palpation.thickness
    import optical_palpation.volume  # noqa: F401
    from optical_palpation.errors import InputError

    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_AS, (12 * 2**30, 12 * 2**30))
    pipe.send("ready")
    while True:
        what, path, facts = pipe.recv()
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
        base, start = _memory("VmRSS"), _processor_time()
        try:
            READ[what](path, facts)
            text = "read"
        except InputError as error:
            text = f"InputError: {error}"
            caught_at_last = (
                error.__cause__ if "damaged, truncated or unsupported (" in text else None
            )
            while isinstance(caught_at_last, InputError):  # said again, with the file's name
                caught_at_last = caught_at_last.__cause__
            if caught_at_last is not None and (place := _own_place(caught_at_last)):
                text = f"unforeseen: {place}"
        except BaseException as error:
            text = "".join(traceback.format_exception(error))
        pipe.send((text, _processor_time() - start, _memory("VmHWM") - base))


def _read_volume(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.volume import open_volume

    with open_volume(path, **facts) as volume:
        for y in range(min(len(volume), 20)):
            volume.bscan(y)


def _read_map(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.thickness import read_thickness_map

    values = read_thickness_map(path, **facts)
    assert values.ndim == 2
    assert not (values.values <= 0).any()


def _read_motion(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.palpation import read_sample_motion

    read_sample_motion(path, **facts)


def _read_relief(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.thickness import read_height_map

    read_height_map(path, **facts)


def _read_stiffness(path: str, facts: dict[str, Any]) -> None:
    import numpy as np

    from optical_palpation.experiment.scene import StiffnessFile

    point = np.zeros(1)
    StiffnessFile(kind="file", path=Path(path)).apply(point + 1.0, point, point, point)


def _read_scene(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.experiment import read_scene

    read_scene(path)


def _read_uniaxial(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.material import read_uniaxial_test

    read_uniaxial_test(path, **facts)


def _read_profile(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.friction import read_profile

    read_profile(path, **facts)


def _read_corrections(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.thickness import read_corrections

    read_corrections(path)


def _read_pair(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.friction import read_pair

    read_pair(path, Path(path).with_name("after.npz"), **facts)


def _read_study(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.study import describe_inputs, read_study

    describe_inputs(read_study(path))


def _read_batch(path: str, facts: dict[str, Any]) -> None:
    from optical_palpation.batch import read_batch

    read_batch(path)


def _read_regions(path: str, facts: dict[str, Any]) -> None:
    import numpy as np
    import xarray as xr

    from optical_palpation.analysis import read_regions

    at = {"y": 0.3 * np.arange(8), "x": 0.2 * np.arange(9)}
    like = xr.DataArray(np.ones((8, 9)), at, ("y", "x"), attrs={"units": "kPa"})
    for region in read_regions(path, like):
        region.weights(like)


READ = {
    "volume": _read_volume,
    "map": _read_map,
    "motion": _read_motion,
    "relief": _read_relief,
    "stiffness": _read_stiffness,
    "scene": _read_scene,
    "uniaxial": _read_uniaxial,
    "profile": _read_profile,
    "corrections": _read_corrections,
    "pair": _read_pair,
    "study": _read_study,
    "batch": _read_batch,
    "regions": _read_regions,
}


def _own_place(error: BaseException) -> str | None:
    """Place in the readers themselves that raised what only the last safety net has caught."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    file = Path(last.filename)
    if file.parent.name != "volume" or isinstance(error, (OSError, EOFError, UnicodeError)):
        return None
    return f"{type(error).__name__} at {file.name}:{last.lineno}"


def _processor_time() -> float:
    own, waited_for = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return sum(u.ru_utime + u.ru_stime for u in (own, waited_for))


def _memory(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    return 0
