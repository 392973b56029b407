"""From a composed configuration to a plan: stages, transfer, variant and directory."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bcrl import probes
from bcrl.config import (
    OUTPUT_KEYS,
    Choice,
    Config,
    FQISettings,
    construct,
    one_of,
    per_task,
)
from bcrl.curriculum import CURRICULA
from bcrl.envs import Env, env_class, is_finite
from bcrl.errors import ConfigError, at_least, did_you_mean
from bcrl.learners.fqi import Stage
from bcrl.q.regressors import Regressor, regressor_class
from bcrl.transfer import Transfer, boost, warm_start

Plain = dict[str, Any]  # a resolved config: dicts, lists and scalars


@dataclass(frozen=True)
class Plan:
    """Everything a run needs, checked; holds no Hydra object."""

    env: str  # the choice's name, "maze"; several may use one environment
    variant: str  # "BC-FQI"
    tag: str | None
    stages: tuple[Stage, ...]
    tasks: tuple[Env, ...]  # easiest first, the target last
    metrics: tuple[str, ...]
    regressor: Regressor
    transfer: Transfer
    shared_data: bool
    fixed_trees: bool
    seeds: tuple[int, ...]
    config: Plain  # resolved, whole

    @property
    def target(self) -> Env:
        """The task that is to be solved in the end."""
        return self.tasks[-1]

    @property
    def name(self) -> str:
        """The directory's name, `<variant>` or `<variant>@<tag>`."""
        return f"{self.variant}@{self.tag}" if self.tag else self.variant

    @property
    def root(self) -> Path:
        """The folder of all results."""
        return Path(self.config["runs_dir"])

    @property
    def directory(self) -> Path:
        """Where this run's results go."""
        return self.root / self.config["scale"]["name"] / self.env / self.name

    @property
    def iterations(self) -> int:
        """Rows of a seed's CSV."""
        return sum(stage.iterations for stage in self.stages)


def identity(config: Plain) -> Plain:
    """The part of a config that decides numbers."""
    kept = {k: v for k, v in config.items() if k not in OUTPUT_KEYS}
    env = {k: v for k, v in kept["env"].items() if k != "paper_seeds"}
    return kept | {"env": env}


def differences(config: Plain, other: Plain) -> dict[str, tuple[Any, Any]]:
    """Dotted keys at which two configs' identities differ, with both values."""
    a, b = flat(identity(config)), flat(identity(other))
    keys = sorted(a.keys() | b.keys())
    both = {k: (a.get(k, "absent"), b.get(k, "absent")) for k in keys}
    return {k: (x, y) for k, (x, y) in both.items() if x != y}


def flat(config: Plain, prefix: str = "") -> Plain:
    """Nested dicts as one, with dotted keys."""
    out: Plain = {}
    for key, value in config.items():
        if isinstance(value, dict):
            out |= flat(value, f"{prefix}{key}.")
        else:
            out[prefix + key] = value
    return out


def plan(config: Plain, variant_defaults: Plain, env: str) -> Plan:
    """The checked plan of a resolved config; ConfigError says what can't be.

    `variant_defaults` is the same choice of groups without any value overridden: where
    the config departs from it, the results get a directory of their own, below the
    name of the `env` choice.
    """
    _check_outputs(config)
    tasks, metrics = _tasks(config["env"])
    settings: FQISettings = construct("algorithm", FQISettings, config["algorithm"])
    one_of("algorithm.name", settings.name, ["fqi"])
    one_of("curriculum.name", config["curriculum"]["name"], list(CURRICULA))
    one_of("boosting.name", config["boosting"]["name"], ["on", "off"])
    one_of("transfer.name", config["transfer"]["name"], ["none"])
    curriculum = config["curriculum"]["name"] != "off"
    boosting = config["boosting"]["name"] == "on"
    if len(tasks) == 1 and (curriculum or boosting):
        key = "curriculum" if curriculum else "boosting"
        why = f"{config['env']['name']} has one task, so there is no stage to hand over"
        raise ConfigError(key, "on", f"{why}; env.tasks needs at least two values")
    regressor = _regressor(settings, tasks[-1])
    stages = _stages(config, settings, tasks)
    if settings.dataset == "shared" and any(s.epsilon < 1 for s in stages):
        why = "seeds can share data only if all are random: algorithm.epsilon must be 1"
        raise ConfigError("algorithm.dataset", "shared", why)
    prefix = "B" * boosting + "C" * curriculum
    changed = differences(config, variant_defaults)
    return Plan(
        env=env,
        variant=f"{prefix}-{settings.name.upper()}"
        if prefix
        else settings.name.upper(),
        tag=config["tag"] or (_short_hash(changed) if changed else None),
        stages=stages,
        tasks=tuple(tasks),
        metrics=metrics,
        regressor=regressor,
        transfer=boost if boosting else warm_start,
        shared_data=settings.dataset == "shared",
        fixed_trees=settings.fit_randomness == "fixed",
        seeds=tuple(
            config["seeds"]["first"] + i for i in range(config["seeds"]["count"])
        ),
        config=config,
    )


def _short_hash(changed: Mapping[str, tuple[Any, Any]]) -> str:
    values = {key: value for key, (value, _) in changed.items()}
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _check_outputs(config: Plain) -> None:
    seeds, scale = config["seeds"], config["scale"]
    known = [f.name for f in dataclasses.fields(Config)]
    for key, value in config.items():
        if key not in known:
            raise ConfigError(key, value, f"unknown key; {did_you_mean(key, known)}")
    for group in ("curriculum", "boosting", "transfer"):
        construct(group, Choice, config[group])
    at_least("seeds.first", seeds["first"], 0)
    at_least("seeds.count", seeds["count"], 1)
    at_least("seeds.lockstep", seeds["lockstep"], 1)
    at_least("workers", config["workers"], 1)
    at_least("threads", config["threads"], 1)
    at_least("scale.max_iterations", scale["max_iterations"], 1)
    at_least("scale.max_episodes", scale["max_episodes"], 1)
    one_of("progress", config["progress"], ["auto", "bar", "lines", "none"])
    for key, value in (("tag", config["tag"]), ("scale.name", scale["name"])):
        if value is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", value):
            raise ConfigError(key, value, "only letters, digits, '.', '_' and '-'")
    if not config["runs_dir"].strip():
        raise ConfigError("runs_dir", "''", "must name a folder")


def _tasks(section: Plain) -> tuple[list[Env], tuple[str, ...]]:
    """The environment's tasks, easiest first, and the metrics to record."""
    if not isinstance(section, dict) or not isinstance(section.get("name"), str):
        raise ConfigError("env", section, "must have a name")
    cls = env_class(section["name"])
    overlap = sorted(section.keys() & (section.get("tasks") or {}).keys())
    if overlap:
        key = f"env.{overlap[0]}"
        raise ConfigError(key, section[overlap[0]], f"env.tasks.{overlap[0]} decides")
    constants = {
        k: v
        for k, v in section.items()
        if k not in ("name", "tasks", "metrics", "paper_seeds")
    }
    parameters = section.get("tasks") or {}
    if not isinstance(parameters, dict) or not parameters:
        raise ConfigError("env.tasks", parameters, "must map a parameter to its values")
    lengths = {k: len(v) if isinstance(v, list) else 0 for k, v in parameters.items()}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        why = "every parameter needs a list with one value a task, all of one length"
        raise ConfigError("env.tasks", parameters, why)
    tasks = [
        construct("env", cls, constants | dict(zip(parameters, values, strict=True)))
        for values in zip(*parameters.values(), strict=True)
    ]
    metrics = section.get("metrics")
    if not isinstance(metrics, list) or not metrics:
        raise ConfigError("env.metrics", metrics, "must be a list of metric names")
    probes.check(metrics, tasks[-1])
    return tasks, tuple(metrics)


def _regressor(settings: FQISettings, target: Env) -> Regressor:
    values = dict(settings.regressor)
    cls = regressor_class(str(values.pop("name", None)))
    regressor = construct("algorithm.regressor", cls, values)
    if regressor.finite_only and not is_finite(target):
        why = f"needs finitely many states, which {target.name} has not"
        raise ConfigError("algorithm.regressor", settings.regressor["name"], why)
    return regressor


def _stages(
    config: Plain, settings: FQISettings, tasks: Sequence[Env]
) -> tuple[Stage, ...]:
    """One stage a task slot, with the scale's caps on its budget."""
    n = len(tasks)
    one_of("algorithm.new_data", settings.new_data, ["stage", "task"])
    one_of("algorithm.dataset", settings.dataset, ["own", "shared"])
    one_of("algorithm.fit_randomness", settings.fit_randomness, ["fresh", "fixed"])
    iterations = per_task("algorithm.iterations", settings.iterations, n, int, 1)
    episodes = per_task("algorithm.episodes", settings.episodes, n, int, 1)
    epsilon = per_task("algorithm.epsilon", settings.epsilon, n, float, 0, 1)
    order = CURRICULA[config["curriculum"]["name"]](n)
    cap = config["scale"]
    stages = []
    for slot, task in enumerate(order):
        again = slot > 0 and order[slot - 1] == task and settings.new_data == "task"
        if again and (epsilon[slot], episodes[slot]) != (epsilon[0], episodes[0]):
            why = "the task's data are kept, so epsilon and episodes must stay the same"
            raise ConfigError("algorithm.new_data", "task", why)
        stages.append(
            Stage(
                number=slot + 1,
                task=task + 1,
                env=tasks[task],
                iterations=_capped(iterations[slot], cap["max_iterations"]),
                episodes=_capped(episodes[slot], cap["max_episodes"]),
                epsilon=epsilon[slot],
                new_data=not again,
            )
        )
    return tuple(stages)


def _capped(value: int, cap: int | None) -> int:
    return value if cap is None else min(value, cap)
