"""`bcrl-eval`: episodes of the agents that a run has left, in its tasks or others."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from bcrl import __version__
from bcrl.common.checks import construct
from bcrl.common.files import write_text
from bcrl.common.seeding import stream
from bcrl.common.terminal import ready, say, show
from bcrl.common.text import estimate
from bcrl.envs import Env, tasks_of
from bcrl.errors import BcrlError, did_you_mean
from bcrl.learning.agent import Agent
from bcrl.learning.logged_files import check_target
from bcrl.learning.rollout import CHOICES, Episodes, play, starts_and_draws, success_of
from bcrl.learning.transitions import Transitions
from bcrl.run.agents import load, seeds_with_agents

_ABOUT = """Play greedy episodes with the agents of a run, write one row per episode to
a CSV and print the returns. Words such as env.mass=1.4 change the task; those of a
Gymnasium environment are env.kwargs.gravity=5 or env.attributes.gravity=5."""
_RETURNS = ["return", "discounted_return"]


def episodes(agent: Agent, env: Env, n: int) -> Episodes:
    """n greedy episodes of an agent in a task; they depend on its seed alone."""
    rngs = [stream(agent.seed, "agent")]
    start, u = starts_and_draws(rngs, env, n, CHOICES)
    played = play(env, agent.choose, start, u)
    for why in played.failed.values():
        raise BcrlError(f"seed {agent.seed}: {why}")
    return played


def table(agent: Agent, env: Env, played: Episodes, task: str) -> pd.DataFrame:
    """A row per episode: seed, episode, returns, whether it solved, steps, `task`."""
    columns = {
        "return": played.reward[0].sum(-1),
        "discounted_return": played.discounted_return(env.gamma)[0],
        "solved": played.solved(success_of(env))[0].astype(int),
        "steps": played.length[0],
        "task": task,
    }
    frame = pd.DataFrame(columns)
    frame.insert(0, "episode", np.arange(len(frame)))
    frame.insert(0, "seed", agent.seed)
    return frame


def transitions(played: Sequence[Episodes]) -> Transitions:
    """All transitions of several seeds' episodes, in order of the seeds."""
    names = ("state", "action", "reward", "absorbing", "length", "start")
    each = ([getattr(own, name) for own in played] for name in names)
    return Transitions.of_episodes(Episodes(*(np.concatenate(x, 1) for x in each)))


def means(rows: pd.DataFrame) -> str:
    """The mean returns and their 95 % intervals: over seeds, or one seed's episodes."""
    from bcrl.results.statistics import bootstrap  # SciPy is slow to import

    values, over = rows.groupby("seed")[_RETURNS].mean(), "seeds"
    if len(values) == 1:
        values, over = rows[_RETURNS], f"episodes of seed {rows['seed'].iloc[0]}"
    found = (f"{k} {estimate(x.mean(), bootstrap(x))}" for k, x in values.items())
    what = f"mean [95 % bootstrap interval] over {len(values)} {over}"
    return f"{what}: {', '.join(found)}"


def changed(task: Env, words: Sequence[str]) -> Env:
    """A task with other constants: env.mass=1.4, env.kwargs.gravity=5."""
    values: dict[str, Any] = {
        field.name: getattr(task, field.name) for field in fields(task) if field.init
    }
    for word in words:
        key, equals, text = word.partition("=")
        section, _, name = key.partition(".")
        if section != "env" or not name or not equals:
            raise BcrlError(f"{word}: unknown; env.KEY=VALUE changes the task")
        *above, last = name.split(".")
        if (first := name.partition(".")[0]) not in values:
            why = f"{word}: unknown; {did_you_mean(first, values)}"
            if "kwargs" in values:
                why += "; env.kwargs.NAME=VALUE is an argument of the environment"
            raise BcrlError(why)
        place = values
        for part in above:
            if not isinstance(below := place.get(part) or {}, Mapping):
                raise BcrlError(f"{word}: {part} is {below}, which has no {last}")
            place[part] = dict(below)
            place = place[part]
        try:
            place[last] = yaml.safe_load(text)
        except (ValueError, yaml.YAMLError) as error:
            raise BcrlError(f"{word}: {text} is no value in YAML") from error
    return construct("env", type(task), values)


def _task(agent: Agent, number: int | None, words: Sequence[str]) -> Env:
    """The task to play: the run's target, or another one of its tasks, changed."""
    tasks = tasks_of(agent.config["env"])
    if number is not None and not 1 <= number <= len(tasks):
        raise BcrlError(f"--task {number}: the run has tasks 1 to {len(tasks)}")
    task = tasks[-1 if number is None else number - 1]
    env = changed(task, words) if words else task
    for name in ("state_dim", "n_actions"):
        if (new := getattr(env, name)) != (old := getattr(agent.task, name)):
            raise BcrlError(f"the task's {name} is {new}, but the agent's is {old}")
    return env


def task_text(config: Mapping[str, Any], env: Env, words: Sequence[str]) -> str:
    """The constants in which the tasks of a run differ, and those of the words."""
    names = [name for name, own in config["env"]["tasks"].items() if own is not None]
    names += [word.partition("=")[0].split(".")[1] for word in words]
    known = (f"{name}={getattr(env, name)}" for name in dict.fromkeys(names))
    return ", ".join(known) or "target"


def main(arguments: Sequence[str] | None = None) -> int:
    """Console entry point; 2 for bad input."""
    ready()
    try:
        _evaluate(_parser().parse_intermixed_args(arguments))
    except BcrlError as error:
        say(f"bcrl-eval: {error}")
        return 2
    return 0


def _evaluate(asked: argparse.Namespace) -> None:
    if asked.episodes < 1:
        raise BcrlError(f"--episodes {asked.episodes}: must be at least 1")
    if asked.record:
        check_target(asked.record)
    found, logged = [], []
    for seed in seeds_with_agents(asked.run, asked.seed):
        agent = load(asked.run, seed, trust=asked.trust)
        env = _task(agent, asked.task, asked.overrides)
        played = episodes(agent, env, asked.episodes)
        task = task_text(agent.config, env, asked.overrides)
        found.append(table(agent, env, played, task))
        logged += [played] if asked.record else []
    whole = pd.concat(found, ignore_index=True)
    path = asked.out or asked.run / "evaluation.csv"
    write_text(path, whole.to_csv(index=False))
    each = whole.groupby("seed")[[*_RETURNS, "solved"]].mean()
    show(each.round(4).to_string())
    show(means(whole))
    show(f"{len(whole)} episodes of the task {task} in {path}")
    if asked.record:
        data = transitions(logged)
        show(f"{len(data.reward)} transitions in {data.save(asked.record)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bcrl-eval", description=_ABOUT)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="the folder of a variant's results")
    add("overrides", nargs="*", metavar="env.KEY=VALUE", help="constants of the task")
    add("--episodes", type=int, default=100, help="of each seed; default: %(default)s")
    more = {"action": "append", "default": []}
    add("--seed", type=int, help="only this one; may be repeated", **more)
    add("--task", type=int, help="number of the run's task, from 1; default: the last")
    add("--out", type=Path, metavar="CSV", help="default: RUN/evaluation.csv")
    add("--record", type=Path, metavar="FILE", help="log transitions: *.npz, *.parquet")
    add("--trust", metavar="PACKAGE", help="of your own", **more)
    add("--version", action="version", version=f"bcrl {__version__}")
    return parser


if __name__ == "__main__":
    sys.exit(main())
