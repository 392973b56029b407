"""numba's cache of compiled code on disk, made safe against damage and old code.

numba trusts its files: half a file stops every run until someone removes it. Here each
function has one file per signature, with a seal at its end: a hash of the content and
of the source and key it belongs to. A damaged file counts as absent.
"""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

_SEAL = hashlib.sha256().digest_size  # bytes at the end of a file


def njit(function: Callable, options: dict[str, Any]) -> Any:
    """numba's dispatcher of a function, whose code is kept on disk only if possible."""
    try:
        return numba.njit(function, **options)
    except RuntimeError:  # numba finds no folder that it can write
        return numba.njit(function, **options | {"cache": False})


class Files(caching.IndexDataCacheFile):
    """The files of one function, in place of numba's numbered ones and their index."""

    def load(self, key: Any) -> Any:
        """The compiled code for this key, or None."""
        with suppress(Exception):  # damaged, or written by another version of numba
            stored = Path(self._path(key)).read_bytes()
            if stored[-_SEAL:] == self._seal(key, stored[:-_SEAL]):
                return self._load_data(self._path(key))  # which ignores the seal
        return None

    def save(self, key: Any, data: Any) -> None:
        """Write code; replace a damaged or outdated file."""
        content = self._dump(data)
        with suppress(OSError), self._open_for_write(self._path(key)) as file:
            file.write(content + self._seal(key, content))

    def _path(self, key: Any) -> str:
        """The place of a signature's code on one processor, whatever the code is."""
        name = hashlib.sha256(repr(key[:2]).encode()).hexdigest()[:12]
        return self._data_path(self._index_name.replace(".nbi", f".{name}.nbc"))

    def _seal(self, key: Any, content: bytes) -> bytes:
        about = repr((self._version, self._source_stamp, key)).encode()
        return hashlib.sha256(content + about).digest()


def _source_stamp(locator: Any) -> str:
    """What outdates a function's code: a change of any module in its folder."""
    paths = sorted(Path(locator._py_file).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


caching.IndexDataCacheFile = Files
caching._SourceFileBackedLocatorMixin.get_source_stamp = _source_stamp
numba.config.CACHE_DIR = os.path.expanduser(numba.config.CACHE_DIR)
# Without a home, numba would make a folder called ~ in the current one.
if not os.path.isabs(os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))):
    caching.CompileResultCacheImpl._locator_classes.remove(caching.UserWideCacheLocator)
