"""Files that take the place of others."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxhf
from jaxhf.io.checkpoint import save_checkpoint
from jaxhf.io.files import save_text


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="these take names in Unicode alone")
def test_names_that_are_not_utf_8(tmp_path):
    """As bytes in Latin-1 are, on a disk of long ago; the header beside a raster is found."""
    rasterio = pytest.importorskip("rasterio")
    pytest.importorskip("OpenEXR")
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/d\xe9m"))
    folder.mkdir()
    terrain = jaxhf.Terrain(np.arange(6, dtype=np.float32).reshape(2, 3), 30.0, 30.0, 5e5, 4.1e6)
    jaxhf.save_heights(folder / "a.tif", terrain)
    place = {"width": 3, "height": 2, "count": 1, "transform": rasterio.Affine(20, 0, 5e5, 0, -20, 4.1e6)}
    with rasterio.open(tmp_path / "b.bil", "w", driver="EHdr", dtype="float32", **place) as file:
        file.write(terrain.heights, 1)
    for ending in (".bil", ".hdr"):
        (tmp_path / f"b{ending}").rename(folder / f"b{ending}")
    for name, dx in (("a.tif", 30), ("b.bil", 20)):
        assert jaxhf.load_heights(folder / name).dx == dx
    jaxhf.save_image(folder / "c.exr", np.ones((2, 3), np.float32))
    np.testing.assert_array_equal(jaxhf.load_image(folder / "c.exr"), 1)
    assert {path.name for path in folder.iterdir()} == {"a.tif", "b.bil", "b.hdr", "c.exr"}


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
