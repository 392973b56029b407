"""Kept compiled code: damaged, older or missing files only cost time."""

import numba
import pytest

from bcrl.common import compiling, numba_cache
from bcrl.errors import BcrlError
from bcrl.run import runner
from tests.conftest import plan

DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-7]),
    "changed": lambda path: path.write_bytes(path.read_bytes().replace(b"0", b"1")),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


def doubled(number: int) -> bool:
    """Check a compiled function; whether its code came from the disk."""

    @compiling.kept
    def double(x):
        return 2 * x

    assert double(number) == 2 * number
    return bool(double.stats.cache_hits)


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_code_is_compiled_again_and_replaced(tmp_path, monkeypatch, damage):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert not doubled(4) and doubled(4)
    for path in list(tmp_path.rglob("*double*.nb?")):
        DAMAGES[damage](path)
    assert not doubled(4)
    assert doubled(4) == (damage != "a folder")


def test_code_of_an_older_source_is_never_loaded_and_is_replaced(tmp_path):
    older = numba_cache.Files(str(tmp_path), "f-1.py3", "older source")
    older.save("float", "older")
    newer = numba_cache.Files(str(tmp_path), "f-1.py3", "newer source")
    assert newer.load("float") is None
    newer.save("float", "newer")
    assert (older.load("float"), newer.load("float")) == (None, "newer")
    assert len(list(tmp_path.glob("*.nbc"))) == 1


def test_without_a_folder_code_is_compiled_each_time(monkeypatch):
    impl = numba.core.caching.CompileResultCacheImpl
    monkeypatch.setattr(impl, "_locator_classes", [])
    assert not doubled(5) and not doubled(5)


def test_numba_that_may_not_compile_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    with pytest.raises(BcrlError, match="NUMBA_DISABLE_JIT"):
        runner.run(plan("env=maze", f"runs_dir={tmp_path}"))
