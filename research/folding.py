"""What folding networks costs: returns with and without it: python -m research.folding.

Trains BC-DQN through six tasks of the point mass and five of CartPole, with
`boosting.fold` never and always, and writes docs/results/folding_networks.md. All
measures are of the final Q: 100 greedy episodes per seed.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import write_text
from bcrl.common.seeding import stream
from bcrl.common.text import estimate, number
from bcrl.config.hydra_compose import composed
from bcrl.config.plan import Plan, plan
from bcrl.config.tags import plain_config
from bcrl.learning.rollout import rollout, starts_and_draws, success_of
from bcrl.learning.stage import SeedBatch, learn
from bcrl.report.tables import TextTable
from bcrl.results.statistics import bootstrap

DRIFTS = (0.0, -0.125, -0.25, -0.375, -0.5)
LENGTHS = (0.75, 0.5, 0.35, 0.2, 0.1)  # half of the pole's, m
EPISODES = 100
COMMON = ("algorithm=dqn", "algorithm.evaluate_every=10000")


def words(env: str) -> tuple[str, ...]:
    """What a command says for an environment's tasks."""
    if env == "cart_pole":
        poles = (f"{{length: {x}, polemass_length: {0.1 * x}}}" for x in LENGTHS)
        return (f"env.tasks.attributes=[{','.join(poles)}]", "variant=BC", *COMMON)
    n = len(DRIFTS)
    return (
        f"env.tasks.task=[lq{',target' * n}]",
        f"env.tasks.horizon=[100{',150' * n}]",
        "~env.drift",
        f"+env.tasks.drift=[0,{','.join(map(str, DRIFTS))}]",
        f"algorithm.steps=[2000{',10000' * n}]",
        "algorithm.target_update=2000",
        "algorithm.evaluation_episodes=34",
        "variant=BC_line_search",
        *COMMON,
    )


def planned(env: str, fold: str, seeds: int) -> Plan:
    """The plan of one of the runs."""
    more = (f"boosting.fold={fold}", f"seeds.count={seeds}")
    return plan(plain_config(composed((f"env={env}", *words(env), *more))), env)


def finals(made: Plan) -> tuple[dict[str, NDArray], list[dict[str, Any]]]:
    """Each seed's greedy returns with the final Q, and what each fold changed."""
    env, folds = made.target, []
    for now in learn(made.stages, SeedBatch(made.seeds, np.zeros((1, env.state_dim)))):
        if now.last_of_stage and now.folded is not None:
            folds += [now.folded.facts(s) for s in range(len(made.seeds))]
    rngs = [stream(seed, "inspection") for seed in made.seeds]
    played = rollout(env, now.result.q, *starts_and_draws(rngs, env, EPISODES))
    returns, solved = played.reward.sum(-1), played.solved(success_of(env))
    return {"return": returns.mean(-1), "success rate": solved.mean(-1)}, folds


def rows_of(env: str, seeds: int) -> Iterator[dict[str, str]]:
    """A row per way to fold."""
    for fold in ("never", "always"):
        made = planned(env, fold, seeds)
        found, folds = finals(made)
        row = {"environment": env, "stages": str(len(made.stages)), "fold": fold}
        for name, values in found.items():
            row[f"greedy {name}"] = estimate(values.mean(), bootstrap(values))
        missed = sum("note" in x for x in folds)
        row["losses missed"] = f"{missed} of {len(folds)}" if folds else ""
        for name in ("mean_change", "greedy_changed"):
            text = number(np.mean([x[name] for x in folds])) if folds else ""
            row[name.replace("_", " ")] = text
        yield row


def main(words: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m research.folding")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--env", nargs="+", default=["linear_system", "cart_pole"])
    parser.add_argument("--to", type=Path, default=Path("docs/results"))
    given = parser.parse_args(words)
    table = TextTable([row for env in given.env for row in rows_of(env, given.seeds)])
    head = f"{given.seeds} seeds, {EPISODES} episodes each.\n\n"
    print(write_text(given.to / "folding_networks.md", head + str(table)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
