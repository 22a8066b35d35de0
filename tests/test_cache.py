"""The folder of compiled kernels: one for each version of the sources, wherever caches are; old ones go."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import time

from conftest import ROOT

from f2s_hpc import _cache

ASK = "from f2s_hpc import _cache; print(_cache.use())"
OWN = _cache.source_hash("kernels", "materials")


def asked(code: str = ASK, **variables: str) -> str:
    """Return what a new process prints that knows of no cache but by ``variables``."""
    plain = {name: value for name, value in os.environ.items()
             if name not in ("F2S_CACHE_DIR", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")}
    done = subprocess.run([sys.executable, "-c", code], env=plain | {"PYTHONPATH": str(ROOT)} | variables, check=False,
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_cache_of_the_user_still_has_a_folder_for_each_version(tmp_path):
    """Fails if a ``NUMBA_CACHE_DIR`` of the user is taken as it is: kernels of older sources would be run."""
    folder = asked(NUMBA_CACHE_DIR=str(tmp_path))
    assert folder == str(tmp_path / "f2s_hpc" / OWN)
    assert asked(NUMBA_CACHE_DIR=folder) == folder
    older = tmp_path / "f2s_hpc" / "0123456789abcdef"
    assert asked(NUMBA_CACHE_DIR=str(older)) == folder
    assert asked(NUMBA_CACHE_DIR=str(tmp_path), F2S_CACHE_DIR=str(tmp_path / "mine")) == str(tmp_path / "mine" / OWN)


def test_child_processes_use_the_same_folder(tmp_path):
    """Fails if what a child inherits leads it elsewhere, or if numba does not use the folder when it came first."""
    code = ("import numba, subprocess, sys; from f2s_hpc import _jit; import f2s_hpc._cache as c;"
            f"child = subprocess.run([sys.executable, '-c', {ASK!r}], capture_output=True, text=True).stdout.strip();"
            "print(_jit.CACHE, numba.config.CACHE_DIR, child)")
    for variables in ({"NUMBA_CACHE_DIR": str(tmp_path)}, {"F2S_CACHE_DIR": str(tmp_path)}, {"HOME": str(tmp_path)},
                      {"HOME": str(tmp_path / "none"), "TMPDIR": str(tmp_path)}):
        assert len(set(asked(code, **variables).split())) == 1, variables


def test_no_home_is_needed(tmp_path):
    """As for a user whom the system does not know. Fails if ``Path.home`` is asked though ``XDG_CACHE_HOME`` is set."""
    code = f"import pathlib; pathlib.Path.home = lambda: (_ for _ in ()).throw(RuntimeError('no home')); {ASK}"
    assert asked(code, XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "f2s_hpc" / OWN)
    assert asked(code, TMPDIR=str(tmp_path)) == str(tmp_path / f"f2s_hpc-{os.getuid()}" / OWN)


def leave(folder: pathlib.Path, days: float, name: str = "kernel.nbi") -> pathlib.Path:
    """Make a folder that was last used so many days ago."""
    (folder / "sub").mkdir(parents=True)
    (folder / "sub" / name).touch()
    then = time.time() - days * 86400.0
    for path in (folder / "sub" / name, folder / "sub", folder):
        os.utime(path, (then, then))
    return folder


def test_a_new_version_removes_what_nobody_has_used_for_long(tmp_path, monkeypatch):
    """Fails if old folders stay, or if one goes that is in use, of another name, or holds no kernels."""
    monkeypatch.setenv("F2S_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    old, recent = leave(tmp_path / ("a" * 16), 61), leave(tmp_path / ("b" * 16), 59)
    read = leave(tmp_path / ("c" * 16), 61)
    os.utime(read / "sub" / "kernel.nbi", (time.time(), time.time() - 61 * 86400.0))
    others = [leave(tmp_path / "photographs", 900), leave(tmp_path / ("d" * 16), 900, "thesis.tex")]
    assert _cache.use() == str(tmp_path / OWN)
    assert not old.exists()
    assert all(path.exists() for path in (recent, read, *others))
    leave(tmp_path / ("e" * 16), 61)
    _cache.use()
    assert (tmp_path / ("e" * 16)).exists()  # (only who makes a folder looks around)


def test_use_leaves_its_time(tmp_path, monkeypatch):
    """Fails if a folder that is used every day would be taken for an old one."""
    monkeypatch.setenv("F2S_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    leave(tmp_path / OWN, 61)
    assert time.time() - pathlib.Path(_cache.use()).stat().st_mtime < 3600.0


def test_any_edit_changes_the_hash_of_the_package(tmp_path, monkeypatch):
    """Fails if a file, or its name, is left out."""
    monkeypatch.setattr(_cache, "PACKAGE", tmp_path)
    found = set()
    for name, text in (("a.py", "1"), ("a.py", "2"), ("scenes/s.toml", "x = 1"), ("data/d.csv", "1"), ("b.py", "")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        found.add(_cache.package_hash())
    (tmp_path / "b.py").rename(tmp_path / "c.py")
    assert len(found | {_cache.package_hash()}) == 6


def test_a_cache_that_cannot_be_written_gives_way_to_a_temporary_one(tmp_path):
    """Fails if making the folder ends in a traceback, or if numba is left without a place: it then ends in one."""
    (tmp_path / "file").touch()
    folder = asked(F2S_CACHE_DIR=str(tmp_path / "file"), TMPDIR=str(tmp_path))
    assert folder == str(tmp_path / f"f2s_hpc-{os.getuid()}" / OWN)
    assert pathlib.Path(folder).is_dir()
    child = ("import subprocess, sys; from f2s_hpc import _cache; _cache.use();"
             f"subprocess.run([sys.executable, '-c', {ASK!r}])")
    assert asked(child, F2S_CACHE_DIR=str(tmp_path / "file"), TMPDIR=str(tmp_path)) == folder


def test_a_kernel_is_compiled_only_where_it_is_itself(tmp_path):
    """As ``f2s check`` compiles some that a run needs, but not those of the step, which take a minute.

    Fails if ``is_compiled`` looks for any kernel.
    """
    code = ("from f2s_hpc._jit import is_compiled; from f2s_hpc.kernels import scratch, strain;"
            "before = is_compiled(scratch.rank); scratch.rank(1.0);"
            "print(before, is_compiled(scratch.rank), is_compiled(strain.lagrangian_step), is_compiled(len))")
    assert asked(code, F2S_CACHE_DIR=str(tmp_path)) == "False True False True"
