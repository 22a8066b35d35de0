"""Where compiled kernels are kept: a folder named by a hash of the sources that they are made of.

numba does not notice an edit in a callee's file, and two configurations that share a cache can pick up each other's
code; so each version of the sources has a folder of its own, wherever the user wants the caches to be.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pathlib
import re
import shutil
import tempfile
import time

PACKAGE = pathlib.Path(__file__).parent
OURS = re.compile(r"[0-9a-f]{16}")
"""Names of the folders: the first 16 digits of a hash."""

DAY = 86400.0  # seconds
UNUSED = 60 * DAY
"""A folder of another version that nobody has used for so long (s) is removed when a new one is made."""


def source_hash(*folders: str) -> str:
    """Return a hash of the sources in ``folders`` of the package, and of what compiles them."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((PACKAGE / folder).glob("*.py")):
            digest.update(path.read_bytes())
    digest.update((PACKAGE / "_jit.py").read_bytes())
    return digest.hexdigest()[:16]


def package_hash() -> str:
    """Return a hash of all sources, scenes and data of the package, names included: any edit changes it."""
    digest = hashlib.sha256()
    for path in sorted(p for ending in ("py", "toml", "csv") for p in PACKAGE.rglob(f"*.{ending}")):
        text = path.read_bytes()
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {len(text)}\n".encode() + text)
    return digest.hexdigest()[:16]


def cache_directory() -> str:
    """Return the folder of compiled kernels of these sources, an absolute path.

    It lies in ``F2S_CACHE_DIR``, else in ``f2s_hpc`` in ``NUMBA_CACHE_DIR``, else in the user's cache folder. A process
    that inherits ``NUMBA_CACHE_DIR`` as :func:`use` has set it ends in the same folder.
    """
    name = source_hash("kernels", "materials")
    base, numba = os.environ.get("F2S_CACHE_DIR"), os.environ.get("NUMBA_CACHE_DIR")
    if not base and numba:
        given = pathlib.Path(os.path.abspath(numba))
        ours = given.name == name or (OURS.fullmatch(given.name) and given.parent.name.startswith("f2s_hpc"))
        base = given.parent if ours else given / "f2s_hpc"
    return os.path.join(os.path.abspath(base or _of_user()), name)


def _of_user() -> str:
    """Return where the user's caches of this program lie; below the temporary folder if there is no home to write."""
    with contextlib.suppress(RuntimeError):  # (neither HOME nor a known user)
        home = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
        if os.access(home if home.exists() else home.parent, os.W_OK):
            return str(home / "f2s_hpc")
    return _temporary()


def _temporary() -> str:
    """Return where caches lie in the temporary folder."""
    own = f"-{os.getuid()}" if hasattr(os, "getuid") else ""  # (Windows: each user's folder is his own)
    return os.path.join(tempfile.gettempdir(), f"f2s_hpc{own}")


def use() -> str:
    """Return the folder of compiled kernels, made if need be, and let numba, here and in child processes, use it.

    One in the temporary folder where that one cannot be written: numba would else end the command, or take a place
    that versions share. Its time says when it was used last, to the day. Who makes a new one removes those of other
    versions beside it that have not been used for ``UNUSED``.
    """
    wanted = pathlib.Path(cache_directory())
    # (where neither can be written numba may find a place)
    folder = next((f for f in (wanted, pathlib.Path(_temporary(), wanted.name)) if _made(f)), wanted)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    return str(folder)


def _made(folder: pathlib.Path) -> bool:
    """Make ``folder`` if need be, else note its use; tell whether it can be written."""
    with contextlib.suppress(OSError):
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            folder.mkdir()
        except FileExistsError:
            if folder.stat().st_mtime < time.time() - DAY:
                os.utime(folder)
        else:
            remove_unused(folder)
    return os.access(folder, os.W_OK | os.X_OK)


def remove_unused(new: pathlib.Path) -> None:
    """Remove the folders beside ``new`` that are ours, hold kernels, and have not been used for ``UNUSED``.

    A process that works with one all the same loses nothing but time: numba compiles what it does not find.
    """
    for folder in new.parent.iterdir():
        if folder == new or not OURS.fullmatch(folder.name) or folder.is_symlink() or not folder.is_dir():
            continue
        files = [path for path in folder.rglob("*") if path.is_file()]
        with contextlib.suppress(OSError):
            # (versions before this one left no time of use on the folder, but a file system may keep that of its files)
            used = max([folder.stat().st_mtime, *(max(s.st_atime, s.st_mtime) for s in map(os.stat, files))])
            if used < time.time() - UNUSED and any(path.suffix == ".nbi" for path in files):
                shutil.rmtree(folder, ignore_errors=True)
