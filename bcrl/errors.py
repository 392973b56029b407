"""Errors that a user can correct: one clear message, no traceback."""

import difflib
from collections.abc import Iterable


class BcrlError(Exception):
    """An error that the user can correct; the message says what and how."""

    exit_code = 2  # of the command: bad input, or no place to write


class ConfigError(BcrlError):
    """A rejected configuration value: names the key, the value and what is allowed."""

    def __init__(self, key: str, value: object, allowed: str) -> None:
        super().__init__(f"{key}={value}: {allowed}")
        self.key, self.value, self.allowed = key, value, allowed

    def __reduce__(self) -> tuple:  # so that it can leave a process
        return type(self), (self.key, self.value, self.allowed)


class LostSeeds(BcrlError):
    """Some seeds of a batch have failed; `reasons` by their place in the batch."""

    def __init__(self, reasons: dict[int, str]) -> None:
        super().__init__("; ".join(dict.fromkeys(reasons.values())))
        self.reasons = reasons


def at_least(key: str, value: int | None, least: int) -> None:
    """Raise ConfigError if `value` is below `least`; None passes."""
    if value is not None and value < least:
        raise ConfigError(key, value, f"must be at least {least}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`did you mean maze?`, with the known words listed as long as they are few."""
    known = sorted(known)
    near, listed = closest(word, known), f"known: {', '.join(known)}"
    if near is None:
        return listed
    return f"did you mean {near}?" + f" ({listed})" * (len(known) <= 12)


def closest(word: str, known: Iterable[str], like: float = 0.5) -> str | None:
    """The known word that is most like `word`, if one is like it at all."""
    return next(iter(difflib.get_close_matches(word, sorted(known), 1, like)), None)
