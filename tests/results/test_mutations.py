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
from bcrl.report.load import load_runs
from bcrl.results import verify
from bcrl.results.layout import DQN_METRICS, FQI_METRICS, seed_path
from tests.results.made_up import made_up_plan, write_seeds

VARIANTS = {
    "maze/BC-FQI": FQI_METRICS["maze"],
    "maze/C-FQI@tag": FQI_METRICS["maze"],
    "linear_system/DQN": DQN_METRICS,
}
SEEDS = 2
TRIES = 36  # of each kind
SUFFIXES = ("csv", "npz", "json")
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")
Rng = np.random.Generator


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


# --- what can happen: to bytes, to the lines or a number of a text, to files


def replaced(data: bytes, at: int, new: bytes, old: int = 1) -> bytes:
    return data[:at] + new + data[at + old :]


BYTES: dict[str, Callable[[Rng, bytes, int], bytes]] = {
    "flip_bit": lambda r, d, at: replaced(d, at, bytes([d[at] ^ 1 << r.integers(8)])),
    "other_byte": lambda r, d, at: replaced(d, at, r.bytes(1)),
    "cut": lambda r, d, at: d[:at],
    "insert": lambda r, d, at: replaced(d, at, r.bytes(r.integers(1, 9)), 0),
    "drop_bytes": lambda r, d, at: replaced(d, at, b"", int(r.integers(1, 9))),
    "empty": lambda r, d, at: b"",
}
LINES: dict[str, Callable[[list[bytes], int, int], list[bytes]]] = {
    "delete_line": lambda x, i, j: x[:i] + x[i + 1 :],
    "swap_lines": lambda x, i, j: [x[{i: j, j: i}.get(n, n)] for n in range(len(x))],
    "duplicate_line": lambda x, i, j: [*x[:i], x[j], *x[i:]],
    "append_line": lambda x, i, j: [*x, x[i]],
}
NUMBERS: dict[str, Callable[[Rng, bytes], bytes]] = {
    "change_number": lambda r, x: b"%r" % (float(x or 0) + r.choice([1, -1, 10])),
    "change_last_digit": lambda r, x: x[:-1] + b"%d" % ((int(x[-1:] or 0) + 1) % 10),
    "not_a_number": lambda r, x: r.choice([b"nan", b"NaN", b"inf", b".nan", b"null"]),
}


def any_file(rng: Rng, root: Path, *suffixes: str) -> Path:
    files = sorted(p for p in root.rglob("*") if p.is_file())
    return rng.choice([p for p in files if not suffixes or p.suffix[1:] in suffixes])


def any_folder(rng: Rng, root: Path) -> Path:
    return root / "smoke" / rng.choice(list(VARIANTS))


def edit(kind: str, rng: Rng, root: Path) -> None:
    """Apply one of the edits above to a file."""
    path = any_file(rng, root, *(() if kind in BYTES else ("csv", "json", "yaml")))
    data = path.read_bytes()
    if kind in BYTES:
        changed = BYTES[kind](rng, data, int(rng.integers(len(data))))
    elif kind in LINES:
        lines = data.splitlines(keepends=True)
        places = map(int, rng.choice(len(lines), 2, replace=False))
        changed = b"".join(LINES[kind](lines, *places))
    else:
        found = rng.choice([m.span() for m in NUMBER.finditer(data)] or [(0, 0)])
        new = NUMBERS[kind](rng, data[found[0] : found[1]])
        changed = data[: found[0]] + new + data[found[1] :]
    path.write_bytes(changed)


def swap_files(one: Path, other: Path) -> None:
    one_data, other_data = one.read_bytes(), other.read_bytes()
    one.write_bytes(other_data)
    other.write_bytes(one_data)


def swap(rng: Rng, root: Path) -> None:
    """A seed's file, all three, or config.yaml, of any two seeds and variants."""
    one, other = any_folder(rng, root), any_folder(rng, root)
    i, j = rng.integers(SEEDS, size=2)
    suffix = rng.choice([*SUFFIXES, "all", "config"])
    if suffix == "config":
        swap_files(one / "config.yaml", other / "config.yaml")
        return
    for each in SUFFIXES if suffix == "all" else [suffix]:
        swap_files(seed_path(one, i, each), seed_path(other, j, each))


def duplicate_seed(rng: Rng, root: Path) -> None:
    """A seed once more, under the number of another or of none."""
    folder, i = any_folder(rng, root), int(rng.integers(SEEDS))
    j = (i + rng.integers(1, SEEDS + 1)) % (SEEDS + 1)
    for suffix in SUFFIXES if rng.random() < 0.6 else [rng.choice(SUFFIXES)]:
        shutil.copy(seed_path(folder, i, suffix), seed_path(folder, j, suffix))


def delete(rng: Rng, root: Path) -> None:
    """A file, or all of a seed."""
    path = any_file(rng, root)
    for each in path.parent.glob(f"{path.stem}.*") if rng.random() < 0.5 else [path]:
        each.unlink()


def copy_file(rng: Rng, root: Path) -> None:
    """A file beside itself, under a name such as people and programs give."""
    path = any_file(rng, root, *SUFFIXES)
    name = rng.choice(["{0} (copy){1}", "{0}{1}.bak", "{0}{1}~", "{0}_old{1}"])
    shutil.copy(path, path.with_name(name.format(path.stem, path.suffix)))


def move_file(rng: Rng, root: Path) -> None:
    path = any_file(rng, root)
    path.rename(any_folder(rng, root) / f"moved_{path.name}")


def copy_folder(rng: Rng, root: Path) -> None:
    """A variant under another's name, in its place or as a new one."""
    folder = any_folder(rng, root)
    names = [*VARIANTS, "maze/FQI", "maze/BC-FQI@new", "linear_system/C-DQN"]
    names += [f"maze/BC-FQI@{tag}" for tag in range(20)]
    target = root / "smoke" / rng.choice([n for n in names if not folder.match(n)])
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target)


FILES = (swap, duplicate_seed, delete, copy_file, move_file, copy_folder)
KINDS = {k: lambda r, root, k=k: edit(k, r, root) for k in BYTES | LINES | NUMBERS}
KINDS |= {kind.__name__: kind for kind in FILES}


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
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def changed_files(before: dict[str, bytes], after: dict[str, bytes]) -> set[str]:
    """Files that came, went or have another value."""
    both = {n for n in before.keys() & after.keys() if before[n] != after[n]}
    other = {n for n in both if values(n, before[n]) != values(n, after[n])}
    return other | (before.keys() ^ after.keys())


def restore(root: Path, files: dict[str, bytes]) -> None:
    shutil.rmtree(root / "smoke")
    for name, data in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(data)


def is_named(name: str, root: Path, lines: list[str]) -> bool:
    """Whether a line begins with the file, another of its seed, or its folder."""
    path = root / name
    seed = re.match(r"seed_\d+", path.name)
    starts = [f"{path} ", f"{path.parent} "]
    starts += [f"{path.with_name(seed[0])}.{suffix} " for suffix in SUFFIXES if seed]
    return any(line.split(": ", 1)[1].startswith(tuple(starts)) for line in lines)


@pytest.mark.slow
def test_every_changed_value_is_caught_by_name(tmp_path, capsys):
    grow(tmp_path)
    intact = read(tmp_path)
    assert verify.main([str(tmp_path)]) == 0
    rng = np.random.default_rng(2022)
    seen: set[str] = set()
    caught: Counter[str] = Counter()
    for kind, mutate in KINDS.items():
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
                what = (kind, number, sorted(changed), lines)
                assert code in (1, 2), what
                named = {n for n in changed if is_named(n, tmp_path, lines)}
                assert named and named >= {n for n in changed if "/seed_" in n}, what
                caught[kind] += 1
                if number % 9 == 0:
                    with pytest.raises(BcrlError):
                        load_runs(tmp_path, "smoke")
            restore(tmp_path, intact)
    assert verify.main([str(tmp_path)]) == 0
    assert caught.keys() == KINDS.keys() and caught.total() >= 500
