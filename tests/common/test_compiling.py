"""Kept compiled code: damaged, older or missing files only cost time."""

import os
from pathlib import Path

import pytest

from bcrl.common import compiling
from bcrl.errors import BcrlError
from tests.conftest import plan


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "short": lambda path: path.write_bytes(path.read_bytes()[:20]),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-7]),
    "flipped": flip,
    "foreign": lambda path: path.write_bytes(os.urandom(500)),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a dangling link": lambda path: (path.unlink(), path.symlink_to("nowhere")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_code_counts_as_absent_and_is_replaced(tmp_path, damage):
    kept = compiling.Files(str(tmp_path), "f-1.py3", "source")
    kept.save("float", {"code": 1})
    (path,) = tmp_path.glob("*.nbc")
    kept.save("int", {"code": 2})
    DAMAGES[damage](path)
    assert (kept.load("float"), kept.load("int")) == (None, {"code": 2})
    kept.save("float", {"code": 3})
    again = None if damage == "a folder" else {"code": 3}
    assert (kept.load("float"), kept.load("int")) == (again, {"code": 2})


def test_code_of_an_older_source_is_never_loaded_and_is_replaced(tmp_path):
    older = compiling.Files(str(tmp_path), "f-1.py3", "older source")
    older.save("float", "older")
    newer = compiling.Files(str(tmp_path), "f-1.py3", "newer source")
    assert newer.load("float") is None
    newer.save("float", "newer")
    assert (older.load("float"), newer.load("float")) == (None, "newer")
    assert len(list(tmp_path.glob("*.nbc"))) == 1


def doubling():
    @compiling.kept
    def double(x):
        return 2 * x

    return double


@pytest.mark.parametrize("damage", [None, "cut"])
def test_a_function_is_compiled_in_any_case(tmp_path, monkeypatch, damage):
    monkeypatch.setattr(compiling.numba.config, "CACHE_DIR", str(tmp_path))
    assert doubling()(4) == 8
    (path,) = tmp_path.rglob("*double*.nbc")
    if damage:
        DAMAGES[damage](path)
    again = doubling()
    assert again(4) == 8
    assert sum(again.stats.cache_hits.values()) == (damage is None)


def test_without_a_folder_code_is_compiled_with_a_message(monkeypatch):
    impl = compiling.caching.CompileResultCacheImpl
    monkeypatch.setattr(impl, "_locator_classes", [])
    monkeypatch.setattr(compiling, "_UNCACHED", [])
    assert compiling.why_uncached() is None
    assert doubling()(5) == 10
    message = compiling.why_uncached()
    assert "NUMBA_CACHE_DIR" in message and str(Path(__file__).parent) in message


def test_a_folder_that_has_vanished_only_costs_time(tmp_path):
    kept = compiling.Files(str(tmp_path / "gone"), "f-1.py3", "source")
    kept.save("float", 1)
    assert kept.load("float") is None and not (tmp_path / "gone").exists()


def test_numba_that_may_not_compile_is_reported(monkeypatch):
    monkeypatch.setattr(compiling.numba.config, "DISABLE_JIT", 1)
    with pytest.raises(BcrlError, match="NUMBA_DISABLE_JIT"):
        plan("env=maze")
