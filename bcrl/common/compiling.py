"""numba's cache of compiled code on disk, made to survive whatever happens to it.

numba keeps an index and numbered files and trusts both: half a file stops every run
until somebody removes it, and a process killed between the two leaves an index that
names older code. Here each file is sealed by a hash of it and of what it belongs to. A
damaged one counts as absent; what can't be written, or has no folder, is compiled
again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from functools import partial
from typing import IO, Any

import numba
from numba import guvectorize
from numba.core import caching

from bcrl.errors import BcrlError

#: A decorator as numba.njit, whose compiled code is kept on disk.
kept = partial(numba.njit, cache=True)

__all__ = ["check", "guvectorize", "kept", "why_uncached"]

SEAL = hashlib.sha256().digest_size  # bytes at a file's end


class Files(caching.IndexDataCacheFile):
    """numba's files of one function, each with a seal at its end, which numba skips."""

    def load(self, key: Any) -> Any:
        """The compiled code that was kept under this key, or None."""
        self._key = key
        try:
            return super().load(key)
        except Exception:  # sealed by another version of numba, perhaps
            return None

    def save(self, key: Any, data: Any) -> None:
        """Keep code, in place of what is damaged or outdated."""
        self._key = key
        with contextlib.suppress(OSError):  # what can't be kept is compiled again
            super().save(key, data)

    def _load_index(self) -> dict:
        return super()._load_index() if self._is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        if not self._is_whole(self._data_path(name)):
            raise OSError(f"{name} is damaged, or holds other code")
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[IO[bytes]]:
        with super()._open_for_write(filepath) as file:
            yield file
            file.flush()
            with open(file.name, "rb") as written:
                file.write(self._seal(filepath, written.read()))

    def _is_whole(self, path: str) -> bool:
        try:
            with open(path, "rb") as file:
                stored = file.read()
        except OSError:
            return False
        return stored[-SEAL:] == self._seal(path, stored[:-SEAL])

    def _seal(self, path: str, content: bytes) -> bytes:
        """A hash of a file, and of the source and the key that its code belongs to."""
        key = None if path == self._index_path else self._key
        about = repr((self._version, self._source_stamp, key)).encode()
        return hashlib.sha256(content + about).digest()


class Nowhere(caching._CacheLocator):
    """The last resort, of functions that no folder can keep."""

    tried: str | None = None  # the folder beside the last such function

    def __init__(self, py_func: Any, py_file: str) -> None:
        Nowhere.tried = os.path.join(os.path.dirname(py_file), "__pycache__")

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Nowhere:
        return cls(py_func, py_file)

    def ensure_cache_path(self) -> None: ...

    def get_cache_path(self) -> str:
        return os.path.join(os.devnull, "numba")  # never there, nor can it be made

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return ""


def _register() -> None:
    """Have numba keep compiled code in this way, from here on."""
    if caching.IndexDataCacheFile is Files:
        return
    caching.IndexDataCacheFile = Files
    usual = caching.Cache.save_overload

    def save_overload(cache: caching.Cache, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError):  # the folder has vanished, say
            usual(cache, sig, data)

    caching.Cache.save_overload = save_overload
    # Without a home numba would make a folder called ~ in the current one.
    user = os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
    locators = caching.CompileResultCacheImpl._locator_classes
    known = os.path.isabs(user)
    locators[:] = [x for x in locators if known or "UserWide" not in x.__name__]
    locators.append(Nowhere)
    if numba.config.CACHE_DIR:
        numba.config.CACHE_DIR = os.path.expanduser(numba.config.CACHE_DIR)


def check() -> None:
    """BcrlError if numba was told not to compile; parts of ours can't do without."""
    if numba.config.DISABLE_JIT:
        text = "bcrl's loops have to be compiled; unset it (env -u NUMBA_DISABLE_JIT)"
        raise BcrlError(f"NUMBA_DISABLE_JIT={numba.config.DISABLE_JIT}: {text}")


def why_uncached() -> str | None:
    """A sentence for those whose compiled code is lost with the process."""
    if Nowhere.tried is None:
        return None
    return (
        f"compiled code isn't kept, so each start takes a minute longer: neither "
        f"{Nowhere.tried} nor a cache folder of yours can be written; set "
        "NUMBA_CACHE_DIR to one that can"
    )


_register()
