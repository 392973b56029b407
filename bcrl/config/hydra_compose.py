"""Hydra's composition of one job, and what the folders of configs hold."""

import contextlib
import re
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bcrl.common.identity import Plain
from bcrl.config import safety, schema
from bcrl.errors import BcrlError

PACKAGE = Path(__file__).resolve().parents[1]
#: In a wheel the configs lie inside the package, in a checkout beside it.
CONF = next(p for p in (PACKAGE / "conf", PACKAGE.parent / "conf") if p.is_dir())
CONFIG_NAME = "config"
STARTED = datetime.now()  # `${now:%H-%M}`, one time in all jobs of a command
#: Hydra's messages about a key that can't be overridden, added or deleted.
UNKNOWN = re.compile(
    r"Could not override '([^']+)'|Could not append.* already at '([^']+)'"
    r"|Could not delete from config\. '([^']+)' does not exist"
    r"|Multiple values for ([^.\s]+)\."
    r"|In '[^']*': ConfigKeyError .* Key '([^']+)' not in 'Config'"
    r"|You must specify 'env'"
)
Paths = tuple[str, ...]  # of folders of configs, besides our own


class Unknown(BcrlError):
    """An unknown key, or an unknown option of a group; "": the env is missing."""

    def __init__(self, text: str, key: str, option: str | None = None) -> None:
        super().__init__(text)
        self.key, self.option = key, option


@cache
def register_plugins() -> None:
    """Make the schema known to Hydra, and how folders of configs are read."""
    ConfigStore.instance().store(name="schema", node=schema.Config)
    for plugin in (safety.ConfigFolder, safety.OwnSearchPath):
        Plugins.instance().register(plugin)


def searchpath(folders: Paths) -> list[str]:
    """The override that adds folders to Hydra's search path, if there are any."""
    quoted = [folder.replace("'", r"\'") for folder in folders]
    places = [f"'bcrl://{folder}'" for folder in quoted]
    return [f"hydra.searchpath=[{','.join(places)}]"] if folders else []


@cache
def composed(
    overrides: tuple[str, ...], folders: Paths = (), name: str = CONFIG_NAME
) -> DictConfig:
    """One job's config, composed from its overrides; BcrlError says what is wrong."""
    register_plugins()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            OmegaConf.register_new_resolver("now", STARTED.strftime, replace=True)
            asked = [*overrides, *searchpath(folders)]
            return compose(name, asked, return_hydra_config=True)
    except BcrlError:
        raise
    except MissingConfigException as error:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        if not group or error.options is None:
            raise BcrlError(first_lines(error)) from error
        raise Unknown(f"{group}={option}: unknown option", group, option) from error
    except (HydraException, OmegaConfBaseException) as error:
        message = first_lines(error)
    except Exception as error:  # e.g. YAML's own; composing runs nothing of ours
        raise BcrlError(f"the configs can't be read: {first_lines(error)}") from error
    if unknown := UNKNOWN.match(message):
        raise Unknown(message, next(filter(None, unknown.groups()), ""))
    raise BcrlError(message)


def plain(section: DictConfig) -> Plain:
    """A section with its interpolations resolved, as dicts, lists and scalars."""
    try:
        return OmegaConf.to_container(section, resolve=True, throw_on_missing=True)  # type: ignore
    except (OmegaConfBaseException, RecursionError) as error:  # ${…} of itself
        raise BcrlError(first_lines(error)) from error


def first_lines(error: BaseException) -> str:
    """An error's own words, without the key and type listing that OmegaConf appends."""
    text, *listing = re.split(r"\n *full_key: *(.*)", str(error), maxsplit=1)
    text, key, cause = " ".join(text.split()), "".join(listing[:1]), error.__cause__
    if cause is not None and not text:
        return first_lines(cause)
    if cause is not None and text.startswith("Error merging"):
        text, key = first_lines(cause), text.split()[-1]
    text = text or type(error).__name__
    return text if key in text else f"{key}: {text}"


def catalog(folders: Paths = ()) -> dict[str, list[str]]:
    """The options of each group, `algorithm/regressor` among them, of all folders."""
    found: dict[str, set[str]] = {}
    for folder in (CONF, *map(Path, folders)):
        for path in (*folder.glob("*/*.yaml"), *folder.glob("*/*/*.yaml")):
            group = path.parent.relative_to(folder).as_posix()
            found.setdefault(group, set()).add(path.stem)
    return {group: sorted(found[group], key=str.lower) for group in sorted(found)}


@cache
def read_option(group: str, name: str | None, folders: Paths = ()) -> dict[str, Any]:
    """What an option's file says; nothing if there is none that can be read."""
    for folder in (str(CONF), *folders):
        path = Path(folder, group, f"{name}.yaml")
        with contextlib.suppress(BcrlError):  # whoever chooses it gets the error
            safety.check_file(path)
            found = yaml.safe_load(path.read_text("utf-8"))
            return found if isinstance(found, dict) else {}
    return {}
