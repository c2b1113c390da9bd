"""Files that appear whole or not at all, and folders that one process at a time writes into."""

import errno
import json
import os
import re
import signal
import stat
import subprocess
import sys
import warnings
from contextlib import contextmanager
from pathlib import Path

import pytest

from wearcap import files, locks
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, remove_leftovers, write_text
from wearcap.locks import LOCK, folder_lock

posix = pytest.mark.skipif(os.name != "posix", reason="signals and file locks as of POSIX")

WRITER = """
import sys, time
from wearcap.files import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    print("ready", flush=True)
    time.sleep(60)
"""
HOLDER = """
import sys, time
from wearcap.locks import folder_lock
with folder_lock(sys.argv[1], "prepare"):
    print("ready", flush=True)
    time.sleep(60)
"""


@contextmanager
def running(script: str, argument: Path):
    """Another process that has come as far as its line "ready"; killed at the end."""
    process = subprocess.Popen([sys.executable, "-c", script, argument], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_error_of_a_source_keeps_its_path_and_message(tmp_path):
    source = tmp_path / "source.bvh"
    with pytest.raises(FileNotFoundError) as caught, atomic_path(tmp_path / "target.npz"):
        source.read_bytes()
    assert caught.value.filename == str(source)
    with pytest.raises(PermissionError, match=r"source\.bvh"), atomic_path(tmp_path / "target.npz"):
        raise PermissionError(errno.EACCES, "Permission denied", str(source))
    with pytest.raises(ConnectionResetError), atomic_path(tmp_path / "target.npz"):
        raise ConnectionResetError(errno.ECONNRESET, "Connection reset by peer")
    assert not names(tmp_path)


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EDQUOT, "the disk is full"),
        (errno.EROFS, "no permission to write here"),
    ],
)
@pytest.mark.parametrize("named", [True, False])
def test_an_error_of_the_target_is_explained(tmp_path, number, message, named):
    with pytest.raises(WearcapError, match=rf"target\.npz: {message}"), atomic_path(tmp_path / "target.npz") as to:
        raise OSError(number, os.strerror(number), *([str(to)] if named else []))
    assert not names(tmp_path)


@posix
def test_the_folder_is_synced_after_the_rename(tmp_path, monkeypatch):
    done = []
    sync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("rename"), rename(*paths)))

    def noted(descriptor):
        done.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    write_text(tmp_path / "a.txt", "a")
    assert done == ["file", "rename", "folder"]


@posix
def test_the_next_writer_removes_what_a_killed_one_left_and_nothing_else(tmp_path):
    others = ["notes.tmp-0123abcd", ".a.tmp-0123", ".git", ".tmp-0123abcd", "tmpab12cd"]
    for name in others:
        (tmp_path / name).write_text("")
    with running(WRITER, tmp_path / "a.bin") as writer:
        write_text(tmp_path / "b.txt", "b")
        remove_leftovers(tmp_path)
        assert len(names(tmp_path)) == len(others) + 2, "a living writer's file stays"
        writer.kill()
        writer.wait()
        files._remove_leftovers_once.cache_clear()
        write_text(tmp_path / "b.txt", "b")
    assert names(tmp_path) == sorted([*others, "b.txt"])


@posix
def test_leftovers_in_folders_below_are_removed_on_demand(tmp_path):
    left = tmp_path / "scenes" / "room" / ".room.tmp-0123abcd.ply"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")
    remove_leftovers(tmp_path)
    assert left.exists()
    remove_leftovers(tmp_path, below=True)
    assert not left.exists()


def test_a_folder_is_looked_through_once_in_a_process(tmp_path, monkeypatch):
    looked = []
    monkeypatch.setattr(files, "remove_leftovers", looked.append)
    for number in range(3):
        write_text(tmp_path / f"{number}.txt", "")
    assert looked == [str(tmp_path)]


def test_a_folder_has_one_writer_and_any_number_of_readers(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "LOCK_PATIENCE_S", 0.1)
    write_text(tmp_path / "manifest.json", "{}")
    with running(HOLDER, tmp_path) as holder:
        message = (
            rf"another run writes here \(process {holder.pid} on .+, prepare, since \d{{4}}-.+\).+kill {holder.pid}"
        )
        with pytest.raises(WearcapError, match=message), folder_lock(tmp_path, "prepare"):
            pass
        assert json.loads((tmp_path / "manifest.json").read_text()) == {}
    with folder_lock(tmp_path, "prepare"), folder_lock(tmp_path / "other", "prepare"):
        assert LOCK in names(tmp_path), "the holder was killed: its lock has gone with it"
    assert LOCK not in names(tmp_path)


def test_an_empty_lock_file_blocks_nobody(tmp_path):
    for content in (b"", b"[1]", b"\xff", b'{"pid": "x"}', b'{"pid": 1}'):
        (tmp_path / LOCK).write_bytes(content)
        with folder_lock(tmp_path, "prepare"):
            pass


@posix
def test_a_forked_child_does_not_hold_the_folder(tmp_path):
    with folder_lock(tmp_path, "train"), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
        if not child:
            signal.pause()
    with folder_lock(tmp_path, "train"):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


@posix
def test_without_locks_the_run_goes_on_with_a_warning(tmp_path, monkeypatch):
    def refuse(descriptor, mode):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    message = re.escape(f"{tmp_path}: this file system has no locks")
    with pytest.warns(UserWarning, match=message), folder_lock(tmp_path, "prepare") as descriptor:
        write_text(tmp_path / "a.txt", "a")
    assert descriptor is None
    assert names(tmp_path) == ["a.txt"]


@posix
@pytest.mark.parametrize("kind", ["link", "dangling link", "hard link", "pipe", "folder"])
def test_a_lock_that_is_no_file_of_its_own_is_refused_and_its_target_untouched(tmp_path, kind):
    folder, target = tmp_path / "data", tmp_path / "precious.txt"
    folder.mkdir()
    target.write_text("precious")
    make = {
        "link": lambda lock: lock.symlink_to(target),
        "dangling link": lambda lock: lock.symlink_to(tmp_path / "new.txt"),
        "hard link": lambda lock: lock.hardlink_to(target),
        "pipe": os.mkfifo,
        "folder": Path.mkdir,
    }
    make[kind](folder / LOCK)
    with pytest.raises(WearcapError, match=r"\.wearcap\.lock: .*Remove it"), folder_lock(folder, "prepare"):
        pass
    assert target.read_text() == "precious"
    assert names(tmp_path) == ["data", "precious.txt"]
    assert names(folder) == [LOCK]


@posix
def test_a_leftover_that_is_a_pipe_or_a_link_stays(tmp_path):
    os.mkfifo(tmp_path / ".a.tmp-0123abcd.npz")
    (tmp_path / ".b.tmp-0123abcd.npz").symlink_to(tmp_path / "c")
    remove_leftovers(tmp_path)
    assert len(names(tmp_path)) == 2
