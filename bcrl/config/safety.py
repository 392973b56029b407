"""What a composed config may say: nothing that runs code or leads out of a folder."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bcrl.common import plugins
from bcrl.config.bounds import check_interpolations, dotted, references
from bcrl.errors import ConfigError, did_you_mean

#: The keys by which Hydra instantiates.
INSTANTIATING = {"_target_", "_args_", "_partial_", "_recursive_", "_convert_"}
#: What a section of `hydra` may instantiate besides what is trusted.
ALLOWED = {
    "launcher": (
        "hydra._internal.core_plugins.basic_launcher.BasicLauncher",
        "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher",
        "hydra_plugins.hydra_submitit_launcher.submitit_launcher.LocalLauncher",
        "hydra_plugins.hydra_submitit_launcher.submitit_launcher.SlurmLauncher",
    ),
    "sweeper": ("hydra._internal.core_plugins.basic_sweeper.BasicSweeper",),
    "callbacks": ("hydra.experimental.callbacks.LogJobReturnCallback",),
}
#: Arguments of the launchers above that end in a shell.
SHELL = {"setup", "python", "srun_args", "additional_parameters"}
LOGGING = ("job_logging", "hydra_logging")
#: What `logging.config.dictConfig` may be told, by the section it stands in.
LOGGING_KEYS = {
    "": {"version", "formatters", "handlers", "root", "loggers"}
    | {"disable_existing_loggers", "incremental"},
    "formatters": {"format", "datefmt", "style", "validate", "class"},
    "handlers": {"class", "level", "formatter", "stream"}
    | {"filename", "mode", "delay"},
    "loggers": {"level", "handlers", "propagate"},
    "root": {"level", "handlers"},
}
LOGGING_CLASSES = {
    "formatters": ("logging.Formatter", "colorlog.ColoredFormatter"),
    "handlers": ("logging.StreamHandler", "logging.FileHandler", "logging.NullHandler"),
}
#: Hydra's own; at any other place a line of a config's could be run by somebody.
LOG_FILES = (
    "${hydra.runtime.output_dir}/${hydra.job.name}.log",
    "hydra-${hydra.job.name}.log",
)
STREAMS = ("ext://sys.stdout", "ext://sys.stderr")
#: Interpolations that can only be text, wherever they lead.
TEXTUAL = re.compile(
    r"runs_dir|tag|workers|hydra\.(job\.(name|num|id)|run\.dir|sweep\.(dir|subdir)"
    r"|runtime\.(output_dir|cwd))"
)
#: Environment variables that only say how much of a machine is used.
HARMLESS = re.compile(
    r"[A-Z]+_NUM_THREADS|OMP_(PROC_BIND|PLACES|DYNAMIC)|KMP_(AFFINITY|BLOCKTIME)"
    r"|CUDA_(VISIBLE_DEVICES|DEVICE_ORDER)|CUBLAS_WORKSPACE_CONFIG"
)
PATHS = ("runs_dir", "hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{,99}")
COMPONENT, PARTS = 200, 50  # bytes of a part of a path, and how many parts


def check(composed: DictConfig) -> None:
    """Raise BcrlError for whatever in a composed config could do harm once acted on."""
    config = OmegaConf.to_container(composed, resolve=False)
    check_interpolations(config)
    for path, value in _everything(config):
        if isinstance(value, dict):
            _check_instantiation(path, value)
    hydra = config.get("hydra") or {}
    for section in (*ALLOWED, *LOGGING):
        _check_text(("hydra", section), hydra.get(section))
    for section in ("launcher", "sweeper"):
        if "_target_" not in (hydra.get(section) or {}):
            raise ConfigError(f"hydra.{section}", hydra.get(section), "has no _target_")
    for section in LOGGING:
        _check_logging(f"hydra.{section}", hydra.get(section))
    job = hydra.get("job") or {}
    if job.get("chdir"):
        why = "results and checkpoints are in runs_dir, wherever a job is: chdir=false"
        raise ConfigError("hydra.job.chdir", job["chdir"], why)
    for key in ("env_set", "env_copy"):
        for name in job.get(key) or ():
            if not HARMLESS.fullmatch(str(name)):
                why = "only variables such as OMP_NUM_THREADS and CUDA_VISIBLE_DEVICES"
                raise ConfigError(f"hydra.job.{key}", name, why)
    check_name("hydra.job.name", job.get("name", "bcrl"))
    if hydra.get("output_subdir") not in (None, ".hydra"):
        why = "only null or .hydra"
        raise ConfigError("hydra.output_subdir", hydra["output_subdir"], why)
    verbose = hydra.get("verbose", False)
    if any(not isinstance(x, (bool, str)) for x in _parts(verbose)):
        raise ConfigError("hydra.verbose", verbose, "must be true or names of loggers")
    for key in PATHS:
        value = _resolved(composed, key)
        if value is not None:
            check_path(key, str(value))


def check_name(key: str, text: str) -> None:
    """Raise ConfigError for what isn't a plain name of a file or folder."""
    if not NAME.fullmatch(text):
        why = "must be a plain name of at most 100 letters, digits, '.', '_' and '-'"
        raise ConfigError(key, text[:40], why)


def check_path(key: str, text: str) -> None:
    """Raise ConfigError for a path that isn't what it seems, or that can't be made."""
    path = PurePath(text)
    if not text.strip():
        raise ConfigError(key, repr(text), "must name a folder")
    if text.startswith("~"):
        raise ConfigError(key, text, "~ isn't expanded; write $HOME or the whole path")
    if ".." in path.parts and not path.is_absolute():
        raise ConfigError(key, text, "leads out of this folder; name it absolutely")
    if not text.isprintable() or "://" in text:
        raise ConfigError(key, repr(text), "isn't the name of a folder")
    longest = max((len(part.encode()) for part in path.parts), default=0)
    if longest > COMPONENT or len(path.parts) > PARTS:
        raise ConfigError(key, f"{text[:40]}…", "is too long for a path")


def _check_instantiation(path: tuple, mapping: dict) -> None:
    """Raise ConfigError for an instantiation that isn't allowed where it stands."""
    if "()" in mapping:
        raise ConfigError(dotted((*path, "()")), mapping["()"], "is not allowed")
    found = sorted(INSTANTIATING & mapping.keys())
    if not found:
        return
    target, key = mapping.get("_target_"), dotted((*path, found[0]))
    section = path[1] if path[:1] == ("hydra",) and len(path) > 1 else None
    if section not in ALLOWED:
        raise ConfigError(key, mapping[found[0]], "a config can't instantiate")
    if isinstance(target, str) and plugins.is_trusted(target.rpartition(".")[0]):
        made = plugins.attribute(f"{dotted(path)}._target_", target, target)
        if plugins.is_trusted(getattr(made, "__module__", None) or ""):
            return
    top = len(path) == 3 if section == "callbacks" else len(path) == 2
    if found != ["_target_"]:
        raise ConfigError(key, mapping[found[0]], "a config can't instantiate so")
    if not top or target not in ALLOWED[section]:
        known = did_you_mean(str(target), ALLOWED[section])
        why = f"isn't registered; {known}, or a module of yours in {plugins.VARIABLE}"
        raise ConfigError(key, mapping[found[0]], why)
    for argument in sorted(SHELL & mapping.keys()):
        if mapping[argument]:
            why = f"runs commands; trust the launcher's package with {plugins.VARIABLE}"
            raise ConfigError(dotted((*path, argument)), mapping[argument], why)
    if section == "launcher":
        for inner, value in _everything(mapping, path):
            if isinstance(value, str) and not re.fullmatch(r"[^\n\r;`()<>|&]*", value):
                raise ConfigError(dotted(inner), value, "has characters of a shell")
            if isinstance(value, str) and str(inner[-1]).endswith("folder"):
                check_path(dotted(inner), value)


def _check_text(path: tuple, section: object) -> None:
    """Raise ConfigError where text of a section may turn into something else."""
    for inner, value in _everything(section, path):
        if not isinstance(value, str):
            continue
        for found in references(inner, value):
            if not TEXTUAL.fullmatch(found["key"] or ""):
                why = f"{found[0]} isn't allowed here, only the likes of hydra.job.name"
                raise ConfigError(dotted(inner), value, why)
        if path[-1] in LOGGING and "://" in value and value not in STREAMS:
            raise ConfigError(dotted(inner), value, f"only {' and '.join(STREAMS)}")


def _check_logging(key: str, section: Any) -> None:
    """Raise ConfigError for a logging config that names more than plain loggers."""
    if section is None:
        return
    _check_keys(key, section, LOGGING_KEYS[""])
    named = {kind: section.get(kind) or {} for kind in LOGGING_KEYS if kind}
    if section.get("root") is not None:
        named["root"] = {"root": section["root"]}
    for kind, all_ in named.items():
        _check_keys(f"{key}.{kind}", all_, None)
        for name, settings in all_.items():
            where = f"{key}.{name}" if kind == "root" else f"{key}.{kind}.{name}"
            _check_keys(where, settings, LOGGING_KEYS[kind])
            allowed = LOGGING_CLASSES.get(kind, ())
            made = settings.get("class", next(iter(allowed), None))
            if allowed and made not in allowed:
                raise ConfigError(f"{where}.class", made, f"only {', '.join(allowed)}")
            level = settings.get("level", "INFO")
            if level not in logging.getLevelNamesMapping():
                known = did_you_mean(str(level), logging.getLevelNamesMapping())
                raise ConfigError(f"{where}.level", level, known)
            for used, among in (("handlers", "handlers"), ("formatter", "formatters")):
                for each in _parts(settings.get(used) or []):
                    if each not in named[among]:
                        why = did_you_mean(str(each), named[among]) or f"no {among}"
                        raise ConfigError(f"{where}.{used}", each, why)
            if settings.get("filename", LOG_FILES[0]) not in LOG_FILES:
                why = f"only {' or '.join(LOG_FILES)}"
                raise ConfigError(f"{where}.filename", settings["filename"], why)


def _check_keys(key: str, section: object, allowed: set[str] | None) -> None:
    """Raise ConfigError for what is no section, or has a key besides those allowed."""
    if not isinstance(section, dict):
        raise ConfigError(key, section, "must be a section")
    for name in section:
        if allowed is not None and name not in allowed:
            why = f"isn't allowed in logging; {did_you_mean(str(name), allowed)}"
            raise ConfigError(f"{key}.{name}", section[name], why)


def _everything(value: Any, path: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Every value of a config with its path, sections and lists before their parts."""
    yield path, value
    if isinstance(value, (dict, list)):
        inside = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in inside:
            yield from _everything(inner, (*path, key))


def _parts(value: Any) -> list:
    return value if isinstance(value, list) else [value]


def _resolved(composed: DictConfig, key: str) -> str | None:
    """What a key resolves to, or how it is written where that's known only in a job."""
    try:
        return OmegaConf.select(composed, key)
    except OmegaConfBaseException:
        parent, _, last = key.rpartition(".")
        inside = OmegaConf.select(composed, parent) if parent else composed
        return OmegaConf.to_container(inside, resolve=False)[last]
