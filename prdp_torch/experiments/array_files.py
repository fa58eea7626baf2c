"""Files of named arrays, HDF5 or .npz: any file is read or refused in words, and none is half written.

What reads the formats raises errors of many types for a damaged file. `_words_for` is the one place that knows them.
"""

import contextlib
import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn, Self

import numpy as np

from prdp_torch import _C as library
from prdp_torch.experiments import _C

_DAMAGED = (
    OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, EOFError, MemoryError,
    SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


_HDF5 = (".h5", ".hdf5")


def is_npz(path: str | Path) -> bool:
    return Path(path).suffix.lower() == ".npz"


def check_name(path: str | Path) -> None:
    """ValueError unless the name of a file that is to be written tells its format; ImportError if the package h5py is
    missing for it."""
    suffix = Path(path).suffix
    if suffix.lower() not in (".npz", *_HDF5):
        got = f"'{suffix}'" if suffix else "none"
        raise ValueError(f"data: '{path}' must end in {', '.join(_HDF5)} or .npz, which tells the format; got {got}")
    if not is_npz(path):
        _h5py()


def write(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays, whole or not at all. ValueError if the file cannot be written or its name tells no format;
    ImportError if the package h5py is missing."""
    check_name(path)
    content = io.BytesIO()
    if is_npz(path):
        np.savez(content, **arrays)  # type: ignore[arg-type]  # for all it knows, one is called allow_pickle
    else:
        with _h5py().File(content, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    _C.write_whole(path, content.getvalue())  # type: ignore[arg-type]  # it takes bytes


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator["File"]:
    """The file as an object with `names()` and `array(name)`. ValueError if there is no such file, or none that can be
    read; ImportError if the package h5py is missing."""
    kind = _NpzFile if is_npz(path) else _Hdf5File
    if not is_npz(path):
        _h5py()
    with contextlib.ExitStack() as stack:
        if not Path(path).is_file():
            what = "it is not a regular file" if Path(path).exists() else "no such file"
            raise ValueError(f"data: cannot read '{path}': {what}")
        if Path(path).suffix.lower() == ".npy":
            raise ValueError(
                f"data: '{path}' holds one array without its grid; write an .npz file, "
                "np.savez(path, tensor=..., **{'x-coordinate': ..., 't-coordinate': ...}), or HDF5"
            )
        with _words_for(path):
            file = stack.enter_context(kind(path))
        yield file


class Array(NamedTuple):
    """An array of a file, whose values have not been read."""

    path: str | Path
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows: Callable[[int], np.ndarray]  # how many → an array of the first rows

    def read(self, count: int | None = None) -> np.ndarray:
        """The first rows, or all, in float32 or float64."""
        count = self.shape[0] if count is None else count
        needed = count * math.prod(self.shape[1:]) * 8
        if needed > library.physical_memory():
            raise ValueError(
                f"data: '{self.path}': {self.name} would take {needed / 1e9:.3g} GB, and this machine has "
                f"{library.physical_memory() / 1e9:.3g} GB"
            )
        with _words_for(self.path):
            values = self.rows(count)
        wanted = np.float32 if self.dtype.itemsize <= 4 else np.float64
        return np.ascontiguousarray(values, wanted)


class File:
    """What the two formats share."""

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self._file: Any = None  # of a library without types, or a zip file

    def names(self) -> list[str]:
        raise NotImplementedError

    def _look_at(self, name: str) -> Array:
        raise NotImplementedError

    def array(self, name: str) -> Array:
        """An `Array` of real numbers. ValueError if it is missing or anything else."""
        if name not in self.names():
            raise ValueError(f"data: '{self.path}' has no '{name}'; it holds: {', '.join(self.names()) or 'nothing'}")
        with _words_for(self.path):
            array = self._look_at(name)
        if array.dtype.kind != "f":
            kind = f"data: '{self.path}': {name} must hold floating-point numbers"
            raise ValueError(f"{kind}, got {_printable(array.dtype)}")
        if not array.shape:
            raise ValueError(f"data: '{self.path}': {name} must be an array, got a single number")
        return array

    def _refuse(self, name: str, what: str) -> NoReturn:
        raise _Refused(f"data: '{self.path}': {name} is {what}; the file must hold the numbers itself")


class _Refused(ValueError):
    """An error in words already."""


class _Hdf5File(File):
    def __enter__(self) -> Self:
        self._file = _h5py().File(self.path, "r")
        return self

    def __exit__(self, *_: object) -> None:
        with _words_for(self.path):
            self._file.close()

    def names(self) -> list[str]:
        with _words_for(self.path):
            return [_printable(name) for name in self._file]

    def _look_at(self, name: str) -> Array:
        h5py = _h5py()
        link = self._file.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            self._refuse(name, "an external link" if isinstance(link, h5py.ExternalLink) else "a link")
        data = self._file[name]
        if not isinstance(data, h5py.Dataset):
            self._refuse(name, "a group" if isinstance(data, h5py.Group) else "a type")
        if data.external or data.is_virtual:
            self._refuse(name, "kept in another file")
        if data.shape is None:
            self._refuse(name, "empty")
        return Array(self.path, name, tuple(data.shape), data.dtype, lambda count: data[:count])


class _NpzFile(File):
    def __enter__(self) -> Self:
        self._file = zipfile.ZipFile(self.path)
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def names(self) -> list[str]:
        return [_printable(name.removesuffix(".npy")) for name in self._file.namelist()]

    def _look_at(self, name: str) -> Array:
        info = self._file.getinfo(f"{name}.npy")
        with self._file.open(info) as entry:
            shape, by_columns, dtype = _npy_header(entry)
            start = entry.tell()
        size = math.prod(shape) * dtype.itemsize
        if dtype.kind == "f" and info.file_size != start + size:
            raise ValueError(f"{name} has {info.file_size - start} bytes, expected {size}")

        def rows(count: int) -> np.ndarray:
            part = math.prod(shape[1:]) * count * dtype.itemsize
            with self._file.open(info) as entry:
                entry.read(start)
                content = entry.read(size if by_columns else part)
            if len(content) != (size if by_columns else part):
                raise ValueError(f"{name} is cut short")
            values = np.frombuffer(bytearray(content), dtype)  # which torch may write to
            return values.reshape(shape, order="F")[:count] if by_columns else values.reshape(count, *shape[1:])

        return Array(self.path, name, shape, dtype, rows)


def _npy_header(entry: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether the first index runs fastest, and dtype, which may be anything."""
    version = np.lib.format.read_magic(entry)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array in version {version} of the format")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, by_columns, dtype = read(entry)
    if not all(isinstance(n, int) and 0 <= n < 2**62 for n in shape):
        raise ValueError("an array of an impossible shape")
    return tuple(map(int, shape)), by_columns, dtype


@contextlib.contextmanager
def _words_for(path: str | Path) -> Iterator[None]:
    """Turn what the readers of the formats raise for a damaged file into one sentence."""
    try:
        yield
    except _Refused:
        raise
    except _DAMAGED as error:
        words = _printable(error.strerror or error if isinstance(error, OSError) else error)
        raise ValueError(
            f"data: cannot read '{path}': {words}; it is damaged or of another format, write it again"
        ) from None


def _printable(what: object) -> str:
    """In one line."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(what)).split())[:200]


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise ImportError("data: HDF5 files need the package h5py; pip install h5py, or take an .npz file") from None
    return h5py
