"""Files and folders that a user names: looked up, tested and written so that a wrong one ends in one clear line.

Whatever the system refuses (a folder of another user, a name that is too long, a full disk) is an ``InputError`` that
names the place. No MPI: call on one rank, under ``mpi.run_together`` where the others must learn of it.
"""

from __future__ import annotations

import os
import pathlib
import re
import stat

from f2s_hpc.errors import InputError

NOTHING, FILE, FOLDER, OTHER = "nothing", "file", "folder", "other"


def refused(error: OSError | MemoryError) -> InputError:
    """Return the line about what the system refused, with the name of the place where it told one."""
    if isinstance(error, MemoryError):
        detail = f" {' '.join(str(error).split())}" if str(error) else ""
        return InputError(f"not enough memory{detail}; use larger cells, a smaller box or more nodes ('f2s check' "
                          "tells what a scene takes)")
    place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
    return InputError(place + (error.strerror or " ".join(str(error).split()) or type(error).__name__))


def expanded(name: str | os.PathLike) -> pathlib.Path:
    """Return the path ``name``, with the home folder for a leading ``~`` or ``~user``.

    Raises ``InputError`` where there is no such user.
    """
    try:
        return pathlib.Path(name).expanduser()
    except RuntimeError:
        raise InputError(f"{os.fspath(name)}: no home folder is known for this ~; write the whole path") from None


def kind(path: str | os.PathLike) -> str:
    """Return what stands at ``path``: ``FILE``, ``FOLDER``, ``OTHER`` (a device, a pipe) or ``NOTHING``.

    Raises ``InputError`` where that cannot be seen, as in a folder that is not ours to read.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return NOTHING
    except OSError as error:
        raise InputError(f"{path}: cannot be reached ({error.strerror})") from None
    except ValueError:  # (a zero character)
        raise InputError(f"{os.fspath(path)!r}: cannot be the name of a file") from None
    if stat.S_ISREG(mode):
        return FILE
    return FOLDER if stat.S_ISDIR(mode) else OTHER


def entries(folder: str | os.PathLike) -> list[pathlib.Path]:
    """Return what is in ``folder``, sorted; nothing where it is no folder. Raises ``InputError`` if it is not ours."""
    if kind(folder) != FOLDER:
        return []
    try:
        return sorted(pathlib.Path(folder).iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror})") from None


def numbers(folder: str | os.PathLike, name: re.Pattern) -> list[int]:
    """Return the numbers (first group of ``name``) of what is so called in ``folder``, ascending; as ``entries``."""
    matches = (name.fullmatch(path.name) for path in entries(folder))
    return sorted(int(match[1]) for match in matches if match is not None)


def run_folder(path: str | os.PathLike) -> pathlib.Path:
    """Return ``path``, the folder of a run. Raises ``InputError`` where there is no such folder."""
    found = kind(path)
    if found != FOLDER:
        raise InputError(f"{path}: " + ("no such folder" if found == NOTHING else "is a file, not the folder of a run")
                         + "; name the folder that 'f2s run' has written")
    return pathlib.Path(path)


def check_file(path: str | os.PathLike, option: str) -> None:
    """Raise ``InputError`` if no file can be written at ``path``, which ``option`` names; nothing is written.

    To be called before work of which the result would be lost.
    """
    found, folder = kind(path), pathlib.Path(path).parent
    if found == FOLDER:
        raise InputError(f"{path}: is a folder; {option} names a file")
    if kind(folder) != FOLDER:
        raise InputError(f"{path}: cannot be written (no folder {folder}); choose a folder that exists with {option}")
    if not os.access(path if found == OTHER else folder, os.W_OK):
        raise InputError(f"{path}: cannot be written (Permission denied); name another file with {option}")


def check_folder(path: str | os.PathLike, option: str) -> None:
    """Raise ``InputError`` if ``path``, which ``option`` names, is no folder to write into and none can be made there.

    As :func:`check_file`, nothing is written.
    """
    above = pathlib.Path(os.path.abspath(path))
    while kind(above) == NOTHING:
        above = above.parent
    if kind(above) != FOLDER:
        raise InputError(f"{path}: cannot be made ({above} is a file); name another folder with {option}")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written ({above}: Permission denied); name another folder with {option}")


def make_folder(path: str | os.PathLike, option: str) -> pathlib.Path:
    """Make the folder ``path``, which ``option`` names, and those above it. Raises ``InputError``."""
    try:
        pathlib.Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be made ({error.strerror}); name another folder with {option}") from None
    return pathlib.Path(path)


def write_text(path: str | os.PathLike, text: str, newline: str | None = None) -> None:
    """Write a text file under another name, then give it its real one: a failure leaves an older file as it was.

    A device or a pipe, as /dev/stdout, is written to as it is. Raises ``InputError``.
    """
    try:
        if kind(path) == OTHER:
            pathlib.Path(path).write_text(text, encoding="utf-8", newline=newline)
            return
        # (the file that a link leads to: the link stays)
        place = pathlib.Path(os.path.realpath(path))
        partial = place.with_name(f".{place.name}.partial")
        try:
            partial.write_text(text, encoding="utf-8", newline=newline)
            os.replace(partial, place)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose a folder that exists, with room to "
                         "write") from None
