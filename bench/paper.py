"""What the paper's runs cost here and in the authors' code: python bench/paper.py

Reads the metadata of a `make paper` (runs/paper). The authors' figures are CPU seconds
a run of their released code, measured on one core of a machine of this kind.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

#: Seconds of one core a run: least and most of three runs, or of a range.
AUTHORS = {
    ("car_on_hill", "BC-FQI"): (396, 466),
    ("car_on_hill", "B-FQI"): (421, 498),
    ("car_on_hill", "C-FQI"): (223, 267),
    ("car_on_hill", "FQI"): (247, 312),
    ("maze", "BC-FQI"): (4680, 4680),  # about 1.3 hours
    **{
        ("linear_system", name): (57, 88)
        for name in ("DQN", "C-DQN", "BC-DQN", "SC-DQN", "SBC-DQN", "RPL", "PPR")
    },
}


def main(root: Path) -> None:
    folders = sorted({path.parent for path in root.glob("*/*/seed_*.json")})
    if not folders:
        sys.exit(f"no runs in {root}; make paper")
    head = f"{'CPU seconds per run, one core':32}{'seeds':>6}{'ours':>9}{'theirs':>12}"
    print(f"{head}{'ratio':>14}{'us per step':>11}")
    per_step = []
    for folder in folders:
        facts = [json.loads(p.read_text()) for p in folder.glob("seed_*.json")]
        mean = np.mean([fact["cpu_seconds"] for fact in facts])
        name = folder.parent.name, folder.name
        line = f"{' '.join(name):32}{len(facts):6}{mean:9.2f}"
        if name in AUTHORS:
            low, high = AUTHORS[name]
            shown = f"{low}-{high}" if low < high else f"{low}"
            ratios = sorted({f"{x / mean:.0f}" for x in (low, high)}, key=float)
            line += f"{shown:>12}{'-'.join(ratios) + 'x':>14}"
        if name[0] == "linear_system":
            micro = mean / 40_000 * 1e6
            per_step.append(micro)
            line = f"{line:73}{micro:11.1f}"
        print(line)
    if per_step:
        text = f"mean of {len(per_step)} methods, evaluation and environment included"
        print(f"{text:73}{np.mean(per_step):11.1f}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/paper"))
