"""The overrides of a command line, as they are meant: `tag=1e3` is no number."""

import math
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser import types
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from bcrl.common.terminal import say
from bcrl.config.hydra_compose import STARTED, Paths, catalog, first_lines
from bcrl.config.safety import check_override
from bcrl.config.schema import TEXTS, section_of_seeds
from bcrl.errors import BcrlError, ConfigError

JOBS = 1_000  # of one sweep
#: Functions of names, and those whose arguments are no names.
CHOICE = re.compile(r"^\s*(?:choice\((.*)\)|(?:shuffle|sort)\(([^()=]*)\))\s*$")
NOW = re.compile(r"\$\{now:([^{}]*)\}")
COMPUTED = re.compile(r"\s*(range|interval|glob|int|float|bool|str|json_str)\s*\(")


def parse(overrides: Sequence[str]) -> list[Override]:
    """A command line's overrides; BcrlError names one that can't be read."""
    parser, parsed = OverridesParser.create(), []
    for override in overrides:
        check_override(override)
        try:
            parsed += parser.parse_overrides([override])
        except (HydraException, ValueError) as error:  # a number of 5000 digits
            home = override.replace("=~", "=$HOME")
            meant = f"; did you mean {home}?" if home != override else ""
            text = f"{override!r} can't be read as KEY=VALUE{meant}"
            raise BcrlError(text) from error
    return parsed


def canonical(overrides: Sequence[str], folders: Paths) -> list[str]:
    """The overrides as Hydra should read them; what is canonical stays as it is."""
    if "hydra/launcher=local" in overrides:  # a former launcher
        say("hydra/launcher=local: this launcher is gone; workers=N takes its place")
        number = r"hydra\.launcher\.n_jobs=(?=\d)"  # -1 meant all cores
        renamed = [re.sub(number, "workers=", o) for o in overrides]
        overrides = [o for o in renamed if not re.match("hydra[/.]launcher", o)]
        if not any(o.startswith("workers=") for o in overrides):
            overrides.append(f"workers={os.cpu_count()}")
    found: dict[str, str] = {}  # of a key of seeds the last one holds
    groups = catalog(folders)
    for text in (text for each in overrides for text in _canonical(each, groups)):
        key = text.partition("=")[0] if text.startswith("seeds.") else text
        found.pop(key, None)
        found[key] = text
    return list(found.values())


def _canonical(text: str, groups: dict[str, list[str]]) -> Iterator[str]:
    text = NOW.sub(lambda found: STARTED.strftime(found[1]), text)
    (override,) = parse([text])
    key, value = override.key_or_group, override.value()
    head, equals, raw = text.partition("=")
    known = groups.get(key, [])  # a group's options
    swept = isinstance(value, types.ChoiceSweep)
    values: list[Any] = value.list if swept else [value]  # type: ignore[union-attr]
    if override.is_delete() or not equals:
        yield text
    elif key in ("seed", "seeds") or (key == "seeds.only" and value is not None):
        # By the section's keys, also in a sweep.
        sections = [section_of_seeds(key, each) for each in values]
        if len({tuple(section) for section in sections}) > 1:
            raise ConfigError(key, raw, "sweep over either numbers or lists")
        for name in sections[0]:
            those = [str(section[name]).replace(" ", "") for section in sections]
            yield f"seeds.{name}={'null' if those[0] == 'None' else ','.join(those)}"
    elif isinstance(value, types.Glob):
        names = value.filter(known)
        if not names:
            why = f"glob(…) picks options of a group; {key} has {', '.join(known)}"
            raise ConfigError(key, raw, why)
        yield from _canonical(f"{head}={','.join(names)}", groups)
    else:
        is_text = known or key in TEXTS or key.endswith((".name", ".id"))
        written = CHOICE.sub(r"\1\2", raw).split(",") if swept else [raw]
        kept = COMPUTED.match(raw) or (known and isinstance(value, list))
        if is_text and not kept and len(written) == len(values):
            each = (_as_text(w, v, key) for w, v in zip(written, values, strict=True))
            text = f"{head}={','.join(each)}"
        yield text


def _as_text(written: str, value: object, key: str) -> str:
    """A value as it was written: no number, and no folder that leads outside."""
    text = value.text if isinstance(value, types.QuotedString) else str(value)
    if key == "runs_dir" and ".." in PurePath(text).parts and text[0] not in "/$":
        written = os.path.realpath(text)
    elif not isinstance(value, int | float):
        return written
    return '"' + written.strip().replace('"', r"\"") + '"'


def product(overrides: Sequence[Override]) -> list[list[str]]:
    """The overrides of each job: every combination of the swept values."""
    jobs = 1.0
    for override in overrides:
        sweep = override.value()
        why = f"a sweep of more than {JOBS} jobs, or of none"
        if isinstance(sweep, types.IntervalSweep):
            jobs, why = 0, f"no interval; did you mean {override.key_or_group}=0.1,0.5?"
        elif isinstance(sweep, types.ChoiceSweep):
            jobs *= len(sweep.list)
        elif isinstance(sweep, types.RangeSweep):
            try:
                jobs *= max(0.0, (sweep.stop - sweep.start) / sweep.step)  # type: ignore
            except (ArithmeticError, TypeError):  # a step of 0, a number out of range
                jobs = math.inf
        if not 0 < jobs <= JOBS:
            raise BcrlError(f"{override.input_line}: {why}")
    try:
        return BasicSweeper.split_arguments(list(overrides), None)[0]
    except HydraException as error:
        raise BcrlError(first_lines(error)) from error
