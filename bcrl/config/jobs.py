"""The jobs of a command line: each composed, checked and planned before any work."""

import json
import shlex
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.types import Override
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from bcrl.common import plugins
from bcrl.common.files import sha256
from bcrl.common.identity import OUTPUT_KEYS, Plain, differences, flat
from bcrl.config import hydra_compose, safety, schema
from bcrl.config import plan as planning
from bcrl.config.algorithms.fqi import logged_identity
from bcrl.config.hints import Hints
from bcrl.config.hydra_compose import CONF, CONFIG_NAME, Paths, composed, read_option
from bcrl.config.overrides import canonical, parse, product
from bcrl.config.plan import Plan
from bcrl.config.schema import VARIANT_GROUPS
from bcrl.errors import BcrlError, ConfigError, closest

#: The options that follow the authors' code, all of them with the tag `released`.
RELEASED = {"boosting=on": "released", "transfer=shaping": "shaping_released"}
#: The env that a command completes by an id, after which its results are named.
OPEN = "gymnasium"


def plans(arguments: Namespace) -> list[Plan]:
    """The jobs' checked plans; the overrides are canonical afterwards."""
    overrides, multirun = list(arguments.overrides), arguments.multirun
    folders = _folders(arguments)
    Hints(tuple(arguments.overrides), folders).check()
    arguments.overrides = canonical(arguments.overrides, folders)
    hints = Hints(tuple(arguments.overrides), folders)
    parsed = parse(arguments.overrides)
    if multirun and arguments.cfg:
        raise BcrlError("--cfg shows one composition; drop -m and the sweep")
    swept = {o.key_or_group for o in parsed if o.is_sweep_override()}
    if swept and not multirun:
        raise BcrlError(hints.swept())
    name = arguments.config_name or CONFIG_NAME
    set_by_user = folders or any(o.key_or_group.startswith("hydra") for o in parsed)
    found = []
    try:
        usual = composed(("env=maze",)) if set_by_user else None
        for typed in product(parsed):
            hydra = composed(tuple(typed), folders, name).hydra
            both = multirun or hydra.mode == RunMode.MULTIRUN
            params = _params(hydra, folders) if both else []
            for words in product(params + parse(typed)):
                found.append(composed(tuple(words), folders, name))
                safety.check_composed(found[-1], usual)
    except hydra_compose.Unknown as error:
        raise BcrlError(hints.explained(error)) from error
    # What a folder says is the user's own, unless nobody named the folder.
    own = not arguments.unnamed and bool(folders)
    made = [_plan(job, folders, None if own else overrides) for job in found]
    if any(plan.launcher for plan in made):
        if not multirun and found[0].hydra.mode != RunMode.MULTIRUN:
            raise BcrlError("hydra/launcher: a sweep's jobs are launched; add -m")
        if "experiment" in swept:
            raise BcrlError("experiment: with hydra/launcher, one at a time")
    seen: dict[Path, Plan] = {}
    for new in made:
        old = seen.setdefault(new.directory, new)
        for key, (a, b) in differences(old.config, new.config).items():
            why = f"both {key}={a} and {key}={b} would write to {new.directory}"
            raise BcrlError(f"tag={new.tag}: {why}; drop the tag or vary it too")
    return made


def _folders(arguments: Namespace) -> Paths:
    """The folders of configs besides ours, which leave the overrides."""
    found = [arguments.config_dir] if arguments.config_dir else []
    searched = [o for o in arguments.overrides if o.startswith("hydra.searchpath=")]
    arguments.overrides = [o for o in arguments.overrides if o not in searched]
    for override in parse(searched):
        entries = override.value()
        entries = entries if isinstance(entries, list) else [entries]
        found += [str(entry).removeprefix("file://") for entry in entries]
    folders = [Path(folder).absolute() for folder in found]
    for folder in folders:
        if not folder.is_dir():
            near = closest(folder.name, [p.name for p in folder.parent.glob("*/")])
            what = f"did you mean {near}?" if near else "check its name"
            raise BcrlError(f"--config-dir: there is no folder {folder}; {what}")
    arguments.folders = tuple(map(str, folders))
    return arguments.folders


def _params(hydra: DictConfig, folders: Paths) -> list[Override]:
    """What a config sweeps over, an experiment's for one."""
    swept = hydra.sweeper.get("params") or {}
    for key in map(str, swept):
        if key.lstrip("+~").startswith("hydra"):
            why = "Hydra's own keys can't be swept over"
            raise ConfigError(f"hydra.sweeper.params.{key}", swept[key], why)
    return parse(canonical([f"{key}={swept[key]}" for key in swept], folders))


def _plan(job: DictConfig, folders: Paths, typed: Sequence[str] | None) -> Plan:
    """A config's plan; `typed` may name code, and all of the config if it is None."""
    hydra, choices = job.hydra, job.hydra.runtime.choices
    launcher = hydra.launcher and hydra_compose.plain(hydra.launcher)
    schema.check_launcher(launcher)
    launched = launcher["_target_"] != schema.BASIC["_target_"]
    if choices["env"] == OPEN and OmegaConf.is_missing(job.env, "id"):
        raise ConfigError("env.id", "???", "name an environment: env.id=CartPole-v1")
    name = choices.get("variant")
    entries = read_option("variant", name, folders).get("defaults", ())
    for entry in (each for each in entries if isinstance(each, dict)):  # not `_self_`
        ((key, option),) = entry.items()
        group = key.removeprefix("override /")
        if (other := choices.get(group, option)) != option:
            line = f"env={choices['env']} variant={name}"
            why = f"means {group}={option}, not {group}={other}; did you mean {line}?"
            raise ConfigError("variant", name, why)
    config = _plain(job)
    for key, name in plugins.named_code(config):
        said = (o.lstrip("+").partition("=") for o in typed or ())
        says = (name in value and f"{key}.".startswith(f"{k}.") for k, _, value in said)
        if typed is None or any(says):
            plugins.trust(name)
    env = choices["env"]
    if env == OPEN:
        env = str(config["env"]["id"]).rpartition(":")[2].replace("/", "-")
    tag, command = _tag(config, hydra, folders), _command(hydra, folders, launched)
    more = {"command": command, "launcher": launcher if launched else None}
    try:
        return planning.plan(config, env, tag, **more)
    except ConfigError as error:
        name = str(flat(config).get(f"{error.key}.name"))  # as it was typed
        option = name if "." in name else choices.get(error.key.replace(".", "/"))
        if option is None or error.key == "env":
            raise
        raise ConfigError(error.key, option, error.allowed) from error


def _command(hydra: DictConfig, folders: Paths, launched: bool) -> str:
    """The command that runs one job alone, from Hydra's part of its config."""
    left_out = ("hydra.mode=", "hydra.searchpath=")
    asked = [o for o in hydra.overrides.hydra if not o.startswith(left_out)]
    words = ["bcrl", *["-m"] * launched, *hydra.overrides.task, *asked]
    if folders:
        words += ["--config-dir", folders[0]]
        words += [f"hydra.searchpath=['{folder}']" for folder in folders[1:]]
    if hydra.job.config_name != CONFIG_NAME:
        words += ["--config-name", hydra.job.config_name]
    if hydra.runtime.choices.get("experiment") and not launched:
        words.append("hydra.mode=RUN")  # this job of its sweep, not all
    return shlex.join(words)


def _tag(config: Plain, hydra: DictConfig, folders: Paths) -> str | None:
    """The tag: the given one, none for the paper's options, `released`, or a digest."""
    if config["tag"] is not None:
        return config["tag"]
    choices = hydra.runtime.choices
    usual: dict[str | None, dict[str, str]] = {None: {}, "released": {}}
    for group in VARIANT_GROUPS[1:]:
        name = config[group].get("name")
        if group in ("curriculum", "boosting"):
            name = "off" if name == "off" else "on"
        released = RELEASED.get(f"{group}={name}", name)
        for tag, option in ((None, name), ("released", released)):
            shipped = (CONF / group / f"{option}.yaml").exists()
            usual[tag][group] = option if shipped else choices[group]
    if not folders and _only_chooses(hydra):
        for tag, named in usual.items():
            if named.items() <= dict(choices).items():
                return tag
    words = [f"env={choices['env']}", "local=none"]
    if choices["env"] == OPEN:
        words.append(f"env.id='{config['env']['id']}'")
    changes = []
    for tag, named in usual.items():
        chosen = (f"{group}={option}" for group, option in named.items())
        changed = differences(config, _plain(composed((*words, *chosen), folders)))
        if not changed:
            return tag
        changes.append({key: value for key, (value, _) in changed.items()})
    text = json.dumps(changes[0], sort_keys=True)
    return sha256(text.encode())[:8]


def _only_chooses(hydra: DictConfig) -> bool:
    """Whether a job overrides no number: no need to compose, which takes 0.1 s."""
    experiment = read_option("experiment", hydra.runtime.choices.get("experiment"))
    entries = experiment.get("defaults") or ()
    keys = [o.lstrip("+").partition("=")[0] for o in hydra.overrides.task]
    keys += [str(key).removeprefix("override /") for entry in entries for key in entry]
    same = {"env.id", "variant", "experiment", "defaults", "hydra", *VARIANT_GROUPS}
    keys += experiment
    return all(key in same or key.partition(".")[0] in OUTPUT_KEYS for key in keys)


def _plain(job: DictConfig) -> Plain:
    """Our part of a composed config, resolved; BcrlError for what it can't hold."""
    ours = OmegaConf.masked_copy(job, [str(key) for key in job if key != "hydra"])
    config = hydra_compose.plain(ours)
    for key in VARIANT_GROUPS:
        if not isinstance(config[key], dict):  # a file's `boosting: 'on'`
            why = f"is a section; an option stands in defaults: [override /{key}: …]"
            raise ConfigError(key, config[key], why)
    for key, value in flat(config).items():  # tag=${env.gamma}
        if key in schema.TEXTS and not isinstance(value, str | None):
            raise ConfigError(key, value, "must be text: add some to the ${…}")
    config["algorithm"] |= logged_identity(config["algorithm"])
    return config
