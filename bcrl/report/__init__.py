"""Tables and figures from `runs/`; imports none of the training code."""

import os

# matplotlib can't be imported where MPLBACKEND names a backend that isn't installed,
# such as a notebook's. Figures are saved here, never shown: none is needed.
_asked = os.environ.pop("MPLBACKEND", None)
try:
    import matplotlib  # noqa: F401
except UnicodeDecodeError as error:
    text = "mend or remove it (in this folder, or in ~/.config/matplotlib)"
    raise SystemExit(f"bcrl: matplotlibrc isn't UTF-8: {text}") from error
finally:
    os.environ.update({} if _asked is None else {"MPLBACKEND": _asked})
