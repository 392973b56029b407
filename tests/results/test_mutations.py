"""Whatever happens to result files: bcrl-verify names those whose values changed."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from bcrl.common.identity import identity
from bcrl.results import verify
from bcrl.results.layout import DQN_METRICS, FQI_METRICS, SUFFIXES, seed_path
from tests.results.made_up import made_up_plan, write_seeds

VARIANTS = {
    "maze/BC-FQI": FQI_METRICS["maze"],
    "maze/C-FQI@tag": FQI_METRICS["maze"],
    "linear_system/DQN": DQN_METRICS,
}
SEEDS = 2
TRIES = 24  # of each kind
Rng = np.random.Generator


def grow(root: Path) -> None:
    """A tree of complete runs, small and all different."""
    rng = np.random.default_rng(0)
    for name, metrics in VARIANTS.items():
        env, variant = name.split("/")
        counter = "step" if "DQN" in variant else "iteration"
        index = {"stage": [1, 1, 2, 2], "task": [1, 1, 2, 2], counter: range(1, 5)}

        def table(seed: int, index=index, columns=metrics):
            return pd.DataFrame(index | {c: rng.normal(size=4) for c in columns})

        plan = made_up_plan(root, env, variant, range(SEEDS))
        facts = {"optimum": -47.5, "cpu_seconds": 1.25}
        write_seeds(plan, table, lambda _: {"q": rng.normal(size=6)}, facts)


def other_number(data: bytes, at: int, rng: Rng) -> bytes:
    start, end = rng.choice([match.span() for match in re.finditer(rb"\d+", data)])
    return data[:start] + rng.choice([b"7", b"-1", b"2.5", b"nan"]) + data[end:]


def flipped_bit(data: bytes, at: int, rng: Rng) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << rng.integers(8)]) + data[at + 1 :]


BYTES: dict[str, Callable[[bytes, int, Rng], bytes]] = {
    "change a number": other_number,
    "flip a bit": flipped_bit,
    "cut": lambda data, at, rng: data[:at],
    "insert": lambda data, at, rng: data[:at] + rng.bytes(3) + data[at:],
    "drop bytes": lambda data, at, rng: data[:at] + data[at + rng.integers(1, 9) :],
    "empty": lambda data, at, rng: b"",
}


def swap(one: Path, other: Path) -> None:
    before = one.read_bytes()
    one.write_bytes(other.read_bytes() if other.exists() else b"")
    other.write_bytes(before)


def copy_seed(one: Path, other: Path) -> None:
    """A seed once more, under another number and perhaps in another variant."""
    number = re.search(r"\d+", other.name)
    j = int(number[0]) if number else 3
    for suffix in SUFFIXES:
        source = seed_path(one.parent, int(j == 0), suffix)
        shutil.copy(source, seed_path(other.parent, j, suffix))


def copy_folder(one: Path, other: Path) -> None:
    """A variant under another's name, in its place or as a new one."""
    target = one.parent.with_name(f"{other.parent.name}@{other.stem}")
    if one.parent != other.parent:
        shutil.rmtree(target := other.parent)
    shutil.copytree(one.parent, target)


FILES: dict[str, Callable[[Path, Path], object]] = {
    "swap": swap,
    "copy": shutil.copy,
    "move": Path.rename,
    "delete": lambda one, other: one.unlink(),
    "copy a seed": copy_seed,
    "copy a folder": copy_folder,
}
NEW = ("seed_0000 (copy).csv", "seed_0001.csv.bak", "seed_0001.json~")
NEW += ("seed_0002.csv", "seed_0002.json", "seed_0002.npz")


def mutate(kind: str, root: Path, rng: Rng) -> None:
    """Something of this kind, to random files."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    one = rng.choice(files)
    if kind in BYTES:
        data = one.read_bytes()
        one.write_bytes(BYTES[kind](data, int(rng.integers(len(data))), rng))
    else:
        new = [root / "smoke" / variant / name for variant in VARIANTS for name in NEW]
        FILES[kind](one, rng.choice([path for path in files + new if path != one]))


def value(name: str, data: bytes) -> object:
    """What counts of a file: the bytes of a CSV or NPZ, the values of JSON and YAML."""
    try:
        if name.endswith("json"):
            return json.dumps(json.loads(data), sort_keys=True)
        if name.endswith("yaml"):
            return json.dumps(identity(yaml.safe_load(data)), sort_keys=True)
    except Exception:
        return data
    return data


def read(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def is_named(name: str, root: Path, lines: list[str]) -> bool:
    """Whether a line begins with the file, another of its seed, or its folder."""
    path = root / name
    seed = re.match(r"seed_\d+", path.name)
    starts = [f"{path} ", f"{path.parent} "]
    starts += [f"{path.with_name(seed[0])}.{suffix} " for suffix in SUFFIXES if seed]
    return any(line.split(": ", 1)[1].startswith(tuple(starts)) for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*BYTES, *FILES])
def test_every_changed_value_is_caught_by_name(tmp_path, capsys, kind):
    grow(tmp_path)
    intact = read(tmp_path)
    assert verify.main([str(tmp_path)]) == 0
    rng, caught = np.random.default_rng(2022), set()
    for _ in range(TRIES):
        mutate(kind, tmp_path, rng)
        after = read(tmp_path)
        both = intact.keys() & after.keys()
        changed = {n for n in both if value(n, intact[n]) != value(n, after[n])}
        changed |= intact.keys() ^ after.keys()
        capsys.readouterr()
        code = verify.main([str(tmp_path)])
        *lines, _ = capsys.readouterr().out.splitlines()
        if changed:
            assert code in (1, 2), (changed, lines)
            named = {n for n in changed if is_named(n, tmp_path, lines)}
            assert named and named >= {n for n in changed if "/seed_" in n}, lines
            caught.add(hash(frozenset(after.items())))
        shutil.rmtree(tmp_path / "smoke")
        for name, data in intact.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(data)
    assert len(caught) >= 12
