"""Files are whole or absent, and places that take none are refused before the work."""

import os
import resource
import signal

import numpy as np
import pytest

from optical_palpation.errors import OutputError
from optical_palpation.files import check_target, replacing
from optical_palpation.thickness import thickness_map, write_thickness_map


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "file").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere" / "file")
    with replacing(tmp_path / "link") as temporary:
        temporary.write_text("new")
        assert (tmp_path / "link").read_text() == "old"
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "elsewhere" / "file").read_text() == "new"
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["file"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no such device")
def test_devices_and_links_to_them_are_refused(tmp_path):
    (tmp_path / "map.nc").symlink_to("/dev/full")
    for path in ("/dev/full", tmp_path / "map.nc"):
        with pytest.raises(OutputError, match="is no regular file"):
            check_target(path)


def test_a_folder_that_vanishes_meanwhile(tmp_path):
    def write():
        with replacing(tmp_path / "folder" / "file"):
            (tmp_path / "folder").rmdir()

    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="could not be written"):
        write()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everything")
def test_protected_files_and_folders_are_refused(tmp_path):
    (tmp_path / "file").touch(mode=0o400)
    with pytest.raises(OutputError, match="write-protected"):
        check_target(tmp_path / "file")
    (tmp_path / "folder").mkdir(mode=0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        check_target(tmp_path / "folder" / "file")


def test_a_thickness_map_on_a_full_disk_leaves_the_old_file(tmp_path):
    """The kernel refuses to let files grow beyond the limit, as a full disk would."""
    path = tmp_path / "map.nc"
    path.write_text("old")
    map_ = thickness_map(np.ones((9, 9)), field_of_view=(1, 1))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))
    try:
        with pytest.raises(OutputError, match="File too large"):
            write_thickness_map(map_, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
