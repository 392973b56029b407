"""Made-up runs of the paper's environments whose right answers are known beforehand."""

import re
from pathlib import Path

import numpy as np
import pandas as pd

from bcrl.report import cli
from bcrl.report.claims import claims_report, claims_sections
from bcrl.report.variants import COMPARED, METHODS, Runs, Variant
from bcrl.results.layout import DQN_METRICS, seed_path
from tests.results.made_up import made_up_plan, write_seeds

SHORT = {"car_on_hill": (3, 3, 3), "maze": (2,) * 10}  # iterations of each stage
OPTIMUM = -47.557563488
LATTICE = np.array([(x, y) for x in range(21) for y in range(21)]) / 20

SEVEN = COMPARED["linear_system", "DQN"]
LEVEL = {"DQN": -100, "C-DQN": -120, "BC-DQN": -80, "SC-DQN": -60, "SBC-DQN": -45}
LEVEL |= {"RPL": -110, "PPR": -105, "S-DQN": -100}
ACTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], float)
PLANE = np.array([(x, 0, y, 0) for x in range(-20, 21) for y in range(-20, 21)]) / 4


def in_memory(
    place: str, metrics: dict[str, np.ndarray], config=None, task=None, **facts
) -> Variant:
    """A variant `maze/FQI@tag` without files; `metrics` are (S, I), rows iterations."""
    n_seeds, n_rows = next(iter(metrics.values())).shape
    task = np.ones(n_rows, int) if task is None else np.array(task)
    rows = np.unique(task, return_inverse=True)[1] + 1, task, np.arange(n_rows) + 1
    sidecars = tuple(facts | {"config": config or {"env": {}}} for _ in range(n_seeds))
    folder = Path("/runs/smoke") / place
    return Variant(folder, "FQI", tuple(range(n_seeds)), *rows, metrics, sidecars)


def report(runs_dir: Path, *arguments: str) -> int:
    """`bcrl-report` of the smoke runs in a folder: its exit code."""
    return cli.main(["--runs-dir", str(runs_dir), "--scale", "smoke", *arguments])


def claims_of(runs: Runs) -> str:
    """The document of the claims."""
    return claims_report(runs, None, claims_sections(runs, None).values())


def verdicts_of(document: str, section: str) -> dict[str, str]:
    """Claim → verdict, read back from the Markdown table of a section."""
    part = document.split(f"## {section}")[1].split("\n\n")[2]
    lines = [line.strip("| ") for line in part.splitlines() if line.startswith("| ")]
    rows = [re.split(r" (?<!\\)\| ", line) for line in lines[2:]]
    return {cells[0]: cells[-1] for cells in rows}


def as_claimed(env, method, seed, stage):
    """Curves with which every claim is true, with a little spread between seeds."""
    jitter = 0.001 * seed
    first = np.concatenate([[True], np.diff(stage) > 0])
    ones = np.ones(len(stage))
    if env == "car_on_hill":
        error = {"FQI": 0.5, "C-FQI": 0.3, "B-FQI": 0.45, "BC-FQI": 0.1}[method] * ones
        last = np.concatenate([first[1:], [True]])
        if method == "C-FQI":
            error = error + 0.1 * (stage > 1) + 0.05 * (last & (stage == 3))
        if method == "BC-FQI":
            error = error - 0.02 * (stage == 2) + 0.04 * (first & (stage == 3))
        return {"q_error": error + jitter, "return": 1 - error + jitter}
    solves = method == "BC-FQI" or (method == "C-FQI" and seed == 0)
    residual = np.array([9, 7, 5, 4, 3, 2, 6, 4, 3, 1])[stage - 1]
    reached = OPTIMUM if solves else (-65 if method == "C-FQI" else -90) - 2 * seed
    error = {"FQI": 30, "C-FQI": 10, "B-FQI": 25, "BC-FQI": 1}[method] + jitter
    return {
        "return": reached - 0.5 * np.arange(len(stage))[::-1],  # rising to its end
        "q_error_start": error * ones,
        "q_error": error * ones,
        "residual_start": -residual - jitter,
        "solved": int(solves) * ones,
    }


def the_opposite(env, method, seed, stage):
    """The same with BC-FQI's and FQI's curves exchanged, and C-FQI's and B-FQI's."""
    other = dict(zip(METHODS, METHODS[::-1], strict=True))
    curves = as_claimed(env, other[method], seed, stage)
    if env == "maze":
        curves["residual_start"] = curves["residual_start"][::-1]
    return curves


def maze_arrays(seed: int) -> dict[str, np.ndarray]:
    path = np.linspace(0, 0.95, 20 + seed % 8)[:, None] * [1, 1]
    h = np.linspace(0.05, 0.95, 10)
    walls = np.array([[(0.15, 0, 0.25, y), (0.55, 1 - y, 0.65, 1)] for y in h])
    q = (LATTICE.sum(1) * 20 - 60 + seed)[:, None] - np.arange(4)
    goal = np.array([0.95, 0.95])
    arrays = {"states": LATTICE, "q": q, "trajectory": path}
    return arrays | {"walls": walls, "goal": goal}


def write_fqi(
    runs_dir, env, seeds=6, methods=METHODS, lengths=SHORT, tag="", curves=as_claimed
) -> None:
    """Complete runs as the runner leaves them."""
    stage = np.repeat(np.arange(1, len(lengths[env]) + 1), lengths[env])
    facts = {"optimum": OPTIMUM if env == "maze" else None}
    facts |= {"cpu_seconds": 3.6, "wall_seconds": 4.0}
    for method in methods:
        taught = method.startswith(("C-", "BC-"))
        task = stage if taught else np.full(len(stage), stage[-1])
        index = {"stage": stage, "task": task}
        index |= {"iteration": np.arange(1, len(stage) + 1)}

        def table(seed: int, method=method, index=index) -> pd.DataFrame:
            return pd.DataFrame(index | curves(env, method, seed, stage))

        plan = made_up_plan(runs_dir, env, method + tag, range(seeds))
        write_seeds(plan, table, maze_arrays if env == "maze" else lambda s: {}, facts)


def steps_of(method: str) -> list[tuple[int, int, list[int]]]:
    """(stage, task, steps of its evaluations), as the paper's budgets give."""
    if method in ("DQN", "S-DQN"):
        return [(1, 2, [500 + 1000 * k - 500 * (k > 0) for k in range(41)])]
    if method == "C-DQN":
        lq = [500 * k for k in range(1, 22)]
        return [(1, 1, lq), (2, 2, [10500 + 1000 * k for k in range(31)])]
    fill = 500 if method == "SC-DQN" else 0
    lspi = (1, 1, [0, 500, 1000, 1500, 2000])
    return [lspi, (2, 2, [2000 + fill + 1000 * k for k in range(39)])]


def dqn_table(method: str, seed: int, scatter: float = 5.0) -> pd.DataFrame:
    """A learning curve from −150 up to LEVEL, with some noise."""
    rng = np.random.default_rng([seed, SEVEN.index(method) if method in SEVEN else 9])
    blocks = []
    for stage, task, steps in steps_of(method):
        t = (np.array(steps) - steps[0]) / 40000
        if task == 2:
            gain = (LEVEL[method] + 150) * (1 - np.exp(-t * 5))
            value = -150 + gain + rng.normal(0, scatter) * (t > 0)
            value = np.clip(value + rng.normal(0, scatter, len(t)), -150, 0)
        else:
            value = -150 - 2500 * np.exp(-t * 40) + rng.normal(0, 20, len(t))
        loss = np.full(len(t), 0.5 if task == 2 or method == "C-DQN" else np.nan)
        loss[0] = np.nan
        block = dict.fromkeys(DQN_METRICS, value) | {"loss": loss}
        block |= {"discounted_return": 0.6 * value, "greedy_return": value + 1}
        block |= {"success_rate": 1 + value / 150 if task == 2 else 0.0}
        index = {"stage": stage, "task": task, "step": steps}
        blocks.append(pd.DataFrame(index | block))
    return pd.concat(blocks, ignore_index=True)


def dqn_arrays(method: str) -> dict[str, np.ndarray]:
    position = PLANE[:, ::2]
    value = -30 * (position**2).sum(1, keepdims=True) - 100
    q = value - position @ ACTIONS.T  # pulled towards the origin
    return {
        "states": PLANE,
        "q_stages": np.stack([q] * len(steps_of(method))),
        "actions": ACTIONS,
        "pathway": np.array([-5, -0.5, 1, 0.5]),
        "goal": np.array([0, 0, 0.2]),
        "start": np.array([-4.001, -0.4, -3.999, 0.4]),
        "drift": np.array([-0.5, 0.0]),
    }


def write_dqn(
    runs_dir, methods=SEVEN, seeds=range(6), tag="", config=None, shift=0.0, scatter=5.0
) -> None:
    """Complete runs as the runner leaves them."""
    for method in methods:
        first = "dqn" if method in ("DQN", "C-DQN", "S-DQN") else "lspi"
        facts = {"learners": [first, "dqn"][: len(steps_of(method))]}
        facts |= {"optimum": None, "cpu_seconds": 60.0}

        def table(seed: int, method=method) -> pd.DataFrame:
            found = dqn_table(method, seed, scatter)
            found.loc[found["task"] == 2, "return"] += shift
            return found

        place = (runs_dir, "linear_system", method + tag, seeds)
        plan = made_up_plan(*place, config=config)
        write_seeds(plan, table, lambda seed, m=method: dqn_arrays(m), facts)


def csv_of(runs_dir: Path, folder: str, seed: int) -> Path:
    return seed_path(runs_dir / "smoke/linear_system" / folder, seed, "csv")
