"""What a command line sweeps over: overrides parsed, and each job's taken apart."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, RangeSweep
from hydra.errors import HydraException

from bcrl.config.bounds import JOBS, check_override
from bcrl.errors import BcrlError


def parse(overrides: Sequence[str]) -> list[Override]:
    """A command line's overrides; BcrlError names one that is none."""
    parser, parsed = OverridesParser.create(), []
    for override in overrides:
        check_override(override)
        try:
            parsed += parser.parse_overrides([override])
        except HydraException as error:
            home = "; ~ isn't expanded, write $HOME" * ("=~" in override)
            text = f"{override!r} can't be read as KEY=VALUE{home}"
            raise BcrlError(text) from error
    return parsed


def over_experiments(override: Override) -> bool:
    """Whether it is a sweep over experiments, each a sweep of its own."""
    return override.key_or_group == "experiment" and override.is_sweep_override()


def experiments(overrides: list[Override], multirun: bool) -> Iterator[list[Override]]:
    """The overrides with each of the experiments that they sweep over."""
    chosen = [o for o in overrides if o.key_or_group == "experiment"]
    if not chosen or not over_experiments(chosen[-1]):
        yield overrides
        return
    if not multirun:
        raise BcrlError("experiment: several values are a sweep; add -m")
    rest = [o for o in overrides if o not in chosen]
    _count(chosen)
    try:
        names = list(chosen[-1].sweep_string_iterator())
    except HydraException as error:
        text = f"experiment={chosen[-1].value()}: list them, experiment=fig1,fig2"
        raise BcrlError(text) from error
    for name in names:
        yield parse([f"experiment={name}"]) + rest


def product(overrides: list[Override]) -> list[list[str]]:
    """The overrides of each job: every combination of the swept values."""
    _count(overrides)
    try:
        return BasicSweeper.split_arguments(overrides, None)[0]
    except HydraException as error:
        raise BcrlError(first_lines(error)) from error


def _count(overrides: Sequence[Override]) -> None:
    """Raise BcrlError for a sweep over more jobs than anyone can mean."""
    jobs = 1.0
    for override in overrides:
        sweep = override.value()
        if isinstance(sweep, ChoiceSweep):
            jobs *= len(sweep.list)
        elif isinstance(sweep, RangeSweep):
            try:
                jobs *= max(0.0, (sweep.stop - sweep.start) / sweep.step)
            except (ArithmeticError, TypeError):  # a step of 0, a number out of range
                jobs = math.inf
        if not 0 < jobs <= JOBS:
            text = (
                f"{override.input_line}: a sweep of more than {JOBS} jobs, or of none"
            )
            raise BcrlError(text)


def first_lines(error: BaseException) -> str:
    """An error's own words, without the key and type listing that OmegaConf appends."""
    lines = str(error).strip().splitlines()
    if not lines and error.__cause__ is not None:
        return first_lines(error.__cause__)
    listing = r"\s*(full_key|reference_type|object_type)"
    text = " ".join(x.strip() for x in lines if not re.match(listing, x))
    if error.__cause__ is not None and text.startswith("Error merging"):
        return f"{text.split()[-1]}: {first_lines(error.__cause__)}"
    key = next((x.split(":", 1)[1].strip() for x in lines if "full_key" in x), "")
    text = text or type(error).__name__
    return text if not key or key in text else f"{key}: {text}"
