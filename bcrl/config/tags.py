"""A folder's tag, and what it stands for: settings unlike the method's defaults."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf

from bcrl.common.files import sha256
from bcrl.common.identity import (
    ABSENT_KEY,
    OUTPUT_KEYS,
    Plain,
    as_text,
    differences,
    flat,
    identity,
)
from bcrl.common.text import shorten
from bcrl.config import hydra_compose, schema
from bcrl.config.algorithms.fqi import logged_identity
from bcrl.config.hydra_compose import CONF, Paths, catalog, composed, read_option
from bcrl.config.schema import VARIANT_GROUPS
from bcrl.errors import BcrlError, ConfigError
from bcrl.results.layout import CONFIG, recorded_seeds
from bcrl.results.read import read_document

#: Tag → the options that it stands for, in place of the paper's.
NAMED = {
    None: {},
    "released": {"boosting=on": "released", "transfer=shaping": "shaping_released"},
    "line_search": {"boosting=on": "line_search"},
}
#: The env that a command completes by an id, after which its results are named.
OPEN = "gymnasium"

Options = Mapping[str, str]  # by group


def tag_of(
    config: Plain, hydra: DictConfig, folders: Paths
) -> tuple[str | None, Plain]:
    """A job's tag and the settings that it stands for.

    The tag is the given one, none for the paper's options, one of NAMED, or a digest of
    the settings that differ from the method's defaults.
    """
    given, choices = config["tag"], hydra.runtime.choices
    usual: dict[str | None, Options] = {
        tag: _options(config, choices, named) for tag, named in NAMED.items()
    }
    if not folders and _only_chooses(hydra):
        for tag, named in usual.items():
            known = tag is None or given is None  # one of NAMED says what it means
            if known and named.items() <= dict(choices).items():
                return given or tag, {}
    changes = []
    try:
        for tag, named in usual.items():
            changes.append(_changes(config, choices["env"], named, folders))
            if not changes[-1]:
                return given or tag, changes[0] if given else {}
    except BcrlError:  # the defaults of a user's own options may lack a value
        if given is None:
            raise
        return given, {}
    text = json.dumps(changes[0], sort_keys=True)
    return given or sha256(text.encode())[:8], changes[0]


def settings_of(folder: Path, folders: Paths) -> Plain:
    """The settings that a results folder's tag stands for, by its config.yaml; empty if
    there is no tag or if the defaults are not known here."""
    if "@" not in folder.name:
        return {}
    env, groups = folder.parent.name, catalog(folders)
    try:
        config = yaml.safe_load((folder / CONFIG).read_bytes())
        options = _options(config, {}, NAMED[None])
        if env not in groups["env"] and re.fullmatch(r"[\w./:-]+", config["env"]["id"]):
            env = OPEN
        known = all(option in groups[group] for group, option in options.items())
        return _changes(config, env, options, folders) if known else {}
    except Exception:  # whatever the file holds, and options that are not here
        return {}


def meanings(settings: Mapping[Path, Plain]) -> list[str]:
    """Lines such as `@1a2b3c4d: algorithm.episodes=100`, for folders' settings."""
    folders: dict[tuple[str, str], list[str]] = {}  # by tag and settings
    for folder, values in settings.items():
        present = {k: v for k, v in values.items() if v != ABSENT_KEY} or values
        present = _shorter(present)
        texts = (f"{k}={shorten(as_text(v))}" for k, v in present.items())
        if text := ", ".join(texts):
            key = folder.name.partition("@")[2], text
            folders.setdefault(key, []).append(" ".join(folder.parts[-2:]))
    tags = [tag for tag, _ in folders]  # a tag that a user gave may have two meanings
    return [
        f"{f'@{tag}' if tags.count(tag) == 1 else ', '.join(names)}: {text}"
        for (tag, text), names in folders.items()
    ]


def _shorter(values: Plain) -> Plain:
    """Settings with the run in `start` by its name, without its own settings."""
    found = {k: v for k, v in values.items() if not k.startswith("start.run.")}
    if env := values.get("start.run.env"):
        tag = values.get("start.run.tag")
        found["start.run"] = f"{env}@{tag}" if tag else env
    return found


def plain_config(job: DictConfig) -> Plain:
    """Our part of a composed config, resolved; BcrlError for what it can't hold."""
    ours = OmegaConf.masked_copy(job, [str(key) for key in job if key != "hydra"])
    config = hydra_compose.plain(ours)
    for key in VARIANT_GROUPS:
        if not isinstance(config[key], dict):  # a file's `boosting: 'on'`
            why = f"is a section; an option stands in defaults: [override /{key}: …]"
            raise ConfigError(key, config[key], why)
    if (folder := config["start"].get("from")) is not None:
        config["start"]["run"] = _recorded(folder)
    for key, value in flat(config).items():  # tag=${env.gamma}
        if key in schema.TEXTS and not isinstance(value, str | None):
            raise ConfigError(key, value, "must be text: add some to the ${…}")
    config["algorithm"] |= logged_identity(config["algorithm"])
    return config


def _recorded(folder: object) -> Plain:
    """What the run in a folder says about itself; ConfigError if there is none."""
    place = Path(str(folder)).absolute()
    if not (seeds := recorded_seeds(place, "json")):
        why = "holds no run; name one such as runs/quick/maze/BC-FQI"
        raise ConfigError("start.from", folder, why)
    document = read_document(place, seeds[0])
    named = {"env": document["env"], "tag": document["tag"]}
    try:
        return named | {"config": identity(document["config"])}
    except (AttributeError, KeyError, TypeError) as error:
        raise ConfigError("start.from", folder, f"its config lacks {error}") from error


def _options(config: Plain, choices: Options, named: Options) -> Options:
    """The options of a config's method: ours by their names, others as chosen."""
    found = {}
    for group in VARIANT_GROUPS[1:]:
        option = config[group].get("name")
        if group in ("curriculum", "boosting"):
            option = "off" if option == "off" else "on"
        option = named.get(f"{group}={option}", option)
        shipped = (CONF / group / f"{option}.yaml").exists()
        found[group] = option if shipped else choices.get(group, option)
    return found


def _changes(config: Plain, env: str, options: Options, folders: Paths) -> Plain:
    """The settings, by dotted keys, in which a config differs from options' own."""
    words = [f"env={env}", "local=none"]
    if env == OPEN:
        words.append(f"env.id='{config['env']['id']}'")
    words += [f"{group}={option}" for group, option in options.items()]
    changed = differences(config, plain_config(composed(tuple(words), folders)))
    return {key: value for key, (value, _) in changed.items()}


def _only_chooses(hydra: DictConfig) -> bool:
    """Whether a job overrides no number: no need to compose, which takes 0.1 s."""
    experiment = read_option("experiment", hydra.runtime.choices.get("experiment"))
    entries = experiment.get("defaults") or ()
    keys = [o.lstrip("+").partition("=")[0] for o in hydra.overrides.task]
    keys += [str(key).removeprefix("override /") for entry in entries for key in entry]
    same = {"env.id", "variant", "experiment", "defaults", "hydra", *VARIANT_GROUPS}
    keys += experiment
    return all(key in same or key.partition(".")[0] in OUTPUT_KEYS for key in keys)
