"""Files that are whole or not there."""

from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import itertools
import os
from pathlib import Path
from typing import Final

from rhp_drake.errors import InputError, WorkError


def make_folder(path: Path) -> None:
    """Makes a folder and those above it, unless there.

    Long work does so before it begins, not to learn at its end that it cannot be.

    Raises:
        InputError: If it cannot be made, or not be written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: no folder can be made: {error.strerror}.") from None
    if not os.access(path, os.W_OK):
        raise InputError(f"{path}: this folder cannot be written to.")


def make_new_folder(path: Path) -> Path:
    """Makes a folder that was not there, and returns it.

    If `path` is there, it is called as `path` with _2, _3 and so on after its name: no
    two processes get the same.

    Raises:
        InputError: If it cannot be made.
    """
    make_folder(path.parent)
    for number in itertools.count(1):
        folder = path if number == 1 else path.with_name(f"{path.name}_{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(
                f"{folder}: no folder can be made: {error.strerror}."
            ) from None
        break
    return folder


def check_writable(path: Path) -> None:
    """Makes the folder of a file that long work will write.

    Raises:
        InputError: If it cannot be made, or the file is a folder.
    """
    make_folder(path.parent)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not a file to write.")


# Hidden, so that nobody takes what a killed process leaves for one of the files.
_TEMPORARY: Final = ".{name}.{process}.tmp"


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes under another name in the same folder, then renames.

    Whoever reads `path` sees the old content or the new, never a half, also after a
    power cut; the folder is made if need be.

    Raises:
        WorkError: If it cannot be written, for example because the disk is full.
    """
    make_folder(path.parent)
    temporary = path.with_name(_TEMPORARY.format(name=path.name, process=os.getpid()))
    data = content.encode() if isinstance(content, str) else content
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise WorkError(f"{path}: cannot be written: {error.strerror}.") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Works in a folder that no other process works in at the same time.

    What `write_atomically` left there when it was killed is removed.

    Raises:
        InputError: If another process does work there.
    """
    make_folder(folder)
    with (folder / "_lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{folder}: another process works there.") from None
        for leftover in folder.rglob(_TEMPORARY.format(name="*", process="*")):
            leftover.unlink()
        yield
