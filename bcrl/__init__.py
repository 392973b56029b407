"""Boosted Curriculum Reinforcement Learning (Klink et al., ICLR 2022), reproduced."""

import importlib as _importlib
import os as _os
import signal as _signal
import sys as _sys
from typing import Any as _Any

from bcrl.common import moved as _moved  # noqa: F401 (finds old names)
from bcrl.common import registration as _registration  # noqa: F401

__version__ = "0.1.0"


_LATER = {"load": "bcrl.run.agents", "export": "bcrl.learning.export"}


def __getattr__(name: str) -> _Any:
    """`bcrl.load` and `bcrl.export`, whose imports take a second."""
    if name in _LATER:
        return getattr(_importlib.import_module(_LATER[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if (
    _os.path.basename((_sys.argv or [""])[0]).startswith("bcrl")
    and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler
):  # a command starts: until there is work to save, Ctrl-C ends it without a word
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
