"""Boosted Curriculum Reinforcement Learning (Klink et al., ICLR 2022), reproduced."""

import os as _os
import signal as _signal
import sys as _sys
from typing import Any as _Any

from bcrl.common import moved as _moved  # noqa: F401 (finds old names)
from bcrl.common import registration as _registration  # noqa: F401

__version__ = "0.1.0"


def __getattr__(name: str) -> _Any:
    """`bcrl.load`, whose imports take a second."""
    if name == "load":
        from bcrl.run.agents import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if (
    _os.path.basename((_sys.argv or [""])[0]).startswith("bcrl")
    and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler
):  # a command starts: until there is work to save, Ctrl-C ends it without a word
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
