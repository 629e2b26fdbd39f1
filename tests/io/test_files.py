"""Files that take the place of others."""

import os
from pathlib import Path

import numpy as np
import pytest

import jaxhf
from jaxhf.io.checkpoint import save_checkpoint
from jaxhf.io.files import save_text

WRITERS = {
    "a checkpoint": ("fit.checkpoint", lambda path: save_checkpoint(path, {"stage": 1}, [np.ones(3)])),
    "a page": ("page.html", lambda path: save_text(path, "heights")),
    "a picture": ("picture.npy", lambda path: jaxhf.save_image(path, np.ones((2, 3, 3)))),
    "an 8-bit picture": ("picture.png", lambda path: jaxhf.save_image(path, np.ones((2, 3, 3)))),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_file_is_on_the_disk_before_it_takes_its_name(writer, tmp_path, monkeypatch):
    """Then its name is: a power failure leaves the old file or the new one."""
    name, write = WRITERS[writer]
    calls, fsync, replace = [], os.fsync, os.replace

    def synchronised(descriptor):
        calls.append(("fsync", os.fstat(descriptor).st_ino, os.fstat(descriptor).st_size))
        fsync(descriptor)

    def replaced(old, new):
        calls.append(("replace", Path(new).name))
        replace(old, new)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", synchronised)
        patched.setattr(os, "replace", replaced)
        write(tmp_path / name)
    file, folder = (tmp_path / name).stat(), tmp_path.stat()
    assert calls[:2] == [("fsync", file.st_ino, file.st_size), ("replace", name)]
    assert [call[:2] for call in calls[2:]] == ([] if os.name == "nt" else [("fsync", folder.st_ino)])
    assert [found.name for found in tmp_path.iterdir()] == [name]
