"""Many studies at once, on Dask: on this machine or on a cluster."""

from optical_palpation.batch.cluster import worker_map
from optical_palpation.batch.dispatch import BatchProgress
from optical_palpation.batch.field import field_stress
from optical_palpation.batch.reading import Batch, Scan, read_batch
from optical_palpation.batch.run import BatchResult, run_batch
from optical_palpation.batch.sweeping import sweep

__all__ = [
    "Batch",
    "BatchProgress",
    "BatchResult",
    "Scan",
    "field_stress",
    "read_batch",
    "run_batch",
    "sweep",
    "worker_map",
]
