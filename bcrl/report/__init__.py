"""Tables and figures from `runs/`; imports none of the training code."""

import os

# matplotlib can't be imported where MPLBACKEND names a backend that isn't installed,
# such as a notebook's. Figures are saved here, never shown: none is needed.
_asked = os.environ.pop("MPLBACKEND", None)
try:
    import matplotlib  # noqa: F401
finally:
    os.environ.update({} if _asked is None else {"MPLBACKEND": _asked})
