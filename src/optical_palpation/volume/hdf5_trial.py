"""Try out an HDF5 file; run as a script, in a process of its own.

On a damaged file the HDF5 library can loop for ever, take gigabytes or crash. Whatever the reader
will ask of the file before it reads samples is therefore asked here first, under limits.
"""

import sys


def main(path: str) -> None:
    """Walk through the file; raises, hangs or crashes where the reader would."""
    import h5py

    try:
        import resource

        with open("/proc/self/statm") as statm:
            used = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 400 * 2**20,) * 2)
    except (ImportError, OSError, ValueError):
        pass  # no such limits on this system: the limit of time remains
    print("ready", flush=True)

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            _ = item.shape, item.dtype, item.chunks, item.external, item.is_virtual
            item.id.get_storage_size()
            if item.size is not None and item.size <= 100:
                item[()]
            for key in item.attrs:
                # The list of the datasets that a dimension belongs to is never asked for.
                if key != "REFERENCE_LIST":
                    item.attrs[key]
            for of_axis in item.attrs.get("DIMENSION_LIST", ()):
                for scale in of_axis[:1]:
                    _ = file[scale].name

    with h5py.File(path, "r") as file:
        file.visititems(visit)


if __name__ == "__main__":
    main(sys.argv[1])
