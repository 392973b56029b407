"""Hydra's composition of one job, its errors made short."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from bcrl.common.identity import flat
from bcrl.config.bounds import check_file
from bcrl.config.overrides import first_lines
from bcrl.errors import BcrlError, did_you_mean

PACKAGE = Path(__file__).resolve().parents[1]
#: In a wheel the configs lie inside the package, in a checkout beside it.
CONF = next(p for p in (PACKAGE / "conf", PACKAGE.parent / "conf") if p.is_dir())
CONFIG_NAME = "config"
#: What Hydra says of a key that can't be overridden, added or deleted.
UNKNOWN = re.compile(
    r"Could not override '([^']+)'|Could not append.* already at '([^']+)'"
    r"|Could not delete from config\. '([^']+)' does not exist"
    r"|Multiple values for ([^.\s]+)\."
    r"|In '[^']*': ConfigKeyError .* Key '([^']+)' not in 'Config'"
)
NO_ENV = "You must specify 'env'"
Folders = tuple[str, ...]  # of configs, besides our own


class Unknown(BcrlError):
    """A key that there isn't, or an option of a group."""

    def __init__(self, text: str, key: str, option: str | None = None) -> None:
        super().__init__(text)
        self.key, self.option = key, option


@cache
def composed(name: str, overrides: tuple[str, ...], folders: Folders) -> DictConfig:
    """One job's config, composed from its overrides; BcrlError says why it can't be."""
    quoted = [folder.replace("'", r"\'") for folder in folders]
    extra = [f"'file://{folder}'" for folder in quoted]
    path = [f"hydra.searchpath=[{','.join(extra)}]"] if extra else []
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return hydra_compose(name, [*overrides, *path], return_hydra_config=True)
    except BcrlError:
        raise
    except MissingConfigException as error:
        raise _missing(error) from error
    except (HydraException, OmegaConfBaseException) as error:
        message = first_lines(error)
    except Exception as error:  # e.g. YAML's own; composing runs nothing of ours
        hint = "; quote on and off, YAML takes them for booleans" * (
            "in defaults : bool" in str(error)
        )
        text = f"the configs can't be read: {first_lines(error)}{hint}"
        raise BcrlError(text) from error
    if unknown := UNKNOWN.match(message):
        key = next(filter(None, unknown.groups()))
        if key.startswith("hydra."):
            raise BcrlError(
                f"{key}: unknown key; one that isn't there is added with +{key}"
            )
        text = message if message.startswith("In ") else f"{key}: unknown key"
        raise Unknown(text, key)
    if message.startswith(NO_ENV):
        raise Unknown(message, "env")
    raise BcrlError(message)


def _missing(error: MissingConfigException) -> BcrlError:
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if not group or error.options is None:
        return BcrlError(first_lines(error))
    return Unknown(
        f"{group}={option}: {did_you_mean(option, error.options)}", group, option
    )


def keys_of_options(folders: Folders) -> dict[str, dict[str, Any]]:
    """Each key that options bring into their section: the options, and its value there.

    The groups themselves are there, too, with none.
    """
    found: dict[str, dict[str, Any]] = {}
    for folder in map(Path, (CONF, *folders)):
        for place in {
            p.parent for n in ("*", "*/*") for p in folder.glob(f"{n}/*.yaml")
        }:
            group = place.relative_to(folder).as_posix()
            found.setdefault(group, {})
            for key, values in keys_of_group(group, folders).items():
                found[key] = values
    return found


@cache
def keys_of_group(group: str, folders: Folders) -> dict[str, dict[str, Any]]:
    """The same of one group."""
    found: dict[str, dict[str, Any]] = {}
    places = [Path(folder, group) for folder in (CONF, *folders)]
    for path in sorted(path for place in places for path in place.glob("*.yaml")):
        try:
            check_file(path)
            text = path.read_text("utf-8")
            values = yaml.safe_load(text)
        except (BcrlError, OSError, ValueError, yaml.YAMLError):
            continue  # whoever chooses it will be told
        if "@package" not in text and isinstance(values, dict):
            for key, value in flat(values).items():
                whole = f"{group.replace('/', '.')}.{key}"
                found.setdefault(whole, {})[f"{group}={path.stem}"] = value
    return found
