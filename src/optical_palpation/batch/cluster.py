"""Workers: a cluster on this machine, or one that runs already."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optical_palpation.errors import InputError
from optical_palpation.runtime.interrupts import interrupts_for_this_process

if TYPE_CHECKING:
    from distributed import Client

#: Memory that a worker takes before it computes anything: Python, compiled kernels, libraries.
_PROCESS = 0.5e9
#: Share of the available memory that the scans of a local cluster may be predicted to take.
_USABLE = 0.85


@dataclass(frozen=True)
class Workers:
    """A client, and how much memory its workers have together (None: not for us to say)."""

    client: Client
    memory: float | None
    process: float = _PROCESS


@dataclass(frozen=True)
class About:
    """What a worker says of itself."""

    version: str
    host: str
    cores: frozenset[int]
    threads: int


def about_worker() -> About:
    """Describe the process that calls this."""
    import os
    import socket

    from optical_palpation.palpation.threads import available_threads
    from optical_palpation.runtime import software_version

    cores = (
        os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    )
    return About(software_version(), socket.gethostname(), frozenset(cores), available_threads())


def checked(address: str, about: Any) -> About:
    """Return what a worker says of itself, if it has this software in this version.

    Raises
    ------
    InputError
        If it has not.
    """
    from optical_palpation.runtime import software_version

    own = software_version()
    if not isinstance(about, About):
        raise InputError(
            f"worker {address} cannot run this software ({about}); install optical-palpation "
            f"{own} with the extra batch where workers run"
        )
    if about.version != own:
        raise InputError(
            f"worker {address} has version {about.version} of optical-palpation, and here it is "
            f"{own}; install the same everywhere"
        )
    return about


def threads_of(address: str, workers: Mapping[str, About]) -> int:
    """Threads for a worker: its cores, shared with the workers that have the same ones."""
    own = workers[address]
    rivals = sum(
        other.host == own.host and bool(other.cores & own.cores) for other in workers.values()
    )
    return max(1, own.threads // max(rivals, 1))


@contextmanager
def connected(
    scheduler: str | None, workers: int | None, needs: Sequence[float | None]
) -> Iterator[Workers]:
    """Connect to a scheduler, or start workers here, as many as cores and memory allow.

    Parameters
    ----------
    scheduler
        Address of a running scheduler, ``tcp://host:8786``, or the path of its scheduler file.
    workers
        Number of workers to start here.
    needs
        Predicted memory of the scans, bytes.

    Raises
    ------
    InputError
        If Dask is not installed, the scheduler cannot be reached, or workers do not start, as
        where a script calls this at its top level.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise InputError(
            "a batch runs on Dask, which is not installed: pip install 'optical-palpation[batch]'"
        ) from error
    if scheduler is not None:
        given: dict[str, Any] = (
            {"scheduler_file": scheduler} if scheduler.endswith(".json") else {"address": scheduler}
        )
        if "scheduler_file" in given and not Path(scheduler).is_file():  # Dask would wait for it
            raise InputError(
                f"{scheduler}: no such scheduler file; 'dask scheduler --scheduler-file "
                f"{scheduler}' writes one"
            )
        try:
            client = distributed.Client(**given, timeout=20)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"{scheduler}: no Dask scheduler answers there ({error}); start one with 'dask "
                "scheduler' and give the address that it prints"
            ) from error
        with client:
            yield Workers(client, None)
        return
    from optical_palpation.palpation.memory import available_memory
    from optical_palpation.palpation.threads import available_threads

    memory = _USABLE * available_memory()
    count = workers or _workers_for(needs, available_threads(), memory)
    # Scans are admitted by their predicted memory, and the kernels have threads of their own.
    settings = {
        "distributed.worker.profile.enabled": False,
        # A process that computes may be silent for long; one that dies is seen at once.
        "distributed.comm.timeouts.connect": "120s",
        "distributed.comm.timeouts.tcp": "600s",
        "distributed.scheduler.worker-ttl": None,
    }
    with dask.config.set(settings):
        try:
            with interrupts_for_this_process():
                cluster = distributed.LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=0,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
        except RuntimeError as error:
            raise InputError(
                f"workers could not be started: {error} A script must call this below "
                "if __name__ == '__main__': because each worker imports the script first"
            ) from error
        with cluster, distributed.Client(cluster) as client:
            yield Workers(client, memory)


def _workers_for(needs: Sequence[float | None], cores: int, memory: float) -> int:
    """One for each core, fewer where there are fewer scans or memory for the smallest ones."""
    known = sorted(need for need in needs if need is not None) or [0.0]
    count, total = 0, 0.0
    while count < min(cores, len(needs)):
        total += _PROCESS + known[min(count, len(known) - 1)]
        if count and total > memory:
            break
        count += 1
    return max(count, 1)


@contextmanager
def worker_map(
    *, workers: int | None = None, scheduler: str | None = None
) -> Iterator[Callable[..., Iterator[Any]]]:
    """Give a ``map`` whose calls run side by side on Dask, for calibration curves and the like.

    Parameters
    ----------
    workers
        Number of workers to start on this machine; one for each core by default.
    scheduler
        Address of a running scheduler, or path of its scheduler file, in their place.

    Yields
    ------
    Callable
        Takes a function and the values to call it with; gives the results in order. Function and
        values must be such as can be pickled. What a lost worker had is done again on another.

    Raises
    ------
    InputError
        If Dask is not installed, the scheduler cannot be reached, or a worker has another version.
    """
    from optical_palpation.palpation.threads import available_threads

    count = workers if workers is not None else available_threads()
    if scheduler is None and count < 1:
        raise InputError(f"workers = {workers}: must be at least 1")
    with connected(scheduler, None if scheduler else count, [None]) as crew:
        client: Any = crew.client
        client.wait_for_workers(1)

        def each(function: Callable[[Any], Any], values: Iterable[Any]) -> Iterator[Any]:
            present = {
                address: checked(address, about)
                for address, about in client.run(about_worker, on_error="return").items()
            }
            threads = min(threads_of(address, present) for address in present)
            call = partial(_limited, function, threads)
            futures = client.map(call, list(values), pure=False)
            try:
                for future in futures:
                    yield future.result()
            finally:
                client.cancel(futures, force=True)

        yield each


def _limited(function: Callable[[Any], Any], threads: int, value: Any) -> Any:
    """Call a function on some threads."""
    from optical_palpation.palpation.threads import limited_threads

    with limited_threads(threads):
        return function(value)
