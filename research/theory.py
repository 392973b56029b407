"""The paper's bounds beside the true errors of BC-FQI: python -m research.theory.

Trains BC-FQI on the hill and in the maze at the paper's size, measures the terms of the
bounds (`bounds`) after every iteration, and writes docs/results/theory.*.
docs/explanation/theory.md explains them.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bcrl.common.files import write_text
from bcrl.common.text import number
from bcrl.config.hydra_compose import composed
from bcrl.config.plan import Plan, plan
from bcrl.config.tags import plain_config
from bcrl.envs import Env
from bcrl.evaluation import oracle
from bcrl.inspection.measures import values
from bcrl.learning.stage import SeedBatch, learn
from bcrl.q.functions import ZERO, Q
from bcrl.report.figures import layout, style
from bcrl.report.tables import TextTable
from research.bounds import (
    Floats,
    accumulated,
    corollary_1,
    estimation,
    lemma_2,
    lemma_3,
    mean_square,
    propagation,
    ratio,
    sup,
    theorem_2,
)

ENVS = ("car_on_hill", "maze")
NORMS = {"sup": sup, "L2": mean_square()}  # L2 with equal weights


@dataclass
class Model:
    """A task's exact Bellman operator on n states, for which Q* is known."""

    env: Env
    states: Floats = field(init=False)  # (n, d)
    best: Floats = field(init=False)  # (n, A) Q*

    def __post_init__(self) -> None:
        known: Any = oracle.reference(self.env)
        self.states, self.best = known.states, known.q
        every = np.repeat(self.states[:, None], self.env.n_actions, axis=1)
        actions = np.broadcast_to(np.arange(self.env.n_actions), every.shape[:2])
        after, self.reward, self.absorbing = self.env.step(every, actions)
        self.after = after.reshape(-1, self.env.state_dim)

    def q(self, q: Q) -> Floats:
        """Values (n, A) at the states."""
        return values(q, self.states, self.env.n_actions)

    def bellman(self, q: Q) -> Floats:
        """T Q at the states, (n, A)."""
        later = values(q, self.after, self.env.n_actions).max(-1)
        later = later.reshape(self.reward.shape)
        return self.reward + self.env.gamma * np.where(self.absorbing, 0.0, later)


@dataclass
class Task:
    """One seed's iterations in one task; norms by name, one number per iteration."""

    model: Model
    base: Q
    errors: dict[str, list[float]] = field(default_factory=dict)  # ‖ε^k‖
    residuals: dict[str, list[float]] = field(default_factory=dict)  # ‖ϱ^k‖
    truths: dict[str, list[float]] = field(default_factory=dict)  # ‖Q^k − Q*‖, k ≥ 0
    steps: dict[str, list[float]] = field(default_factory=dict)  # ‖T Q^(k-1) − Q*‖

    def __post_init__(self) -> None:
        self.at_base = self.model.q(self.base)
        self.before = self.base
        for name, norm in NORMS.items():
            self.truths[name] = [norm(self.at_base - self.model.best)]
            self.errors[name], self.residuals[name], self.steps[name] = [], [], []

    def add(self, q: Q) -> None:
        """Measure the iteration that ends with `q`."""
        target, now = self.model.bellman(self.before), self.model.q(q)
        for name, norm in NORMS.items():
            self.errors[name].append(norm(target - now))
            self.residuals[name].append(norm(target - self.at_base))
            self.truths[name].append(norm(now - self.model.best))
            self.steps[name].append(norm(target - self.model.best))
        self.before = q

    def rows(self, samples: int) -> Iterator[dict[str, float]]:
        """A row per iteration and norm: the truth and the bounds."""
        gamma, reward = self.model.env.gamma, sup(self.model.reward)
        for name in NORMS:
            errors, residuals = map(np.array, (self.errors[name], self.residuals[name]))
            truths, steps = map(np.array, (self.truths[name], self.steps[name]))
            lam = max(map(ratio, errors, residuals))
            lip = max(map(ratio, steps, truths[:-1]))
            for k in range(1, len(errors) + 1):
                row = {"norm": name, "k": k, "truth": truths[k], "first": truths[0]}
                row |= {"lambda": lam, "L": lip}
                row |= {"theorem_2": theorem_2(lam, lip, truths[0], k)}
                row |= {"corollary_1": corollary_1(lam, lip) * truths[0]}
                own = lip if name != "sup" else gamma
                row |= {"accumulated": accumulated(errors[:k], own, truths[0])}
                row |= {"error": errors[k - 1], "residual": residuals[k - 1]}
                row |= {"propagation": propagation(errors[: k - 1], gamma)}
                if name == "sup":
                    known = errors[: k - 1], residuals[0], gamma
                    row |= {"lemma_3": lemma_3(*known)}
                    row |= {"lemma_2": lemma_2(*known, residuals[0])}
                    row |= {"lemma_2_printed": lemma_2(*known, reward)}
                    row |= {"estimation": estimation(residuals[k - 1], samples, 1.0)}
                yield row


def planned(env: str, seeds: int, variant: str = "BC") -> Plan:
    """BC-FQI at the paper's size."""
    words = (f"env={env}", f"variant={variant}", "scale=paper", f"seeds.count={seeds}")
    return plan(plain_config(composed(words)), env)


def measured(made: Plan) -> pd.DataFrame:
    """The rows of all seeds and tasks."""
    found = []
    for seed in made.seeds:
        probe = oracle.reference(made.target)
        assert probe is not None
        batch = SeedBatch((seed,), probe.states)
        task: Task | None = None
        base: Q = ZERO
        for now in learn(made.stages, batch):
            stage = now.stage
            if task is None:
                task = Task(Model(stage.env), base)
            task.add(now.result.q)
            if now.last_of_stage:
                samples = int(now.state.data[0].multiplicity.sum())
                table = pd.DataFrame(task.rows(samples))
                table["env"], table["seed"] = made.env, seed
                table["stage"], table["samples"] = stage.number, samples
                found.append(table)
                base, task = now.result.q, None
        print(f"{made.env}: seed {seed}", file=sys.stderr, flush=True)
    return pd.concat(found, ignore_index=True)


def table(found: pd.DataFrame) -> TextTable:
    """The last iteration of each task: means over seeds."""
    rows = []
    last = found[found.k == found.groupby(["env", "seed", "stage"]).k.transform("max")]
    for (env, stage, norm), own in last.groupby(["env", "stage", "norm"], sort=False):
        mean = own.mean(numeric_only=True)
        cells = {"task": f"{env} T{stage}", "norm": str(norm)}
        for name, column in (
            ("‖Q⁰ − Q*‖", "first"),
            ("‖Qᵏ − Q*‖", "truth"),
            ("L", "L"),
            ("λ", "lambda"),
            ("Theorem 2", "theorem_2"),
            ("Corollary 1", "corollary_1"),
            ("accumulated", "accumulated"),
            ("‖ϱᵏ‖", "residual"),
            ("Lemma 3", "lemma_3"),
            ("Lemma 2", "lemma_2"),
            ("propagation", "propagation"),
            ("estimation, V = 1", "estimation"),
        ):
            value = mean[column]
            cells[name] = "" if np.isnan(value) else number(value)
        rows.append(cells)
    return TextTable(rows)


def figure(found: pd.DataFrame) -> Figure:
    """True error and Theorem 2's bound by iteration, in both norms."""
    drawn = Figure(figsize=(layout.TEXT, 4.2))
    grid = drawn.subplots(2, len(NORMS), squeeze=False)
    for row, env in zip(grid, found.env.unique(), strict=True):
        for axes, norm in zip(row, NORMS, strict=True):
            _draw(axes, found[(found.env == env) & (found.norm == norm)])
            axes.set_title(f"{env.replace('_', ' ')}, {norm} norm", fontsize=8, pad=20)
            axes.set_yscale("log")
            axes.set_xlabel("iteration")
    handles, names = grid[0, 0].get_legend_handles_labels()
    drawn.legend(handles, names, loc="outside upper center", ncols=len(names))
    return drawn


def _draw(axes: Axes, own: pd.DataFrame) -> None:
    looks = {
        "truth": ("‖Q − Q*‖", "#0072B2", "-"),
        "theorem_2": ("Theorem 2", "#D55E00", "--"),
        "accumulated": ("accumulated errors", "#E69F00", (0, (8, 2))),
        "residual": ("‖ϱ‖", "#009E73", ":"),
        "lemma_3": ("Lemma 3", "#000000", "-."),
    }
    before, spans = 0, []
    for stage, each in own.groupby("stage"):
        mean = each.groupby("k").mean(numeric_only=True)
        spans.append((f"T{stage}", before + 0.5, before + len(mean) + 0.5))
        for column, (label, colour, dashes) in looks.items():
            if mean[column].notna().all():
                name = label if stage == 1 else None
                look: Any = {"linestyle": dashes, "color": colour, "label": name}
                axes.plot(before + mean.index, mean[column], **look)
        before += len(mean)
    style.shade_tasks(axes, spans)


def main(words: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m research.theory")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--to", type=Path, default=Path("docs/results"))
    given = parser.parse_args(words)
    found = pd.concat([measured(planned(env, given.seeds)) for env in ENVS])
    text = found.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    files = [write_text(given.to / "theory.csv", text)]
    head = f"Means over {given.seeds} seeds at each task's last iteration.\n\n"
    files.append(write_text(given.to / "theory_table.md", head + str(table(found))))
    with style.sheet():
        drawn = figure(found)
        files += layout.save_figure(drawn, given.to, "theory", "Bounds and errors")
    print(*files, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
