"""The command's flags, its help, and what Tab completes."""

import argparse
import contextlib
import os
import re
import sys
import textwrap
from argparse import Namespace
from itertools import takewhile
from pathlib import Path
from string import Template
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from omegaconf import OmegaConf

from bcrl import __version__
from bcrl.common.files import user_folder
from bcrl.common.identity import flat
from bcrl.config.hydra_compose import catalog, composed
from bcrl.config.safety import check_override
from bcrl.errors import BcrlError, closest

#: Flags of which Hydra knows nothing, or that are handed to it in another way.
_OURS = {"describe", "dry_run", "status", "runs_dir", "overrides", "config_dir", "help"}
_OURS |= {"send_complete"}


def arguments() -> Namespace:
    """What the command line asks for; `unnamed`: it names no folder of configs."""
    flags, words = flag_parser(), sys.argv[1:]
    names = list(flags._option_string_actions)
    for word in words:
        check_override(word)
    for place, word in enumerate(takewhile(lambda word: word != "--", words)):
        name = word.partition("=")[0]
        letters = len(name) > 1 and all(f"-{letter}" in names for letter in name[1:])
        is_long = name[:2] == "--" and any(each.startswith(name) for each in names)
        if name[:1] == "-" and not (name in names or letters or is_long):
            from bcrl.config.hints import Hints  # a large import

            hints = Hints(tuple(w for w in words if re.match(r"[^-].*=", w)))
            # What --runs-dir says its key says, too.
            long = [x for x in names if x[:2] == "--" and x != "--runs-dir"]
            near = closest(name, long, 0.7)
            meant = f"did you mean {near}?" if near else hints.meant(words, place)
            raise BcrlError(f"{word}: unknown flag; {meant}")
    asked = flags.parse_intermixed_args()
    if asked.runs_dir is not None:
        quoted = asked.runs_dir.replace('"', r"\"")
        asked.overrides.append(f'runs_dir="{quoted}"')
    asked.unnamed = asked.config_dir is None
    asked.config_dir = _folder(asked)
    return asked


def for_hydra(asked: Namespace) -> list[str]:
    """The flags that Hydra is given."""
    given = []
    for action in flag_parser()._actions:
        value = getattr(asked, action.dest, None)
        if value and action.dest not in _OURS:
            name = max(action.option_strings, key=len)
            given.append(name if value is True else f"{name}={value}")
    return given


def flag_parser() -> argparse.ArgumentParser:
    """Hydra's flags and ours."""
    result = get_args_parser()
    result.prog = "bcrl"
    shown: Any = result._option_string_actions["--version"]
    shown.version = f"bcrl {__version__}"
    result.add_argument("--describe", nargs="?", const="")
    result.add_argument("--dry-run", action="store_true")
    result.add_argument("--runs-dir")
    result.add_argument("--send-complete", action="store_true")
    result.add_argument("--status", action="store_true")

    def reject(message: str) -> NoReturn:
        raise BcrlError(f"{message}; see bcrl --help")

    result.error = reject  # type: ignore[method-assign]
    return result


def _folder(asked: Namespace) -> str | None:
    """The folder of configs, absolute: the one that is named, or ~/.config/bcrl."""
    base = user_folder("XDG_CONFIG_HOME", ".config")
    own = base / "bcrl" if base and (base / "bcrl").is_dir() else None
    folder = asked.config_dir or own
    return os.path.abspath(folder) if folder else None


def short() -> str:
    """What `bcrl` alone shows: what it is, examples, and where to read more."""
    title, _, rest = manual(None).partition("\n")
    examples = rest.partition("\nExamples\n")[2].partition("\n\n")[0]
    return f"{title}\n\n{examples}\n\nbcrl --help shows groups, keys, flags and more."


def manual(config_dir: str | None) -> str:
    """The help, with the options of every group, those of the user's folder too."""
    folders = (config_dir,) if config_dir else ()
    text = Template(Path(__file__).with_name("help.txt").read_text("utf-8"))
    known = catalog(folders).items()
    options = {name.replace("/", "__"): ", ".join(each) for name, each in known}
    lines = text.substitute(options).splitlines()
    hanging = " " * 21  # where an option's text begins
    return "\n".join(textwrap.fill(x, 88, subsequent_indent=hanging) for x in lines)


def completions(line: str) -> list[str]:
    """What a line's last word may become: a flag, an option, a group or a key."""
    words = line.split()[1:]
    word = words.pop() if words and not line[-1].isspace() else ""
    flags = flag_parser()
    if word.startswith("-"):
        return sorted(n for n in flags._option_string_actions if n.startswith(word))
    try:
        typed, _ = flags.parse_known_intermixed_args(words)
    except BcrlError:  # a flag's own argument is missing: the shell proposes files
        return []
    folders = tuple(filter(None, [_folder(typed)]))
    groups = catalog(folders)
    key, equals, begun = word.partition("=")
    if equals:
        found = [each for each in groups.get(key, ()) if each.startswith(begun)]
        return [f"{key}={each}" for each in found]
    chosen = any(o.startswith(("env=", "experiment=")) for o in typed.overrides)
    # Without an env nothing composes; most keys are the same in all of them.
    overrides = [o for o in typed.overrides if not o.startswith("hydra.")]
    asked = (*["env=maze"] * (not chosen), *overrides)
    known = [name for name in groups if not name.startswith("tuned")]
    with contextlib.suppress(BcrlError):  # the command itself says what is wrong
        job: Any = OmegaConf.to_container(composed(asked, folders))
        known += [key for key in flat(job) if not key.startswith("hydra.")]
    rest = (name[len(word) :].partition(".") for name in known if name.startswith(word))
    return sorted({f"{word}{step}{dot or '='}" for step, dot, _ in rest})
