"""A config is data: it runs no code, leads to no file outside and stays small."""

import copy
import os
import re
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from bcrl.common.identity import flat
from bcrl.config import schema
from bcrl.errors import BcrlError, ConfigError

FILE_BYTES, OVERRIDE = 256 * 1024, 10_000  # of one YAML, characters of one override
NODES, DEPTH = 10_000, 40  # values of one YAML, levels of nested sections or brackets
#: Aliases of a YAML and interpolations of a config: each may repeat a large value.
REPEATS = 16
#: The tags that JSON has, too; others make objects.
TAGS = re.compile(r"!|tag:yaml\.org,2002:(null|bool|int|float|str|seq|map)|None")
#: References and two resolvers that give text. Others make config out of text.
INTERPOLATION = re.compile(
    r"\$\{\s*(?:(?!hydra\.)\.*[\w.\[\]-]+|(?:oc\.env|now)\s*:[^${}]*)\s*\}"
)
#: What may differ from Hydra's defaults; `schema` checks the launcher's keys.
ALLOWED = re.compile(
    r"mode|sweeper\.params\b.*|launcher\b.*|searchpath|(runtime|overrides)\b.*"
    r"|job\.(override_dirname|config_name)"
)
#: The providers of configs that don't change: ours and Hydra's own.
_KNOWN = ("main", "hydra")
_READ: dict[tuple[str, str], ConfigResult] = {}


class ConfigFolder(FileConfigSource):
    """A folder of configs; those of the user's own are plain, small data within it."""

    @staticmethod
    def scheme() -> str:
        """What a folder's place in the search path begins with."""
        return "bcrl"

    def load_config(self, config_path: str) -> ConfigResult:
        """Read one file; BcrlError says what is wrong with it."""
        name = os.path.normpath(self._normalize_file_name(config_path))
        if os.path.isabs(name) or name.startswith(".."):
            raise BcrlError(f"{config_path}: leads out of the folder {self.path}")
        if self.provider in _KNOWN:  # every job of a sweep reads these
            if (key := (self.provider, name)) not in _READ:
                _READ[key] = super().load_config(config_path)
            return copy.deepcopy(_READ[key])
        check_file(Path(self.path, name))
        loaded = super().load_config(config_path)
        package = loaded.header.get("package") or os.path.dirname(name)
        if isinstance(loaded.config, DictConfig):
            schema.check_written(package, loaded.config)
            if OmegaConf.select(loaded.config, "hydra.searchpath") is not None:
                raise BcrlError(f"hydra.searchpath in {config_path}: use --config-dir")
        return loaded


class OwnSearchPath(SearchPathPlugin):
    """Has our own configs read as a `ConfigFolder`, too: they lead nowhere else.

    Hydra's own are read so, too, because they are cached then.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Change the places of both."""
        for place in search_path.get_path():
            folder = (place.path or "").removeprefix("file://")
            if folder == "pkg://hydra.conf":
                folder = str(Path(hydra.__file__).with_name("conf"))
            if place.provider in _KNOWN:
                place.path = f"{ConfigFolder.scheme()}://{folder}"


def check_override(text: str) -> None:
    """Raise BcrlError for an override that a parser would choke on."""
    short = repr(text[:60])
    if re.search("[\ud800-\udfff]", text):
        raise BcrlError(f"{short} isn't valid UTF-8")
    levels = max(len(re.findall(r"[\[({]", text)), text.partition("=")[0].count("."))
    if len(text) > OVERRIDE or levels > DEPTH:
        most = f"{OVERRIDE} characters, {DEPTH} brackets or {DEPTH} nested keys"
        raise BcrlError(f"{short} is longer than {most}")


def check_file(path: Path) -> None:
    """Raise BcrlError for a file that isn't plain, small YAML in UTF-8."""
    if not path.is_file() or path.stat().st_size > FILE_BYTES:  # a pipe never ends
        raise BcrlError(f"{path} is no file of at most {FILE_BYTES // 1024} KiB")
    try:
        check_yaml(path.read_text("utf-8"))
    except (UnicodeDecodeError, yaml.YAMLError, BcrlError) as error:
        words = " ".join(str(error).split())
        raise BcrlError(f"{path} can't be read: {words}") from error


def check_yaml(text: str) -> None:
    """Raise BcrlError for YAML that makes objects, is too large, or misleads."""
    nodes = depth = aliases = 0
    resolver = yaml.SafeLoader("")
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        nodes += isinstance(event, yaml.NodeEvent)
        aliases += isinstance(event, yaml.AliasEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if nodes > NODES or depth > DEPTH or aliases > REPEATS:
            most = f"{NODES} values, {DEPTH} levels and {REPEATS} aliases"
            raise BcrlError(f"it is too large: at most {most} are read")
        if not TAGS.fullmatch(str(getattr(event, "tag", None))):
            raise BcrlError(f"it has the tag {event.tag!r}; only plain values are read")
        if isinstance(event, yaml.ScalarEvent) and event.implicit[0]:
            word = event.value
            kind = resolver.resolve(yaml.ScalarNode, word, (True, False))[-5:]
            odd = kind == ":bool" and word.lower() not in ("true", "false")
            digits = kind in ("2:int", "float")
            if odd or (digits and re.search("[:_xb]|^[+-]?0[0-9]", word)):
                why = f"it has a bare {word}, read as {yaml.safe_load(word)} by YAML"
                raise BcrlError(f"{why}; write what is meant, or quote it as a name")


def check_composed(composed: DictConfig, usual: DictConfig | None) -> None:
    """Raise ConfigError for interpolations or keys of Hydra's that aren't allowed.

    `usual` has Hydra's keys at their defaults; None: nobody could have changed them.
    """
    config: Any = OmegaConf.to_container(composed, resolve=False)
    hydra = flat(config.pop("hydra"))
    if usual is not None:
        known = flat(OmegaConf.to_container(usual.hydra, resolve=False))  # type: ignore
        for key in sorted(hydra.keys() | known.keys()):
            value = hydra.get(key, "absent")
            if not ALLOWED.fullmatch(key) and value != known.get(key, "absent"):
                why = "of Hydra's keys a config may set mode, sweeper.params, launcher"
                raise ConfigError(f"hydra.{key}", value, why)
    set_here = {k: v for k, v in hydra.items() if k.startswith(("launcher", "sweeper"))}
    found = 0
    for key, value in flat(config | {"hydra": set_here}).items():
        for start in re.finditer(r"\$\{", text := str(value)):
            found += 1
            if found > REPEATS or not INTERPOLATION.match(text, start.start()):
                why = f"a config may have {REPEATS} of ${{key}}, ${{oc.env:NAME}} and "
                why += "${now:…}, not nested, and none of Hydra's own keys"
                raise ConfigError(key, text, why)
