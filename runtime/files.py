"""Files that appear whole or not at all."""

from __future__ import annotations

import ctypes
import os
import re
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

# What NumPy raises for an .npy that is damaged, or none, and for an archive; RuntimeError: an encrypted one.
DAMAGED_ARRAY = (OSError, ValueError, EOFError, SyntaxError, tokenize.TokenError)
DAMAGED_ARCHIVE = (*DAMAGED_ARRAY, KeyError, TypeError, IndexError, RuntimeError, zipfile.BadZipFile, zlib.error)
LARGE = 2**31 - 2**20  # bytes: from here on, an archive's member needs 64-bit sizes


def map_array(path: Path) -> npt.NDArray[Any]:
    """An `.npy`, mapped into memory. Raises one of `DAMAGED_ARRAY` if it is none."""
    found = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(found, np.ndarray):
        found.close()
        raise ValueError("an archive of arrays")
    return found


def temporary_name(path: Path) -> Path:
    """A hidden name beside the file that nobody else has, with the same suffix. Processes in containers share numbers."""
    return path.with_name(f".{path.stem}.{os.urandom(8).hex()}.tmp{path.suffix}")


def remove_temporaries(folder: Path) -> None:
    """Remove the files under such names that kills have left in a folder of which this process is the only owner."""
    for path in folder.glob(".*.tmp*"):
        if re.fullmatch(r"\..*\.[0-9a-f]{16}\.tmp(\.[^.]*)?", path.name) and path.is_file():
            path.unlink(missing_ok=True)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Write beside the file, then put it in place: a kill or a full disk leaves the old one, or none."""
    temporary = temporary_name(path)
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def locked(path: Path, shared: bool = False) -> BinaryIO:
    """A lock file in a folder, which is made if it is not there; held until it is closed. Whoever dies lets go of it.

    Raises BlockingIOError if another process holds it, or with `shared` if one holds it alone; OSError.
    """
    import fcntl

    while True:
        path.parent.mkdir(exist_ok=True)
        try:
            file = open(path, "a+b")  # noqa: SIM115
        except FileNotFoundError:
            continue  # its last owner has removed the folder just now
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                return file
        except FileNotFoundError:
            pass
        except OSError:
            file.close()
            raise
        file.close()


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write a NumPy archive. Equal arrays give equal bytes, whatever the day. Raises OSError."""
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(member, "w", force_zip64=array.nbytes > LARGE) as stream:
                np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)


def exchanged(one: Path, other: Path) -> bool:
    """Let two files or folders take each other's name at once, where the system can (Linux's renameat2). Whether it did."""
    if os.name != "posix" or not hasattr(libc := ctypes.CDLL(None), "renameat2"):
        return False
    here, at_once = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return bool(libc.renameat2(here, os.fsencode(one), here, os.fsencode(other), at_once) == 0)


def sync(path: Path) -> None:
    """Make sure that a finished file is on the disk and not only in its cache."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())
