"""What is wrong below `runs/`: where, what, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bcrl.errors import BcrlError

BROKEN, INCOMPLETE = "broken", "incomplete"  # kinds: not to be trusted; not there yet
AGAIN = "run the same command again"


@dataclass(frozen=True)
class Finding:
    """One file or folder that is not as a finished run leaves it."""

    path: Path
    what: str
    remedy: str
    kind: str = BROKEN

    def __str__(self) -> str:
        name = str(self.path)
        shown = name if name.isprintable() else ascii(name)
        return f"{shown} {self.what}: {self.remedy}"


class Refused(BcrlError):
    """A file that can't be read as what it should be; `finding` says why."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(str(finding))
        self.finding = finding


def unreadable(path: Path, what: str, remedy: str | None = None) -> Refused:
    """The error for a broken file of a seed; by default the seed is to be made anew."""
    anew = f"delete {path.with_suffix('')}.* and {AGAIN} (it makes missing seeds only)"
    return Refused(Finding(path, what, remedy or anew))
