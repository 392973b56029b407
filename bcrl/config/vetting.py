"""Composes every job of a command line in advance, so that bad input stops it early."""

from __future__ import annotations

import shlex
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import yaml
from hydra.core.override_parser.types import Override, Sweep
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bcrl.common.identity import Plain, differences, flat
from bcrl.config import plan as compose
from bcrl.config import safety
from bcrl.config.command import canonical, options
from bcrl.config.hints import Hints
from bcrl.config.hydra_compose import CONF, CONFIG_NAME, Folders, Unknown, composed
from bcrl.config.overrides import (
    experiments,
    first_lines,
    over_experiments,
    parse,
    product,
)
from bcrl.config.plan import Plan
from bcrl.config.schema import Config, check_launcher, texts
from bcrl.errors import BcrlError, ConfigError, guess

#: The choices that make a variant; a run is compared with these at their defaults.
VARIANT_GROUPS = ("env", "algorithm", "curriculum", "boosting", "transfer", "scale")
#: The options that follow the authors' code, and the tag of runs that choose them all.
RELEASED = "released"
RELEASED_OPTIONS = {
    ("boosting", "on"): "released",
    ("transfer", "shaping"): "shaping_released",
}
#: The env that a command completes by an id, after which its results are named.
OPEN = "gymnasium"
#: Groups that Hydra would take any option of, there or not: their default need not be.
OPTIONAL = ("budget", "local")
#: Hydra's own keys that matter in running jobs.
RUNNING = (
    *("launcher", "callbacks", "output_subdir", "run", "sweep"),
    *("job_logging", "hydra_logging", "verbose"),
)


def plans(arguments: Namespace) -> list[Plan]:
    """The checked plan of each job that this command line asks for."""
    folders, jobs = _composed(arguments)
    for job in jobs:
        check_launcher(job.hydra.launcher)
    planned = [plan(job, job.hydra, folders) for job in jobs]
    _refuse_collisions(planned)
    return planned


def _command(hydra: DictConfig) -> str:
    """The command that runs one job alone, from Hydra's part of its config."""
    asked = [o for o in hydra.overrides.hydra if not o.startswith("hydra.mode=")]
    words = ["bcrl", *(["-m"] if _launched(hydra) else [])]
    words += [*hydra.overrides.task, *asked]
    if hydra.job.config_name != CONFIG_NAME:
        words += ["--config-name", hydra.job.config_name]
    if hydra.runtime.choices.get("experiment") and not _launched(hydra):
        words.append("hydra.mode=RUN")  # this job of its sweep, not all
    return shlex.join(words)


def _launched(hydra: DictConfig) -> bool:
    """Whether a launcher gives the jobs to other processes."""
    return hydra.launcher["_target_"] != safety.ALLOWED["launcher"][0]  # the basic one


def left_to_hydra(arguments: Namespace) -> bool:
    """Whether the jobs ask for more of Hydra than composing them.

    Then Hydra runs them one by one, or hands them to a launcher. Raises BcrlError for a
    sweep over experiments, which Hydra can't run, and where it would launch nothing.
    """
    usual = _running(composed(CONFIG_NAME, ("env=maze",), ()))
    for job in _composed(arguments)[1]:
        asked = [k for k, value in _running(job).items() if value != usual[k]]
        sweeps = arguments.multirun or job.hydra.mode == RunMode.MULTIRUN
        if _launched(job.hydra) and not sweeps:
            raise BcrlError("hydra/launcher: a sweep's jobs are launched; add -m")
        if asked and any(map(over_experiments, parse(arguments.overrides))):
            text = f"experiment: with hydra.{asked[0]} of your own, one at a time"
            raise BcrlError(text)
        if asked:
            return True
    return False


def _running(job: DictConfig) -> Plain:
    """What Hydra's part of a config says of running jobs."""
    hydra = OmegaConf.to_container(job.hydra, resolve=False)
    kept = {key: hydra.get(key) for key in RUNNING}
    return kept | {
        "sweeper": hydra["sweeper"]["_target_"],
        "job": [hydra["job"].get(key) for key in ("chdir", "env_set")],
    }


def _composed(arguments: Namespace) -> tuple[Folders, list[DictConfig]]:
    """The folders of configs besides ours, and each job composed.

    The arguments' overrides are canonical then.
    """
    name = arguments.config_name or CONFIG_NAME
    folders: Folders = ()
    if arguments.config_dir:
        folder = Path(arguments.config_dir).absolute()
        if not folder.is_dir():
            close = guess(folder.name, [path.name for path in folder.parent.glob("*/")])
            text = f"--config-dir: there is no folder {folder}"
            raise BcrlError(f"{text}; {close}" if close else text)
        folders = (str(folder),)
    hints = Hints(tuple(arguments.overrides), folders)
    hints.check()
    arguments.overrides = canonical(arguments.overrides, folders)
    parsed = parse(arguments.overrides)
    searchpath = [o for o in parsed if o.key_or_group == "hydra.searchpath"]
    parsed = [o for o in parsed if o not in searchpath]
    for override in searchpath:
        folders += _folders(override.value())
    _refuse_nonsense(parsed, hints, arguments)
    multirun = bool(arguments.multirun)
    try:
        return folders, [
            composed(name, tuple(job), folders)
            for overrides in experiments(parsed, multirun)
            for job in _jobs(name, overrides, hints, multirun, folders)
        ]
    except Unknown as error:
        raise BcrlError(hints.explained(error)) from error


def _folders(searchpath: object) -> Folders:
    """The folders that a `hydra.searchpath` override names."""
    entries = searchpath if isinstance(searchpath, list) else [searchpath]
    found = tuple(str(entry).removeprefix("file://") for entry in entries)
    for folder in found:
        if not Path(folder).is_dir():
            raise BcrlError(f"hydra.searchpath: there is no folder {folder}")
    return found


def _refuse_nonsense(
    overrides: Sequence[Override], hints: Hints, arguments: Namespace
) -> None:
    """Raise BcrlError for what Hydra would take without a word, or trip over."""
    asked = [o.get_key_element() for o in overrides if o.key_or_group[:5] == "hydra"]
    for override in overrides:
        key = override.key_or_group
        if asked.count(override.get_key_element()) > 1:
            raise BcrlError(f"{key}: given twice; Hydra would merge the values")
        if override.is_delete() and key in VARIANT_GROUPS:
            raise BcrlError(f"{key}: every run needs a choice of it")
        if override.is_delete() and key in Config.__annotations__:
            raise BcrlError(f"~{key}: can't be deleted; leave it out for its default")
        if key == "tuned":
            raise BcrlError(f"{key}: follows from the other choices; override its keys")
        value = override.value()
        named = isinstance(value, (str, Sweep))
        if key in (*VARIANT_GROUPS, *OPTIONAL, "variant") and not named:
            why = f"name an option, or leave {key} out; {hints.of_option(key, value)}"
            raise BcrlError(f"{override.input_line}: {why}")
        group = key.replace(".", "/")
        if group != key and isinstance(value, str) and Path(CONF, group).is_dir():
            text = f"{override.input_line}: an option is chosen by {group}={value}"
            raise BcrlError(text)
        if key == "experiment" and isinstance(value, list):
            raise BcrlError("experiment: one at a time, or -m experiment=fig1,fig2")
        if key in OPTIONAL:
            swept = override.is_sweep_override()
            names = override.sweep_string_iterator() if swept else [value]
            for name in names:
                if name not in options(key, hints.folders):
                    raise BcrlError(f"{key}={name}: {hints.of_option(key, name)}")
    if arguments.multirun and getattr(arguments, "cfg", None):
        raise BcrlError("--cfg shows one composition; drop -m and the sweep")


def job(config: DictConfig, hydra: DictConfig) -> Plan:
    """The plan of one of the jobs that Hydra runs, given Hydra's part of its config."""
    sources = hydra.runtime.config_sources
    folders = [source.path for source in sources if source.schema == "file"]
    return plan(config, hydra, folders)


def plan(job: DictConfig, hydra: DictConfig, folders: Sequence[str]) -> Plan:
    """The plan of one composed config, given Hydra's part of it."""
    choices = hydra.runtime.choices
    for group in VARIANT_GROUPS:
        if choices.get(group) is None:
            raise BcrlError(f"{group}: every run needs a choice of it")
    if choices["env"] == OPEN and OmegaConf.is_missing(job.env, "id"):
        raise ConfigError("env.id", "???", "name an environment: env.id=CartPole-v1")
    extra = tuple(f for f in folders if Path(f) != CONF)
    _refuse_contradiction(choices, extra)
    config, known = _plain(job), {}
    env, named = choices["env"], ()
    if env == OPEN:
        named = (f"env.id='{config['env']['id']}'",)
        env = str(config["env"]["id"]).rpartition(":")[2].replace("/", "-")
    for tag, released in ((None, False), (RELEASED, True)):
        usual = _usual(config, choices, released)
        variant = (f"env={choices['env']}", "local=none", *named, *usual)
        known[tag] = _plain(composed(CONFIG_NAME, variant, extra))
        if not differences(config, known[tag]):
            break
    made = compose.plan(config, known, env)
    return replace(made, command=_command(hydra))


def _refuse_contradiction(choices: Mapping[str, str], folders: Folders) -> None:
    """Raise ConfigError for a group that is chosen otherwise than `variant` says."""
    name = choices.get("variant")
    places = [Path(folder, "variant", f"{name}.yaml") for folder in (CONF, *folders)]
    found = [path for path in places if path.exists()]
    read = yaml.safe_load(found[-1].read_text("utf-8")) if found else None
    said = {
        key.removeprefix("override /"): option
        for entry in (read or {}).get("defaults") or ()
        if isinstance(entry, dict)
        for key, option in entry.items()
    }
    for group, option in said.items():
        if choices.get(group, option) != option:
            line = " ".join(f"{each}={choices[each]}" for each in said)
            other = f"{group}={choices[group]} is chosen"
            if experiment := choices.get("experiment"):  # which sweeps over it
                other = f"experiment={experiment} sweeps over {group}"
                line = f"env={choices['env']} variant={name} without the experiment"
            why = f"means {group}={option}, but {other}; leave one of them out, "
            raise ConfigError("variant", name, f"{why}or did you mean {line}?")


def _usual(config: Plain, choices: Mapping[str, str], released: bool) -> Iterator[str]:
    """The shipped choices that this config is a case of, by its components' names.

    A user's option `big` that is named fqi is thus compared with our fqi, and a
    curriculum of any other name with `curriculum=on`. `released`: with the authors'
    code's reading of each component, where we ship one.
    """
    for group in VARIANT_GROUPS[1:]:
        name = config[group].get("name")
        if group in ("curriculum", "boosting"):
            name = "off" if name == "off" else "on"
        name = RELEASED_OPTIONS.get((group, name), name) if released else name
        shipped = (CONF / group / f"{name}.yaml").exists()
        yield f"{group}={name if shipped else choices[group]}"


def _plain(job: DictConfig) -> Plain:
    ours = OmegaConf.masked_copy(job, [k for k in job if k != "hydra"])
    try:
        plain = OmegaConf.to_container(ours, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise BcrlError(first_lines(error)) from error
    for key in Config.__annotations__.keys() & set(VARIANT_GROUPS):
        if not isinstance(plain[key], dict):  # a file's `boosting: 'on'`
            why = f"is a section; an option stands in defaults: [override /{key}: …]"
            raise ConfigError(key, plain[key], why)
    for key, value in flat(plain).items():  # tag=${env.gamma}
        if key in texts() and not isinstance(value, str | None):
            raise ConfigError(key, value, "must be text: add some to the ${…}")
    return plain


def _jobs(
    name: str,
    overrides: list[Override],
    hints: Hints,
    multirun: bool,
    folders: Folders,
) -> list[list[str]]:
    """Each job's overrides: the product of what the command line and config sweep."""
    jobs = product(overrides)
    first = composed(name, tuple(jobs[0]), folders).hydra
    if not multirun and first.mode != RunMode.MULTIRUN:
        if any(o.is_sweep_override() for o in overrides):
            raise BcrlError(hints.swept())
        return jobs
    params = [f"{k}={v}" for k, v in (first.sweeper.get("params") or {}).items()]
    if (meant := canonical(params, folders)) != params:  # Hydra takes them as they are
        written = ", ".join(
            f"{k}: '{v}'" for k, _, v in (m.partition("=") for m in meant)
        )
        text = f"write {{{written}}} instead of {{{', '.join(params)}}}"
        raise BcrlError(f"hydra.sweeper.params: {text}")
    return product(parse(params) + overrides)


def _refuse_collisions(planned: Sequence[Plan]) -> None:
    """Raise BcrlError if two different configs of a sweep would share a directory."""
    seen: dict[Path, Plan] = {}
    for new in planned:
        old = seen.setdefault(new.directory, new)
        changed = differences(old.config, new.config)
        if changed:
            key, (a, b) = next(iter(changed.items()))
            why = f"both {key}={a} and {key}={b} would write to {new.directory}"
            raise BcrlError(f"tag={new.tag}: {why}; drop the tag or vary it too")
