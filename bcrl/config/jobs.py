"""The jobs of a command line: each composed, checked and planned before any work."""

from __future__ import annotations

import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from hydra.core.override_parser.types import Override, Sweep
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from bcrl.common import plugins
from bcrl.common.identity import OUTPUT_KEYS, Plain, differences, flat
from bcrl.config import plan as planning
from bcrl.config import safety, schema
from bcrl.config.command import canonical
from bcrl.config.hints import Hints
from bcrl.config.hydra_compose import (
    CONF,
    CONFIG_NAME,
    Paths,
    Unknown,
    composed,
    options,
    plain,
    read_option,
)
from bcrl.config.overrides import experiments, over_experiments, parse, product
from bcrl.config.plan import Plan
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
#: Groups that Hydra would take any option of, known or not.
OPTIONAL = ("budget", "local")


def plans(arguments: Namespace) -> list[Plan]:
    """The checked plan of each job that this command line asks for.

    The arguments' overrides are canonical afterwards, their folders absolute. Raises
    BcrlError for what can't be read, composed or learned.
    """
    overrides = list(arguments.overrides)
    folders = _folders(arguments)
    Hints(tuple(arguments.overrides), folders).check()
    arguments.overrides = canonical(arguments.overrides, folders)
    hints = Hints(tuple(arguments.overrides), folders)
    parsed = parse(arguments.overrides)
    _check_overrides(parsed, hints)
    multirun = bool(arguments.multirun)
    if multirun and getattr(arguments, "cfg", None):
        raise BcrlError("--cfg shows one composition; drop -m and the sweep")
    name = arguments.config_name or CONFIG_NAME
    set_by_user = folders or any(o.key_or_group.startswith("hydra") for o in parsed)
    found = []
    try:
        usual = composed(CONFIG_NAME, ("env=maze",), ()) if set_by_user else None
        for chosen in experiments(parsed, multirun):
            for words in _jobs(name, chosen, hints, multirun):
                job = composed(name, tuple(words), folders)
                safety.check_composed(job, usual)
                schema.check_launcher(job.hydra.launcher and plain(job.hydra.launcher))
                found.append(job)
    except Unknown as error:
        raise BcrlError(hints.explained(error)) from error
    if any(_launched(job.hydra) for job in found):
        if not multirun and found[0].hydra.mode != RunMode.MULTIRUN:
            raise BcrlError("hydra/launcher: a sweep's jobs are launched; add -m")
        if any(map(over_experiments, parsed)):
            raise BcrlError("experiment: with hydra/launcher, one at a time")
    # What a folder says is the user's own, unless nobody named the folder.
    own = not getattr(arguments, "unnamed", False) and bool(folders)
    made = [_plan(job, job.hydra, folders, None if own else overrides) for job in found]
    _check_directories(made)
    return made


def _folders(arguments: Namespace) -> Paths:
    """The folders of configs besides ours, which leave the overrides."""
    given = [arguments.config_dir] if arguments.config_dir else []
    found = list(getattr(arguments, "folders", given))
    for text in list(arguments.overrides):
        if text.startswith("hydra.searchpath="):
            (override,) = parse([text])
            entries = override.value()
            entries = entries if isinstance(entries, list) else [entries]
            found += [str(entry).removeprefix("file://") for entry in entries]
            arguments.overrides.remove(text)
    folders = [Path(folder).absolute() for folder in found]
    for folder in folders:
        if not folder.is_dir():
            close = guess(folder.name, [path.name for path in folder.parent.glob("*/")])
            text = f"--config-dir: there is no folder {folder}"
            raise BcrlError(f"{text}; {close}" if close else text)
    arguments.folders = tuple(map(str, folders))
    return arguments.folders


def _check_overrides(overrides: Sequence[Override], hints: Hints) -> None:
    """Raise BcrlError for what Hydra would take without a word, or trip over."""
    asked = [o.get_key_element() for o in overrides if o.key_or_group[:5] == "hydra"]
    for override in overrides:
        key, typed, value = override.key_or_group, override.input_line, override.value()
        group, named = key.replace(".", "/"), isinstance(value, str | Sweep)
        why = ""
        if asked.count(override.get_key_element()) > 1:
            why = "given twice; Hydra would merge the values"
        elif override.is_delete() and key in schema.Config.__annotations__:
            why = "can't be deleted: every run needs a choice of it, or its default"
        elif key == "tuned":
            why = "follows from the other choices; override its keys"
        elif key == "experiment" and isinstance(value, list):
            why = "one at a time, or -m experiment=fig1,fig2"
        elif key in (*VARIANT_GROUPS, *OPTIONAL, "variant") and not named:
            why = f"name an option, or leave {key} out; {hints.of_option(key, value)}"
        elif group != key and group in hints.groups and isinstance(value, str):
            why = f"an option is chosen by {group}={value}"
        elif key in OPTIONAL:
            swept = override.is_sweep_override()
            for name in override.sweep_string_iterator() if swept else [value]:
                if name not in options(key, hints.folders):
                    typed, why = f"{key}={name}", hints.of_option(key, name)
        if why:
            raise BcrlError(f"{typed}: {why}")


def _jobs(
    name: str, overrides: list[Override], hints: Hints, multirun: bool
) -> list[list[str]]:
    """Each job's overrides: the product of what the command line and config sweep."""
    jobs = product(overrides)
    first = composed(name, tuple(jobs[0]), hints.folders).hydra
    if not multirun and first.mode != RunMode.MULTIRUN:
        if any(o.is_sweep_override() for o in overrides):
            raise BcrlError(hints.swept())
        return jobs
    swept = first.sweeper.get("params") or {}
    for key in map(str, swept):
        if key.lstrip("+~").startswith("hydra"):
            why = "a config can't sweep over Hydra's own keys"
            raise ConfigError(f"hydra.sweeper.params.{key}", swept[key], why)
    params = [f"{key}={value}" for key, value in swept.items()]
    meant = canonical(params, hints.folders)
    if meant != params:  # Hydra takes them as they are written
        parts = (each.partition("=") for each in meant)
        written = ", ".join(f"{key}: '{value}'" for key, _, value in parts)
        text = f"write {{{written}}} instead of {{{', '.join(params)}}}"
        raise BcrlError(f"hydra.sweeper.params: {text}")
    return product(parse(params) + overrides)


def _plan(
    job: DictConfig, hydra: DictConfig, folders: Paths, typed: Sequence[str] | None
) -> Plan:
    """The plan of one composed config, given Hydra's part of it.

    `typed`: the overrides in which code may be named; None: all of the config may.
    """
    choices = hydra.runtime.choices
    for group in VARIANT_GROUPS:
        if choices.get(group) is None:
            raise BcrlError(f"{group}: every run needs a choice of it")
    if choices["env"] == OPEN and OmegaConf.is_missing(job.env, "id"):
        raise ConfigError("env.id", "???", "name an environment: env.id=CartPole-v1")
    _check_variant(choices, folders)
    config = _plain(job)
    for key, name in plugins.named_code(config):
        if typed is None or any(_names(text, key, name) for text in typed):
            plugins.trust(name)
    env, named = choices["env"], list[str]()
    if env == OPEN:
        named = [f"env.id='{config['env']['id']}'"]
        env = str(config["env"]["id"]).rpartition(":")[2].replace("/", "-")
    usual = {tag: _usual(config, choices, tag == RELEASED) for tag in (None, RELEASED)}
    known: dict[str | None, Plain] = {
        tag: config
        for tag, chosen in usual.items()
        if not folders and _is_usual(hydra, chosen)
    }
    for tag, chosen in usual.items() if not known else ():
        words = [f"{group}={option}" for group, option in chosen.items()]
        words = [f"env={choices['env']}", "local=none", *named, *words]
        known[tag] = _plain(composed(CONFIG_NAME, tuple(words), folders))
        if not differences(config, known[tag]):
            break
    made = planning.plan(config, known, env)
    launcher = plain(hydra.launcher) if _launched(hydra) else None
    command = _command(hydra, folders, launcher is not None)
    return replace(made, command=command, launcher=launcher)


def _names(override: str, key: str, name: str) -> bool:
    """Whether an override says what the key is, and that name is in it."""
    head, _, value = override.lstrip("+").partition("=")
    return name in value and f"{key}.".startswith(f"{head}.")


def _launched(hydra: DictConfig) -> bool:
    """Whether a launcher gives the jobs to Slurm."""
    return hydra.launcher["_target_"] != schema.BASIC["_target_"]


def _command(hydra: DictConfig, folders: Paths, launched: bool) -> str:
    """The command that runs one job alone, from Hydra's part of its config."""
    left_out = ("hydra.mode=", "hydra.searchpath=")
    asked = [o for o in hydra.overrides.hydra if not o.startswith(left_out)]
    words = ["bcrl", *(["-m"] if launched else []), *hydra.overrides.task, *asked]
    if folders:
        words += ["--config-dir", folders[0]]
        words += [f"hydra.searchpath=['{folder}']" for folder in folders[1:]]
    if hydra.job.config_name != CONFIG_NAME:
        words += ["--config-name", hydra.job.config_name]
    if hydra.runtime.choices.get("experiment") and not launched:
        words.append("hydra.mode=RUN")  # this job of its sweep, not all
    return shlex.join(words)


def _check_variant(choices: Mapping[str, str], folders: Paths) -> None:
    """Raise ConfigError for a group that is chosen otherwise than `variant` says."""
    name = choices.get("variant")
    means = {
        key.removeprefix("override /"): option
        for entry in read_option("variant", name, folders).get("defaults", ())
        for key, option in dict(entry).items()
    }
    for group, option in means.items():
        if choices.get(group, option) != option:
            why = f"means {group}={option}, but {group}={choices[group]} is chosen; "
            without = " without the experiment" if choices.get("experiment") else ""
            one = f"env={choices['env']} variant={name}{without}"
            line = " ".join(f"{each}={choices[each]}" for each in means)
            raise ConfigError("variant", name, f"{why}did you mean {one}, or {line}?")


def _usual(config: Plain, choices: Mapping, released: bool) -> dict[str, str]:
    """The shipped choices that this config is a case of, by its components' names.

    A user's option `big` that is named fqi is thus compared with our fqi, and a
    curriculum of any other name with `curriculum=on`. `released`: with the authors'
    code's reading of each component, where we ship one.
    """
    found = {}
    for group in VARIANT_GROUPS[1:]:
        name = config[group].get("name")
        if group in ("curriculum", "boosting"):
            name = "off" if name == "off" else "on"
        name = RELEASED_OPTIONS.get((group, name), name) if released else name
        shipped = (CONF / group / f"{name}.yaml").exists()
        found[group] = name if shipped else choices[group]
    return found


def _is_usual(hydra: DictConfig, usual: Mapping[str, str]) -> bool:
    """Whether a job is its usual choices, with nothing overridden that counts.

    Then there is no need to compose these once more, which takes as long as composing
    the job did.
    """
    choices = hydra.runtime.choices
    experiment = read_option("experiment", choices.get("experiment"))
    entries = experiment.get("defaults") or ()
    keys = [o.lstrip("+").partition("=")[0] for o in hydra.overrides.task]
    keys += [str(key).removeprefix("override /") for entry in entries for key in entry]
    same = {"env.id", "variant", "experiment", *VARIANT_GROUPS}
    return (
        all(choices[group] == option for group, option in usual.items())
        and experiment.keys() <= {"defaults", "hydra", *OUTPUT_KEYS}
        and all(key in same or key.partition(".")[0] in OUTPUT_KEYS for key in keys)
    )


def _plain(job: DictConfig) -> Plain:
    """Our part of a composed config, resolved; BcrlError for what it can't hold."""
    config = plain(OmegaConf.masked_copy(job, [str(k) for k in job if k != "hydra"]))
    for key in schema.Config.__annotations__.keys() & set(VARIANT_GROUPS):
        if not isinstance(config[key], dict):  # a file's `boosting: 'on'`
            why = f"is a section; an option stands in defaults: [override /{key}: …]"
            raise ConfigError(key, config[key], why)
    for key, value in flat(config).items():  # tag=${env.gamma}
        if key in schema.texts() and not isinstance(value, str | None):
            raise ConfigError(key, value, "must be text: add some to the ${…}")
    return config


def _check_directories(planned: Sequence[Plan]) -> None:
    """Raise BcrlError if two different configs of a sweep would share a directory."""
    seen: dict[Path, Plan] = {}
    for new in planned:
        old = seen.setdefault(new.directory, new)
        changed = differences(old.config, new.config)
        if changed:
            key, (a, b) = next(iter(changed.items()))
            why = f"both {key}={a} and {key}={b} would write to {new.directory}"
            raise BcrlError(f"tag={new.tag}: {why}; drop the tag or vary it too")
