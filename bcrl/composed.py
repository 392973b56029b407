"""Hydra's composition of one job, its errors made short."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bcrl.bounds import check_file
from bcrl.errors import BcrlError, closest, did_you_mean
from bcrl.identity import Plain, flat
from bcrl.sweeps import first_lines

PACKAGE = Path(__file__).resolve().parent
#: In a wheel the configs lie inside the package, in a checkout beside it.
CONF = next(p for p in (PACKAGE / "conf", PACKAGE.parent / "conf") if p.is_dir())
CONFIG_NAME = "config"
Folders = tuple[str, ...]  # of configs, besides our own


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
        raise BcrlError(_missing(error)) from error
    except (HydraException, OmegaConfBaseException) as error:
        message = first_lines(error)
    except Exception as error:  # e.g. YAML's own; composing runs nothing of ours
        hint = "; quote on and off, YAML takes them for booleans" * (
            "in defaults : bool" in str(error)
        )
        text = f"the configs can't be read: {first_lines(error)}{hint}"
        raise BcrlError(text) from error
    if unknown := re.match(r"Could not override '([^']+)'", message):
        key = unknown[1]
        meant = f"one that isn't there is added with +{key}"
        if not key.startswith("hydra."):
            meant = _meant(name, key, overrides, folders)
        message = f"{key}: unknown key; {meant}"
    raise BcrlError(message)


def _missing(error: MissingConfigException) -> str:
    wanted = error.missing_cfg_file or ""
    group, _, option = wanted.rpartition("/")
    if not group or error.options is None:
        return first_lines(error)
    return f"{group}={option}: {did_you_mean(option, error.options)}"


def _meant(name: str, key: str, overrides: Sequence[str], folders: Folders) -> str:
    """What an unknown key may mean: a known one, a group, or one of another option."""
    options = _keys_of_options(folders)
    if key in options:
        return f"{' or '.join(options[key])} would have it"
    known = _known_keys(name, overrides, folders)
    match = closest(key, {*known, *options})
    if match is None:
        return "see bcrl --help"
    with_ = "" if match in known else " or ".join(options[match])
    return f"did you mean {match}{', with ' * bool(with_)}{with_}?"


def _known_keys(name: str, overrides: Sequence[str], folders: Folders) -> Plain:
    """The keys that there are with the same choice of groups."""
    groups = [o for o in overrides if "." not in o.split("=")[0] and o[0] not in "+~"]
    for asked in (tuple(groups), ("env=maze",)):
        if asked == overrides:
            continue
        try:
            job = OmegaConf.to_container(composed(name, asked, folders))
        except BcrlError:
            continue
        del job["hydra"]
        return flat(job)
    return {}


def _keys_of_options(folders: Folders) -> dict[str, list[str]]:
    """Each key that an option brings into its section, and which options do so.

    The groups themselves are there, too, with none.
    """
    found: dict[str, list[str]] = {}
    for folder in map(Path, (CONF, *folders)):
        for path in sorted((*folder.glob("*/*.yaml"), *folder.glob("*/*/*.yaml"))):
            group = path.parent.relative_to(folder).as_posix()
            found.setdefault(group, [])
            try:
                check_file(path)
                text = path.read_text("utf-8")
                values = yaml.safe_load(text)
            except (BcrlError, OSError, ValueError, yaml.YAMLError):
                continue  # whoever chooses it will be told
            if "@package" not in text and isinstance(values, dict):
                for key in flat(values):
                    whole = f"{group.replace('/', '.')}.{key}"
                    found.setdefault(whole, []).append(f"{group}={path.stem}")
    return found
