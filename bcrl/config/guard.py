"""Where Hydra reads and composes: every file and config is checked before it acts."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra._internal.hydra as hydra_internals
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.core_plugins.importlib_resources_config_source import (
    ImportlibResourcesConfigSource,
)
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.errors import CompactHydraException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf

from bcrl.common.identity import flat
from bcrl.config import bounds, safety, schema
from bcrl.errors import BcrlError

FULL_ERROR = "HYDRA_FULL_ERROR"
STARTED = "BCRL_STARTED"  # when the command began, in its jobs' processes, too


def now(pattern: str) -> str:
    """`${now:%H-%M}`: when the command began, one time in all of its jobs."""
    began = float(os.environ.setdefault(STARTED, str(time.time())))
    return datetime.fromtimestamp(began).strftime(pattern)


class Refused(BcrlError, CompactHydraException):
    """A refusal that Hydra, too, prints without a traceback."""


class Files(FileConfigSource):
    """A folder of configs; those of the user's own are plain, small data within it."""

    def load_config(self, config_path: str) -> ConfigResult:
        name = os.path.normpath(self._normalize_file_name(config_path))
        if os.path.isabs(name) or name.startswith(".."):
            raise Refused(f"{config_path}: leads out of the folder {self.path}")
        if self.provider == "main":
            return super().load_config(config_path)
        bounds.check_file(Path(self.path, name))
        loaded = super().load_config(config_path)
        package = loaded.header.get("package") or os.path.dirname(name)
        if package in ("", "_global_"):
            schema.seeds_of(loaded.config)
        _check_texts(package, loaded.config)
        return loaded


def _check_texts(package: str, loaded: Any) -> None:
    """Raise Refused where a file has a number for what is text: `tag: 1e3`."""
    if not isinstance(loaded, DictConfig):
        return
    place = "" if package == "_global_" else package.replace("/", ".") + "."
    for key, value in flat(OmegaConf.to_container(loaded, resolve=False)).items():
        name = f"{place}{key}".lstrip(".")
        if isinstance(value, (int, float)) and name in schema.texts():
            raise Refused(f"{name}={value}: quote it where it is a name")


class Packages(ImportlibResourcesConfigSource):
    """A package of configs; reading one imports it, so a config can't name any."""

    def __init__(self, provider: str, path: str) -> None:
        if provider.startswith("hydra.searchpath"):
            raise Refused(f"hydra.searchpath: {path} would import code; name a folder")
        super().__init__(provider, path)


OURS = {"file": Files, "pkg": Packages}  # by the kind of place, as Hydra has them


class Loader(ConfigLoaderImpl):
    """Composes as Hydra does, and lets nothing out that `safety.check` refuses."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._repositories: dict[tuple, Any] = {}

    def load_configuration(self, *args: Any, **kwargs: Any) -> DictConfig:
        OmegaConf.register_new_resolver("now", now, replace=True)
        composed = super().load_configuration(*args, **kwargs)
        try:
            safety.check(composed)
        except BcrlError as error:
            raise Refused(str(error)) from error
        return composed

    def get_group_options(
        self,
        group_name: str,
        results_filter: ObjectType | None = ObjectType.CONFIG,
        config_name: str | None = None,
        overrides: list[str] | None = None,
    ) -> list[str]:
        """As Hydra's, which reads the configs anew for each group that Tab asks for."""
        asked = (config_name, tuple(overrides or ()))
        if asked not in self._repositories:
            found = self._parse_overrides_and_create_caching_repo(
                config_name, overrides or []
            )
            self._repositories[asked] = found[1]
        return self._repositories[asked].get_group_options(group_name, results_filter)


def register() -> None:
    """Make the schema known to Hydra, and let it read and compose by these classes."""
    schema.register()
    Plugins.instance()  # registers Hydra's own
    SourcesRegistry.instance().types |= OURS
    hydra_internals.ConfigLoaderImpl = Loader


@contextmanager
def unregistered() -> Iterator[None]:
    """Meanwhile Hydra is as a launcher's processes want it, which register anew."""
    types = SourcesRegistry.instance().types
    for kind in OURS:
        del types[kind]
    try:
        yield
    finally:
        types |= OURS


@contextmanager
def refusals() -> Iterator[None]:
    """Make a BcrlError of whatever goes wrong; HYDRA_FULL_ERROR=1 shows where."""
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"  # Hydra would print a traceback and exit
    try:
        yield
    except BcrlError:
        raise
    except Exception as error:
        if before == "1":
            raise
        if isinstance(error.__cause__, BcrlError):  # as in what Hydra instantiates
            raise error.__cause__ from None
        words = " ".join(str(error).split()) or "no further words"
        why = f"{type(error).__name__}: {words}; {FULL_ERROR}=1 shows where"
        raise BcrlError(why) from error
    finally:
        os.environ.pop(FULL_ERROR)
        os.environ.update({} if before is None else {FULL_ERROR: before})
