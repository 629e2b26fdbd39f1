"""The folder of compiled programs: whose it is, where, and how much it holds."""

import os
import stat
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import pytest

from jaxhf.xla import folder


def test_the_platform_and_the_processor_choose_a_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("JAXHF_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    here = folder.opened()
    assert here is not None
    assert here.parent == tmp_path / "jaxhf"
    monkeypatch.setattr(folder, "_processor", lambda: "another")
    there = folder.opened()
    assert there is not None
    assert there.parent == here.parent
    assert there != here


def test_what_was_used_longest_ago_is_removed_first(tmp_path):
    for days, name in enumerate(("a", "b", "c")):
        path = tmp_path / f"jaxhf-{name}-jax-1-jaxlib-1-{16 * '0'}" / f"jaxhf.program-{32 * '0'}"
        path.parent.mkdir()
        path.write_bytes(bytes(100))
        os.utime(path, (days * 86400, days * 86400))
    (tmp_path / "user's").write_bytes(bytes(1000))
    (tmp_path / "a user's").mkdir()
    (tmp_path / "a user's" / "thesis").touch()
    (tmp_path / f"jaxhf-c-jax-1-jaxlib-1-{16 * '0'}" / "notes").touch()
    (tmp_path / f"jaxhf-l-jax-1-jaxlib-1-{16 * '0'}").symlink_to(tmp_path / "a user's", target_is_directory=True)
    folder._remove_oldest(tmp_path, 250)
    assert {path.parent.name[6] for path in tmp_path.glob("jaxhf-*/jaxhf.*")} == {"b", "c"}
    folder._remove_oldest(tmp_path, 0)
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"user's", "thesis", "notes"}


@pytest.fixture
def as_a_user(monkeypatch, tmp_path):
    """Programs go where JAXHF_CACHE says, as in a process in which nobody has said otherwise."""
    monkeypatch.setattr(folder, "_chosen", [])
    monkeypatch.setattr(folder, "_by_default", [])
    monkeypatch.setenv("JAXHF_CACHE", str(tmp_path / "kept"))
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path / "kept"
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_folder_is_made_at_the_first_use_and_closed_to_others(as_a_user):
    assert not as_a_user.exists()
    here = folder.current()
    assert here is not None
    assert here.parent == as_a_user
    assert folder.current() == here
    if os.name == "posix":
        assert stat.S_IMODE(here.stat().st_mode) == 0o700
        here.chmod(0o755)  # as somebody may have made it
        assert folder.opened() == here
        assert stat.S_IMODE(here.stat().st_mode) == 0o700


@pytest.mark.parametrize("name", ["0", "off", ""])
def test_nothing_is_kept_where_the_user_says_so(as_a_user, monkeypatch, name):
    monkeypatch.setenv("JAXHF_CACHE", name)
    assert folder.current() is None


def test_jax_keeps_programs_itself_where_it_has_a_folder(as_a_user, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    assert folder.current() is None
    assert not as_a_user.exists()


def test_many_may_write_the_same_file_and_others(tmp_path):
    def write(k):
        folder.write(tmp_path / f"jaxhf.module.program-{k % 4}", 100_000 * bytes([k % 4]))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(200)))
    assert sorted(path.name[-1] for path in tmp_path.iterdir()) == ["0", "1", "2", "3"]
    for path in tmp_path.iterdir():
        assert set(folder.read(path)) == {int(path.name[-1])}


def test_where_nothing_can_be_kept_one_warning_says_so(as_a_user):
    as_a_user.touch()
    with pytest.warns(UserWarning, match="compiled programs are not kept"):
        assert folder.current() is None
    assert folder.current() is None  # without a second warning, which would be an error


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_what_belongs_to_somebody_else_is_not_used(as_a_user, monkeypatch):
    here = folder.current()
    assert here is not None
    folder.write(here / "program", b"stored")
    assert folder.read(here / "program") == b"stored"
    assert [path.name for path in here.iterdir()] == ["program"]
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.raises(PermissionError, match="belongs to another user"):
        folder.read(here / "program")
    with pytest.raises(PermissionError, match="belongs to another user"):
        folder.opened()
