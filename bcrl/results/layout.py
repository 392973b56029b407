"""Where a run's results are and what is in them, for whoever writes or reads them.

<runs_dir>/<scale>/<env>/<variant>[@<tag>]/
    config.yaml      the settings that decide numbers, the same for all seeds
    seed_0007.csv    one row per evaluation: INDEX[family], then the metrics
    seed_0007.npz    arrays at the end of training
    seed_0007.agent  what it learned, to load and act with (keep)
    seed_0007.json   status, config, versions, SHA-256 of the others; written last
"""

from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any

SCHEMA = 2  # of a seed's files; raised when their meaning changes
CONFIG = "config.yaml"
SUFFIXES = ("json", "csv", "npz")
AGENT = "agent"  # the suffix of a file that may be removed
INSPECTION = "inspection"  # a folder in a variant's, of what bcrl-inspect has found
#: Its figures, and what they show.
INSPECTED = {
    "stages": "each residual: its size, what it decides, errors of Q",
    "ablations": "the target task without one residual, and with the first ones only",
    "maps": "what each residual adds to V(s) = max_a Q(s, a)",
}
SEED, CHECKPOINT, STATE = "seed_", "checkpoint_", "state_"  # what names begin with
LOGS = ".tensorboard"  # in runs_dir; hidden, because it holds no results

#: The statuses in a seed's JSON; `failed` is followed by a colon and the reason.
COMPLETE, RUNNING, FAILED = "complete", "running", "failed"

#: The first columns of a family's CSVs: 1-based stage and task, then the counter of the
#: rows: iterations of the whole run, or environment steps of all stages so far.
INDEX = {"FQI": ("stage", "task", "iteration"), "DQN": ("stage", "task", "step")}

#: The columns after the index in FQI's CSVs; in other environments `env.metrics`.
FQI_METRICS = {
    "car_on_hill": ("q_error", "return"),
    "maze": ("return", "q_error_start", "q_error", "residual_start", "solved"),
}

#: The columns after the index in the DQN family's CSVs, in every environment.
DQN_METRICS = (
    *("return", "discounted_return", "success_rate", "q_mean", "loss"),
    *("greedy_return", "greedy_discounted_return", "greedy_success_rate"),
)
MAY_BE_NAN = ("q_mean", "loss")  # those with nothing to average at times
#: The last columns of runs that change the scale of the base (boosting.alpha).
SCALE = ("alpha", "base_fit")
SETTING = "learner."  # in a frame of `bcrl.api.run`: columns of a learner's settings


def seed_name(seed: int) -> str:
    """`seed_0007`: a seed's files without their suffix, and its folder of logs."""
    return f"{SEED}{seed:04d}"


def seed_path(folder: Path, seed: int, suffix: str) -> Path:
    """`seed_0007.csv` and its companions in a variant's folder."""
    return folder / f"{seed_name(seed)}.{suffix}"


def recorded_seeds(folder: Path, suffix: str) -> list[int]:
    """The seeds that a folder has files of, in order; other files are passed over."""
    stems = (path.stem.removeprefix(SEED) for path in folder.glob(f"{SEED}*"))
    seeds = sorted({int(stem) for stem in stems if stem.isdecimal()})
    return [seed for seed in seeds if seed_path(folder, seed, suffix).exists()]


def belongs_to(folder: Path, seed: int) -> dict[str, Any]:
    """The entries of a seed's JSON that repeat what its path says."""
    scale, env, name = folder.parts[-3:]
    variant, _, tag = name.partition("@")
    place = {"seed": seed, "scale": scale, "env": env}
    return place | {"variant": variant, "tag": tag or None}


def family_of(columns: Container[str]) -> str:
    """The family, `FQI` or `DQN`, whose CSVs have these columns."""
    return "DQN" if "step" in columns and "iteration" not in columns else "FQI"


def state_of(document: Mapping[str, Any]) -> str:
    """A seed's status, COMPLETE, RUNNING or FAILED, without the reason."""
    return document["status"].partition(":")[0]


def requested(document: Mapping[str, Any]) -> set[int]:
    """The seeds that the command which made this one was to make, this one included."""
    return {n for first, last in document["asked"] for n in range(first, last + 1)}


def ranges(seeds: Iterable[int]) -> list[list[int]]:
    """Seeds as [first, last] of each run of consecutive ones: `asked` in the JSON."""
    found: list[list[int]] = []
    for seed in sorted(seeds):
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return found


def spelled(seeds: Iterable[int]) -> str:
    """`0–4, 7` for 0, 1, 2, 3, 4, 7."""
    return ", ".join(f"{a}–{b}" if a < b else str(a) for a, b in ranges(seeds))
