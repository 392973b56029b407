"""numba's cache of compiled code on disk, made to survive whatever happens to it.

numba keeps an index and numbered files and trusts both: half a file stops every run
until somebody removes it, and a process killed between the two leaves an index that
names older code. Here each file says what it holds and is sealed by its hash. A damaged
one counts as absent; what can't be written, or has no folder, is compiled again.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import pickle
from collections.abc import Iterator
from functools import partial
from typing import Any

import numba
from numba import guvectorize
from numba.core import caching

from bcrl.errors import BcrlError

#: A decorator as numba.njit, whose compiled code is kept on disk.
kept = partial(numba.njit, cache=True)

__all__ = ["check", "guvectorize", "kept", "why_uncached"]

SEAL = hashlib.sha256().digest_size  # bytes at a file's end


class Files(caching.IndexDataCacheFile):
    """What is kept of one function: a file for each signature and processor."""

    def __init__(self, cache_path: str, filename_base: str, source_stamp: Any) -> None:
        super().__init__(cache_path, filename_base, source_stamp)
        self._stem, self._source = filename_base, (self._version, source_stamp)

    def load(self, key: Any) -> Any:
        """The compiled code that was kept under this key, or None."""
        for _, about, data in self._kept():
            if about == (*self._source, key):
                return pickle.loads(data)
        return None

    def save(self, key: Any, data: Any) -> None:
        """Keep code, in place of a damaged or outdated file or in a new one."""
        mine = (*self._source, key)
        content = self._dump((mine, self._dump(data)))
        for path, about, _ in self._kept():
            if about is None or about == mine or about[:2] != self._source:
                with contextlib.suppress(OSError):
                    with self._open_for_write(path) as file:
                        file.write(content + hashlib.sha256(content).digest())
                    return

    def flush(self) -> None:
        """Nothing: what is outdated is never asked for."""

    def _kept(self) -> Iterator[tuple[str, Any, Any]]:
        """Each file's path, what it holds and its code; the last is yet to be made."""
        for number in itertools.count(1):
            path = os.path.join(self._cache_path, f"{self._stem}.sealed{number}.nbc")
            yield path, *_read(path)
            if not os.path.lexists(path):
                return


def _read(path: str) -> tuple[Any, Any]:
    """What a file holds and its code, None and None if it isn't as it was written."""
    try:
        with open(path, "rb") as file:
            stored = file.read()
        content, seal = stored[:-SEAL], stored[-SEAL:]
        if hashlib.sha256(content).digest() == seal:
            return pickle.loads(content)
    except Exception:  # of another version of numba, perhaps: pickles raise anything
        pass
    return None, None


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
