"""Made-up runs, written by the code that writes real ones."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from numpy.typing import NDArray

from bcrl.common import files
from bcrl.config.plan import Plan
from bcrl.results.layout import FQI_METRICS
from bcrl.run import records


def made_up_plan(
    runs_dir: Path, env: str, name: str, seeds: range, scale: str = "smoke", config=None
) -> Plan:
    """A plan without anything to learn, of the variant `name` (`FQI@tag`)."""
    variant, _, tag = name.partition("@")
    whole = {
        "env": {"name": env, "metrics": list(FQI_METRICS.get(env, ["return"]))},
        "algorithm": {"name": variant.rpartition("-")[2].lower(), "episodes": 5},
        "scale": {"name": scale},
        "seeds": {"first": seeds.start, "count": len(seeds)},
        "runs_dir": str(runs_dir),
        "workers": 1,
        "tag": tag or None,
    }
    about = {"env": env, "variant": variant, "tag": tag or None, "family": ""}
    about |= dict.fromkeys(("asked", "seeds"), tuple(seeds))
    about |= dict.fromkeys(("stages", "tasks", "metrics"), ())
    return Plan(**about, lockstep=1, device="cpu", config=whole | (config or {}))


def write_seeds(
    plan: Plan,
    table: Callable[[int], pd.DataFrame],
    arrays: Callable[[int], Mapping[str, NDArray]] = lambda seed: {},
    facts: Mapping[str, Any] | None = None,
) -> None:
    """All seeds of a plan, complete; `table` and `arrays` make a seed's."""
    records.make_run_directory(plan)
    for seed in plan.seeds:
        rows = table(seed).to_dict("records")
        records.write_seed(plan, seed, "complete", rows, arrays(seed), facts or {})


def reseal(path: Path, **changes: Any) -> None:
    """Change entries of a seed's JSON as bcrl would have: it stays intact."""
    document = json.loads(path.read_text()) | changes
    del document[files.DIGEST]
    path.write_text(files.sealed(document))


def rerecord(path: Path, content: bytes | str) -> None:
    """Replace a seed's CSV or NPZ as if the run had left this instead."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    about = path.with_suffix(".json")
    hashes = json.loads(about.read_text())["sha256"]
    reseal(about, sha256=hashes | {path.suffix[1:]: files.sha256(path.read_bytes())})


def edit_csv(path: Path, edit: Callable[[pd.DataFrame], pd.DataFrame]) -> None:
    """A seed's CSV as if the run had left an edited one."""
    rerecord(path, edit(pd.read_csv(path)).to_csv(index=False, na_rep="nan"))
