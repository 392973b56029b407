"""From a composed configuration to a plan: stages, transfers, variant, directory."""

import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bcrl import __version__
from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.common.identity import OUTPUT_KEYS, Plain, identity
from bcrl.config.algorithms import algorithm
from bcrl.config.rules import check_numbers
from bcrl.config.schema import Choice, Config, Start, check_name, check_path
from bcrl.config.variant import Past, composition, method_name
from bcrl.envs import Env, check_tasks, tasks_of
from bcrl.errors import ConfigError, did_you_mean
from bcrl.evaluation.metrics import check_metrics
from bcrl.learning.stage import Stage
from bcrl.results.loggers import logger

KEEP = ("none", "final", "stages", "state")  # of what a complete seed has learned
LOCKSTEP_ON_GPU = 500  # seeds: a step takes little longer than that of 100


@dataclass(frozen=True)
class Plan:
    """Everything a run needs, checked; holds no Hydra object."""

    env: str  # the choice's name, "maze"; several may use one environment
    variant: str  # "BC-FQI"
    tag: str | None
    family: str  # how it is measured: "FQI" by iterations, "DQN" by steps
    stages: tuple[Stage, ...]
    tasks: tuple[Env, ...]  # easiest first, the target last
    metrics: tuple[str, ...]
    asked: tuple[int, ...]  # all seeds, of which these may be a part:
    seeds: tuple[int, ...]
    lockstep: int
    device: str
    config: Plain  # resolved, whole
    sources: str = ""  # a digest of the user's code that it runs
    command: str = ""  # what runs this plan alone, a line each if there are several
    settings: Plain = field(default_factory=dict)  # that the tag stands for
    launcher: Plain | None = None  # of Slurm's parameters, if its jobs run this
    source: "Plan | None" = None  # the run whose agents the first stage starts from

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
    def length(self) -> int:
        """Iterations or environment steps of all stages, those of sources included."""
        return self.stages[-1].before + self.stages[-1].learner.length

    @property
    def all_stages(self) -> tuple[Stage, ...]:
        """The stages of the run, and those of the runs that it starts from."""
        return (*self.stages, *(self.source.all_stages if self.source else ()))

    @property
    def all_tasks(self) -> tuple[Env, ...]:
        """The different tasks of all stages, earlier ones first."""
        earlier = self.source.all_tasks if self.source else ()
        return (*earlier, *(task for task in self.tasks if task not in earlier))


def plan(config: Plain, env: str, tag: str | None = None, **more: Any) -> Plan:
    """The checked plan of a resolved config; `env` and `tag` name its directory."""
    _check_outputs(config, tag)
    check_name("env", env)
    tasks, metrics = _tasks(config["env"])
    module = algorithm(str(config["algorithm"].get("name")))
    source = _source(config, tasks)
    mapped = bool(config["start"].get("observation"))
    chosen = composition(config, tasks, _past(source, mapped) if source else None)
    stages = module.stages(config["algorithm"], chosen)
    alone = chosen.target_only and source is None
    asked = _asked(config["seeds"])
    device = usable_device(config["device"], module.FAMILY)
    own_lockstep = LOCKSTEP_ON_GPU if device == "cuda" else module.LOCKSTEP
    return Plan(
        env=env,
        variant=method_name(config["algorithm"]["name"], chosen.transfers, alone),
        tag=tag,
        family=module.FAMILY,
        stages=stages,
        tasks=tuple(tasks),
        metrics=metrics,
        asked=asked,
        seeds=part(asked, config["seeds"]["part"]),
        lockstep=config["seeds"]["lockstep"] or own_lockstep,
        device=device,
        config=config,
        sources=plugins.fingerprint(identity(config)),
        source=source,
        **more,
    )


def recorded(
    config: Plain, env: str, tag: str | None, data: Plain | None = None
) -> Plan:
    """The plan of a run by its recorded config, wherever it was made.

    Keys that decide no number have their defaults. Logged data are not read, unless
    `data`, another section `algorithm`, names the same ones. Raises ConfigError for
    another version's config.
    """
    usual = asdict(Config())
    try:
        kept = identity(config)
        known = kept["algorithm"].get("dataset_sha256")
        if data and known is not None and known == data.get("dataset_sha256"):
            kept["algorithm"] = kept["algorithm"] | {"dataset": data["dataset"]}
        start = {"start": usual["start"] | kept.get("start", {})}
        return plan({key: usual[key] for key in OUTPUT_KEYS} | kept | start, env, tag)
    except (AttributeError, KeyError, TypeError) as error:
        why = f"lacks an entry or has another form ({type(error).__name__}: {error})"
        raise ConfigError("config", "recorded", why) from error


def unusable_config(error: ConfigError) -> str:
    """Why a recorded config, from which `error` follows, makes no plan."""
    return f"its config can't be used by bcrl {__version__}: {error}"


def _source(config: Plain, tasks: list[Env]) -> Plan | None:
    """The plan of the run that `start` names; ConfigError if its agents don't fit."""
    section = {k: v for k, v in config["start"].items() if k != "from"}
    given: Start = construct("start", Start, section)
    if given.run is None:
        if given.observation is not None:
            why = "maps observations for another run's agents; name it: start.from="
            raise ConfigError("start.observation", given.observation, why)
        return None
    folder = config["start"].get("from")
    try:
        found = recorded(given.run["config"], given.run["env"], given.run["tag"])
    except ConfigError as error:
        raise ConfigError("start.from", folder, unusable_config(error)) from error
    for name in ("n_actions", "state_dim"):
        new, old = (getattr(task, name) for task in (tasks[-1], found.target))
        if new != old and (name == "n_actions" or given.observation is None):
            why = f"its agents' {name} is {old}, but this run's is {new}"
            if name == "state_dim":
                why += "; start.observation=module.function can map observations"
            raise ConfigError("start.from", folder, why)
    return found


def _past(source: Plan, mapped: bool) -> Past:
    """What a run that starts from another needs to know of it."""
    last = source.stages[-1]
    learner = None if mapped else last.learner
    return Past(last.number, source.length, source.all_tasks, learner)


def _asked(section: Plain) -> tuple[int, ...]:
    """All seeds: so many from the first on, or those that are listed."""
    listed = section["only"] or []
    if section["count"] is not None:
        return tuple(range(section["first"], section["first"] + section["count"]))
    different = 0 < len(listed) == len(set(listed)) <= 10**6
    if not different or min(listed) < 0 or max(listed) > 2**32:
        raise ConfigError("seeds.only", listed, "must differ, 0 to 2^32: seeds=[3,7]")
    return tuple(sorted(listed))


def part(seeds: tuple[int, ...], which: str | None) -> tuple[int, ...]:
    """The part of the seeds that `which` names, "2/5"; all of them if it is None."""
    if which is None:
        return seeds
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", which, re.ASCII)
    number, parts = map(int, found.groups()) if found else (0, 0)
    if not 1 <= number <= parts <= len(seeds):
        why = f"must be K/N, the K-th of at most {len(seeds)} parts, such as 1/2"
        raise ConfigError("seeds.part", which, why)
    return seeds[(number - 1) * len(seeds) // parts : number * len(seeds) // parts]


def usable_device(wanted: str, family: str) -> str:
    """`cpu` or `cuda`; ConfigError if there is no such device."""
    one_of("device", wanted, ["cpu", "cuda", "auto"])
    if family != "DQN" or wanted == "cpu":
        return "cpu"  # forests grow on the CPU
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if wanted == "cuda":
        raise ConfigError("device", "cuda", "torch finds no CUDA device; device=cpu")
    return "cpu"


def _check_outputs(config: Plain, tag: str | None) -> None:
    """Raise ConfigError for what the keys outside of the groups can't be."""
    known = Config.__annotations__
    for key in config.keys() - known:
        raise ConfigError(key, config[key], f"unknown key; {did_you_mean(key, known)}")
    construct("curriculum", Choice, config["curriculum"])
    for section in ("seeds", "scale", ""):
        values = config[section] if section else config
        check_numbers(section, {k: v for k, v in values.items() if v is not None})
    logger(config["logger"])
    one_of("progress", config["progress"], ["auto", "bar", "lines", "none"])
    one_of("keep", config["keep"], KEEP)
    check_path("runs_dir", config["runs_dir"])
    check_name("scale.name", config["scale"]["name"])
    if tag is not None:
        check_name("tag", tag)


def _tasks(section: Plain) -> tuple[list[Env], tuple[str, ...]]:
    """The environment's tasks, easiest first, and the metrics to record."""
    tasks, metrics = tasks_of(section), section.get("metrics")
    check_tasks(section["name"], tasks)
    if not isinstance(metrics, list) or not metrics:
        raise ConfigError("env.metrics", metrics, "must be a list of metric names")
    check_metrics(metrics, tasks[-1])
    return tasks, tuple(metrics)
