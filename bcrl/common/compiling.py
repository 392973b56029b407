"""numba's cache of compiled code on disk, made safe against damage and old code.

numba trusts its index and its numbered files: half a file stops every run until someone
removes it, and a process killed between two writes leaves an index that names older
code. Here a hash at the end of each file seals its content together with the source and
the key it belongs to. A damaged file counts as absent. If the cache can't be written,
the code is compiled again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numba
from numba.core import caching

from bcrl.errors import BcrlError

#: A decorator like numba.njit whose compiled code is kept on disk.
kept: Any = functools.partial(numba.njit, cache=True)

_SEAL = hashlib.sha256().digest_size  # bytes at the end of a file


class Files(caching.IndexDataCacheFile):
    """numba's cache files of one function, each with a seal, which numba ignores."""

    def load(self, key: Any) -> Any:
        """The compiled code for this key, or None."""
        self._key = key
        try:
            return super().load(key)
        except Exception:  # damaged, or written by another version of numba
            return None

    def save(self, key: Any, data: Any) -> None:
        """Write code; replace a damaged or outdated file."""
        self._key = key
        with contextlib.suppress(OSError):
            super().save(key, data)

    def _load_index(self) -> dict:
        return super()._load_index() if self._is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        if not self._is_whole(self._data_path(name)):
            raise OSError(f"{name} is damaged or holds other code")
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[IO[bytes]]:
        with super()._open_for_write(filepath) as file:
            yield file
            file.flush()
            file.write(self._seal(filepath, Path(file.name).read_bytes()))

    def _is_whole(self, path: str) -> bool:
        try:
            stored = Path(path).read_bytes()
        except OSError:
            return False
        return stored[-_SEAL:] == self._seal(path, stored[:-_SEAL])

    def _seal(self, path: str, content: bytes) -> bytes:
        key = None if path == self._index_path else self._key
        about = repr((self._version, self._source_stamp, key)).encode()
        return hashlib.sha256(content + about).digest()


class Nowhere(caching._CacheLocator):
    """numba's last resort: a function whose code no folder can keep."""

    tried: str | None = None  # the folder beside the last such function

    def __init__(self, py_func: Any, py_file: str) -> None:
        Nowhere.tried = os.path.join(os.path.dirname(py_file), "__pycache__")

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Nowhere:
        return cls(py_func, py_file)

    def ensure_cache_path(self) -> None: ...

    def get_cache_path(self) -> str:
        return os.path.join(os.devnull, "numba")  # can't exist

    def get_source_stamp(self) -> str:
        return ""

    get_disambiguator = get_source_stamp


@functools.cache
def _sources(folder: str) -> str:
    """A hash of all modules in a folder."""
    digest = hashlib.sha256()
    for path in sorted(Path(folder).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _source_stamp(locator: Any) -> str:
    """What outdates a function's code: a change of any module beside the function.

    numba compares only the function's own module, but compiled code contains the
    functions of other modules that it calls. Ours stand in the same package.
    """
    return _sources(os.path.dirname(locator._py_file))


def _register() -> None:
    """Make numba keep compiled code in this way from now on."""
    if caching.IndexDataCacheFile is Files:
        return
    caching.IndexDataCacheFile = Files
    caching._SourceFileBackedLocatorMixin.get_source_stamp = _source_stamp
    usual = caching.Cache.save_overload

    def save_overload(cache: caching.Cache, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError):  # for example, the folder has vanished
            usual(cache, sig, data)

    caching.Cache.save_overload = save_overload
    # Without a home, numba would make a folder called ~ in the current one.
    user = os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
    locators = caching.CompileResultCacheImpl._locator_classes
    known = os.path.isabs(user)
    locators[:] = [x for x in locators if known or "UserWide" not in x.__name__]
    locators.append(Nowhere)
    if numba.config.CACHE_DIR:
        numba.config.CACHE_DIR = os.path.expanduser(numba.config.CACHE_DIR)


def check() -> None:
    """Raise BcrlError if numba may not compile: some loops need it."""
    if numba.config.DISABLE_JIT:
        why = "bcrl's loops have to be compiled; unset it (env -u NUMBA_DISABLE_JIT)"
        raise BcrlError(f"NUMBA_DISABLE_JIT={numba.config.DISABLE_JIT}: {why}")


def why_uncached() -> str | None:
    """Why compiled code is lost with the process and what to do; None if it is kept."""
    if Nowhere.tried is None:
        return None
    return (
        f"compiled code isn't kept, so each start takes a minute longer: neither "
        f"{Nowhere.tried} nor your cache folder can be written; set NUMBA_CACHE_DIR "
        "to a folder that can"
    )


_register()
