"""Hydra's composition of one job, its errors made short."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bcrl.errors import BcrlError, did_you_mean
from bcrl.identity import flat
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
        add = f"one that isn't there is added with +{key}"
        ours = not key.startswith("hydra.")
        known = _known_keys(name, key, overrides, folders) if ours else add
        message = f"{unknown[1]}: unknown key; {known}"
    raise BcrlError(message)


def _missing(error: MissingConfigException) -> str:
    wanted = error.missing_cfg_file or ""
    group, _, option = wanted.rpartition("/")
    if not group or error.options is None:
        return first_lines(error)
    return f"{group}={option}: {did_you_mean(option, error.options)}"


def _known_keys(name: str, key: str, overrides: Sequence[str], folders: Folders) -> str:
    """What `key` may have meant, among the keys of the same choice of groups."""
    groups = [o for o in overrides if "." not in o.split("=")[0] and o[0] not in "+~"]
    for asked in (tuple(groups), ("env=maze",)):
        if asked == overrides:
            continue
        try:
            job = OmegaConf.to_container(composed(name, asked, folders))
        except BcrlError:
            continue
        del job["hydra"]
        return did_you_mean(key, flat(job))
    return "see bcrl --help"
