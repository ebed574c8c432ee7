"""Files that are whole or not there."""

import os
from pathlib import Path

from rhp_drake.errors import InputError, WorkError


def make_folder(path: Path) -> None:
    """Makes a folder and those above it, unless there.

    Long work does so before it begins, not to learn at its end that it cannot be.

    Raises:
        InputError: If it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: no folder can be made: {error.strerror}.") from None


def check_writable(path: Path) -> None:
    """Makes the folder of a file that long work will write.

    Raises:
        InputError: If it cannot be made, or the file is a folder.
    """
    make_folder(path.parent)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not a file to write.")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes under another name in the same folder, then renames.

    Whoever reads `path` sees the old content or the new, never a half; the folder is
    made if need be.

    Raises:
        WorkError: If it cannot be written, for example because the disk is full.
    """
    make_folder(path.parent)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    data = content.encode() if isinstance(content, str) else content
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        raise WorkError(f"{path}: cannot be written: {error.strerror}.") from error
    finally:
        temporary.unlink(missing_ok=True)
