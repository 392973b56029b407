"""What a command line sweeps over: overrides parsed, and each job's taken apart."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    IntervalSweep,
    Override,
    RangeSweep,
)
from hydra.errors import HydraException

from bcrl.config.hydra_compose import first_lines
from bcrl.config.safety import check_override
from bcrl.errors import BcrlError

JOBS = 1_000  # of one sweep


def parse(overrides: Sequence[str]) -> list[Override]:
    """A command line's overrides; BcrlError names one that can't be read."""
    parser, parsed = OverridesParser.create(), []
    for override in overrides:
        check_override(override)
        try:
            parsed += parser.parse_overrides([override])
        except (HydraException, ValueError) as error:  # a number of 5000 digits
            key, _, value = override.partition("=~")
            home = f"; did you mean {key}=$HOME{value}?" if value else ""
            text = f"{override!r} can't be read as KEY=VALUE{home}"
            raise BcrlError(text) from error
    return parsed


def over_experiments(override: Override) -> bool:
    """Whether it is a sweep over experiments, each of which is a sweep."""
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
    for (one,) in product(chosen[-1:]):
        yield parse([one]) + rest


def product(overrides: list[Override]) -> list[list[str]]:
    """The overrides of each job: every combination of the swept values.

    Raises BcrlError for a sweep over more jobs than anyone can mean.
    """
    jobs = 1.0
    for override in overrides:
        sweep = override.value()
        if isinstance(sweep, IntervalSweep):
            line = f"-m {override.key_or_group}=0.1,0.5"
            why = f"can't be swept over; did you mean {line}?"
            raise BcrlError(f"{override.input_line}: an interval {why}")
        if isinstance(sweep, ChoiceSweep):
            jobs *= len(sweep.list)
        elif isinstance(sweep, RangeSweep):
            try:
                jobs *= max(0.0, (sweep.stop - sweep.start) / sweep.step)  # type: ignore
            except (ArithmeticError, TypeError):  # a step of 0, a number out of range
                jobs = math.inf
        if not 0 < jobs <= JOBS:
            why = f"a sweep of more than {JOBS} jobs, or of none"
            raise BcrlError(f"{override.input_line}: {why}")
    try:
        return BasicSweeper.split_arguments(overrides, None)[0]
    except HydraException as error:
        raise BcrlError(first_lines(error)) from error
