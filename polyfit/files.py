"""Files that are either whole or not there: written aside, then renamed. Text files in whatever
encoding programs write. And image files that are read without a word of the decoders.
"""

import codecs
import contextlib
import errno
import json
import math
import os
import shutil
import tempfile
import threading
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError

# Numbers of the OSErrors that say that no more can be written
DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

# What reading arrays from an .npz raises where it is damaged, or none: NumPy, zipfile and zlib each
# have their own, and an .npy is no archive
NOT_NPZ = (
    OSError, ValueError, EOFError, AttributeError, TypeError, NotImplementedError,
    zipfile.BadZipFile, zlib.error, tokenize.TokenError,
)  # fmt: skip


def read_npz(path: str | os.PathLike[str], keys: Iterable[str], what: str) -> dict[str, np.ndarray]:
    """Those of the arrays ``keys`` that a ``.npz`` has, by name. Raises InputError for a file that
    is none, which cannot be read as ``what``.
    """
    try:
        with open(path, "rb") as file:
            if file.read(2) != b"PK":  # of other files NumPy would say that they are pickles
                raise ValueError("no .npz file")
        with np.load(path, allow_pickle=False) as arrays:
            return {key: arrays[key] for key in keys if key in arrays.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except NOT_NPZ as error:
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: cannot be read as {what} ({why})") from None


_LITTER = ".DS_Store", "Thumbs.db", "desktop.ini"
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # before UTF-16, whose mark it begins with
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def text_encoding(path: str | os.PathLike[str]) -> str:
    """The encoding of a text file: by its byte order mark; without one UTF-16, if every other of
    its first bytes is zero, or UTF-8.
    """
    with open(path, "rb") as file:
        head = file.read(64)
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    if len(head) > 1 and not any(head[1::2]):
        return "utf-16-le"
    return "utf-16-be" if len(head) > 1 and not any(head[::2]) else "utf-8"


def json_text(value: Any, **options: Any) -> str:
    """A value as JSON, which has no NaN and no infinity: they become null. Arrays' numbers are
    numbers; ``options``: of :func:`json.dumps`.
    """
    return json.dumps(_plain(value), allow_nan=False, **options)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(x) for name, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(x) for x in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """An OSError of the block that names no file, as a full disk's does where a file is flushed,
    names ``path``.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = os.fspath(path)
        raise


@contextlib.contextmanager
def aside(path: str | os.PathLike[str]) -> Iterator[str]:
    """``with aside(path) as temporary:`` write the file ``temporary``; it becomes ``path`` at the
    end of the block.

    The name keeps its extension, because writers choose the format by it. On any exception (Ctrl-C
    included) what was written is removed and what stood at ``path`` before stays. An OSError of the
    write names ``path``.
    """
    folder, name = os.path.split(os.fspath(path))
    temporary = os.path.join(folder, f".{os.getpid()}.partial.{name}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            # a full disk shows here at the latest, before the rename
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.remove(temporary)
        if (
            isinstance(error, OSError)
            and error.errno is not None
            and error.filename in (None, temporary)
        ):
            # the name that the user knows; a full disk comes with none
            error.filename = os.fspath(path)
        raise


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make the folder ``path`` and its parents, as far as they are not there. Raises InputError
    where it is a file.
    """
    try:
        os.makedirs(path, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{path}: is a file; a folder is needed") from None


def as_path(path: Any, what: str) -> str:
    """The path of the file ``what`` as text. Raises InputError for what is no path, as None."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{what} of type {type(path).__name__}; a file's name is needed")
    return os.fspath(path)


@contextlib.contextmanager
def folder_for(path: str | os.PathLike[str]) -> Iterator[None]:
    """``with folder_for(path):`` the folder ``path`` and its parents exist inside the block.

    Where the block ends by an exception, those of them that it made and left empty are removed.
    """
    path = Path(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    make_folder(path)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # the first that is not empty ends it
            for folder in made:
                folder.rmdir()
        raise


@contextlib.contextmanager
def folder_aside(
    path: str | os.PathLike[str], ours: Callable[[str], bool], sign: str
) -> Iterator[str]:
    """``with folder_aside(path, ours, sign) as temporary:`` fill the folder ``temporary``; it
    becomes ``path`` at the end of the block, or is removed on any exception.

    What stands at ``path`` is replaced where it is an empty folder, or one that has a file that
    matches the pattern ``sign``, and that :func:`others` finds nothing in; else it is refused by an
    InputError. An OSError of the write names ``path``.
    """
    path = os.path.realpath(path)
    signed = any(Path(path).glob(sign))  # names alone may be those of anybody's files
    known = ours if signed else lambda name: False
    if os.path.lexists(path) and (not os.path.isdir(path) or others(path, known)):
        raise InputError(
            f"{path}: {'holds other files' if os.path.isdir(path) else 'is a file'}; a new or empty"
            " folder is needed"
        )
    temporary = os.path.join(
        os.path.dirname(path), f".{os.getpid()}.partial.{os.path.basename(path)}"
    )
    try:
        os.mkdir(temporary)
        try:
            yield temporary
            if os.path.isdir(path):
                shutil.rmtree(path)
            os.rename(temporary, path)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except OSError as error:
        at = str(error.filename or temporary)  # a full disk names none where a file is flushed
        if error.errno is not None and at.startswith(temporary):
            error.filename = path + at[len(temporary) :]
        raise


def others(folder: str | os.PathLike[str], ours: Callable[[str], bool]) -> list[str]:
    """What of a folder is not ``ours``: its files, and its folders that are empty, by their paths
    in it, with slashes, of which ``ours(path)`` is not true. Links are not followed; what file
    managers leave does not count.
    """
    return [
        name
        for path in sorted(Path(folder).rglob("*"))
        if path.is_symlink() or not path.is_dir() or not any(path.iterdir())
        if path.name not in _LITTER and not ours(name := path.relative_to(folder).as_posix())
    ]


def check_aside(
    path: str | os.PathLike[str], ours: Callable[[str], bool], sign: str, what: str, overwrite: bool
) -> None:
    """Raises InputError where :func:`folder_aside` could not make the folder ``path``, before
    anything is computed: it cannot be written, is not empty without ``overwrite``, or holds no
    ``what`` (a file that matches the pattern ``sign``) or something else beside it.
    """
    place = Path(os.path.realpath(path))
    if place.exists() and not place.is_dir():
        raise InputError(f"{path}: is a file; OUT must be a folder")
    if place.is_dir() and any(place.iterdir()):
        if not overwrite:
            raise InputError(f"{path}: not empty; give another -o, or --overwrite")
        only = "--overwrite replaces nothing else"
        if not any(place.glob(sign)):
            raise InputError(f"{path}: holds no {what}; {only}")
        if found := others(place, ours):
            raise InputError(f"{path}: holds {found[0]}, which is not of a {what}; {only}")
    if os.path.ismount(place):
        raise InputError(f"{path}: is where a disk is mounted; a folder in it is needed")
    existing = place.parent
    while not os.path.lexists(existing):
        existing = existing.parent
    try:
        os.rmdir(tempfile.mkdtemp(dir=existing))
    except OSError:
        raise InputError(
            f"-o '{path}': {existing} is not a folder that can be written to; another one is needed"
        ) from None


class _SilentDecoders:
    """While any thread is inside, what is written to the process's stderr is dropped: libtiff,
    libpng, libjpeg and OpenCV tell there of a broken file, beside the error that we raise.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._saved: int | None = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._saved = self._redirected()
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside and self._saved is not None:
                    os.dup2(self._saved, 2)
                    os.close(self._saved)

    @staticmethod
    def _redirected() -> int | None:
        """A copy of the descriptor of stderr, which now leads nowhere; None where it is closed."""
        try:
            saved = os.dup(2)
        except OSError:
            return None
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)
        return saved


silent_decoders = _SilentDecoders()
