"""Whatever happens to result files: bcrl-verify names those whose values changed."""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from bcrl.common.identity import identity
from bcrl.errors import BcrlError
from bcrl.report import verify
from bcrl.report.load import load_runs
from bcrl.report.seedfiles import DQN_METRICS, METRICS
from tests.made_up import made_up_plan, write_seeds

VARIANTS = {
    "maze/BC-FQI": METRICS["maze"],
    "maze/C-FQI@tag": METRICS["maze"],
    "linear_system/DQN": DQN_METRICS,
}
SEEDS = 2
TRIES = 36  # of each kind
SUFFIXES = ("csv", "npz", "json")
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")


def grow(root: Path) -> None:
    """A tree of complete runs, small and all different."""
    for name, metrics in VARIANTS.items():
        env, variant = name.split("/")
        counter = "step" if "DQN" in variant else "iteration"

        def table(seed: int, columns=metrics, counter=counter, name=name):
            rng = np.random.default_rng([seed, len(name)])
            index = {"stage": [1, 1, 2, 2], "task": [1, 1, 2, 2], counter: range(1, 5)}
            return pd.DataFrame(index | {c: rng.normal(size=4) for c in columns})

        def arrays(seed: int, name=name):
            rng = np.random.default_rng([seed, len(name), 7])
            return {"q": rng.normal(size=(3, 2))}

        plan = made_up_plan(root, env, variant, range(SEEDS))
        write_seeds(plan, table, arrays, {"optimum": -47.5, "cpu_seconds": 1.25})


# --- what can happen to files: functions of a generator and the tree's root

Mutation = Callable[[np.random.Generator, Path], None]


def any_file(rng: np.random.Generator, root: Path, *suffixes: str) -> Path:
    files = sorted(p for p in root.rglob("*") if p.is_file())
    return rng.choice([p for p in files if not suffixes or p.suffix[1:] in suffixes])


def any_text(rng: np.random.Generator, root: Path) -> Path:
    return any_file(rng, root, "csv", "json", "yaml")


def any_folder(rng: np.random.Generator, root: Path) -> Path:
    return root / "smoke" / rng.choice(list(VARIANTS))


def flip_bit(rng, root):
    path = any_file(rng, root)
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def other_byte(rng, root):
    path = any_file(rng, root)
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] = rng.integers(256)
    path.write_bytes(data)


def cut(rng, root):
    path = any_file(rng, root)
    data = path.read_bytes()
    path.write_bytes(data[: rng.integers(len(data))])


def insert(rng, root):
    path = any_file(rng, root)
    data, at = path.read_bytes(), int(rng.integers(path.stat().st_size))
    path.write_bytes(data[:at] + rng.bytes(rng.integers(1, 9)) + data[at:])


def drop_bytes(rng, root):
    path = any_file(rng, root)
    data, at = path.read_bytes(), int(rng.integers(path.stat().st_size))
    path.write_bytes(data[:at] + data[at + int(rng.integers(1, 9)) :])


def empty(rng, root):
    any_file(rng, root).write_bytes(b"")


def delete(rng, root):
    any_file(rng, root).unlink()


def edit_lines(rng, root, edit: Callable[[list[bytes], int, int], None]) -> None:
    path = any_text(rng, root)
    lines = path.read_bytes().splitlines(keepends=True)
    edit(lines, *map(int, rng.choice(len(lines), 2, replace=False)))
    path.write_bytes(b"".join(lines))


def delete_line(rng, root):
    edit_lines(rng, root, lambda lines, i, _: lines.pop(i))


def swap_lines(rng, root):
    def swap(lines, i, j):
        lines[i], lines[j] = lines[j], lines[i]

    edit_lines(rng, root, swap)


def duplicate_line(rng, root):
    edit_lines(rng, root, lambda lines, i, j: lines.insert(i, lines[j]))


def append_line(rng, root):
    edit_lines(rng, root, lambda lines, i, _: lines.append(lines[i]))


def edit_number(rng, root, new: Callable[[bytes], bytes]) -> None:
    path = any_text(rng, root)
    data = path.read_bytes()
    found = rng.choice([m.span() for m in NUMBER.finditer(data)] or [(0, 0)])
    before, after = data[: found[0]], data[found[1] :]
    path.write_bytes(before + new(data[found[0] : found[1]]) + after)


def change_number(rng, root):
    amount = int(rng.choice([1, -1, 10]))
    edit_number(rng, root, lambda old: b"%r" % (float(old or 0) + amount))


def change_last_digit(rng, root):
    def next_digit(old: bytes) -> bytes:
        return old[:-1] + b"%d" % ((int(old[-1:] or 0) + 1) % 10)

    edit_number(rng, root, next_digit)


def not_a_number(rng, root):
    word = [b"nan", b"NaN", b"inf", b".nan", b"null"][rng.integers(5)]
    edit_number(rng, root, lambda old: word)


def swap_files(one: Path, other: Path) -> None:
    one_data, other_data = one.read_bytes(), other.read_bytes()
    one.write_bytes(other_data)
    other.write_bytes(one_data)


def swap_seeds(rng, root):
    """One file of two seeds, or all three."""
    folder = any_folder(rng, root)
    i, j = rng.choice(SEEDS, 2, replace=False)
    wanted = SUFFIXES if rng.random() < 0.3 else [rng.choice(SUFFIXES)]
    for suffix in wanted:
        swap_files(*(folder / f"seed_{seed:04d}.{suffix}" for seed in (i, j)))


def swap_variants(rng, root):
    """A seed's file, all three, or config.yaml of two variants."""
    one, other = (root / "smoke" / n for n in rng.choice(list(VARIANTS), 2, False))
    i, j = rng.integers(SEEDS, size=2)
    suffix = rng.choice([*SUFFIXES, "all", "config"])
    if suffix == "config":
        swap_files(one / "config.yaml", other / "config.yaml")
        return
    for each in SUFFIXES if suffix == "all" else [suffix]:
        swap_files(one / f"seed_{i:04d}.{each}", other / f"seed_{j:04d}.{each}")


def duplicate_seed(rng, root):
    """A seed once more, under the number of another or of none."""
    folder = any_folder(rng, root)
    i, j = rng.choice(2 * SEEDS, 2, replace=False)
    i %= SEEDS
    if i == j:
        j += SEEDS
    wanted = SUFFIXES if rng.random() < 0.6 else [rng.choice(SUFFIXES)]
    for suffix in wanted:
        source = folder / f"seed_{i:04d}.{suffix}"
        shutil.copy(source, folder / f"seed_{j:04d}.{suffix}")


def copy_file(rng, root):
    """A file beside itself, under a name such as people and programs give."""
    path = any_file(rng, root, *SUFFIXES)
    name = rng.choice(["{0} (copy){1}", "{0}{1}.bak", "{0}{1}~", "{0}_old{1}"])
    shutil.copy(path, path.with_name(name.format(path.stem, path.suffix)))


def move_file(rng, root):
    path = any_file(rng, root)
    path.rename(any_folder(rng, root) / f"moved_{path.name}")


def delete_seed(rng, root):
    folder, seed = any_folder(rng, root), rng.integers(SEEDS)
    for suffix in SUFFIXES:
        (folder / f"seed_{seed:04d}.{suffix}").unlink()


def copy_folder(rng, root):
    """A variant under another's name, in its place or as a new one."""
    folder = any_folder(rng, root)
    names = [*VARIANTS, "maze/FQI", "maze/BC-FQI@new", "linear_system/C-DQN"]
    names += [f"maze/BC-FQI@{tag}" for tag in range(20)]
    target = root / "smoke" / rng.choice([n for n in names if not folder.match(n)])
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target)


KINDS: tuple[Mutation, ...] = (
    *(flip_bit, other_byte, cut, insert, drop_bytes, empty, delete),
    *(delete_line, swap_lines, duplicate_line, append_line),
    *(change_number, change_last_digit, not_a_number),
    *(swap_seeds, swap_variants, duplicate_seed, copy_file, move_file),
    *(delete_seed, copy_folder),
)


# --- what a file's values are


def cell(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def values(name: str, data: bytes) -> str:
    """A file's values as text; the bytes' if it can't be read."""
    try:
        if name.endswith("csv"):
            lines = data.decode().strip().splitlines()
            return repr([[cell(c) for c in line.split(",")] for line in lines])
        if name.endswith("npz"):
            with np.load(io.BytesIO(data), allow_pickle=False) as stored:
                return repr([(k, v.dtype, v.tolist()) for k, v in stored.items()])
        if name.endswith("json"):
            return json.dumps(json.loads(data), sort_keys=True)
        return json.dumps(identity(yaml.safe_load(data)), sort_keys=True)
    except Exception:
        return f"unreadable {data!r}"


def read(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def changed_files(before: dict[str, bytes], after: dict[str, bytes]) -> set[str]:
    """Files that came, went or have another value."""
    both = {n for n in before.keys() & after.keys() if before[n] != after[n]}
    other = {n for n in both if values(n, before[n]) != values(n, after[n])}
    return other | (before.keys() ^ after.keys())


def restore(root: Path, files: dict[str, bytes]) -> None:
    present = read(root)
    for name in present.keys() - files.keys():
        (root / name).unlink()
    for name in files:
        if present.get(name) != files[name]:
            (root / name).write_bytes(files[name])
    for folder in sorted((p for p in root.rglob("*") if p.is_dir()), reverse=True):
        if not any(folder.iterdir()):
            folder.rmdir()


def is_named(name: str, root: Path, lines: list[str]) -> bool:
    """Whether a line begins with the file, another of its seed, or its folder."""
    path = root / name
    seed = re.match(r"seed_\d+", path.name)
    starts = [f"{path} ", f"{path.parent} "]
    starts += [f"{path.with_name(seed[0])}.{suffix} " for suffix in SUFFIXES if seed]
    return any(line.split(": ", 1)[1].startswith(tuple(starts)) for line in lines)


def test_every_changed_value_is_caught_by_name(tmp_path, capsys):
    grow(tmp_path)
    intact = read(tmp_path)
    assert verify.main([str(tmp_path)]) == 0
    rng = np.random.default_rng(2022)
    seen: set[str] = set()
    caught: Counter[str] = Counter()
    for mutate in KINDS:
        for number in range(TRIES):
            mutate(rng, tmp_path)
            after = read(tmp_path)
            changed = changed_files(intact, after)
            capsys.readouterr()
            code = verify.main([str(tmp_path)])
            *lines, _ = capsys.readouterr().out.splitlines()
            state = hashlib.sha256(repr(sorted(after.items())).encode()).hexdigest()
            if changed and state not in seen:
                seen.add(state)
                what = (mutate.__name__, number, sorted(changed), lines)
                assert code in (1, 2), what
                named = {n for n in changed if is_named(n, tmp_path, lines)}
                assert named and named >= {n for n in changed if "/seed_" in n}, what
                caught[mutate.__name__] += 1
                if number % 9 == 0:
                    with pytest.raises(BcrlError):
                        load_runs(tmp_path, "smoke")
            restore(tmp_path, intact)
    assert verify.main([str(tmp_path)]) == 0
    assert caught.keys() == {mutate.__name__ for mutate in KINDS}
    assert caught.total() >= 500
