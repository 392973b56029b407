"""MkDocs hooks: the page of all config keys is made while the site is built."""

from collections.abc import Iterable

from mkdocs.structure.files import File

from bcrl.config.describe import GROUPS, SHORTHANDS, entries, option_comments

TOP = """# Config keys

Set a key by `key=value`. `bcrl --describe KEY` prints the same text. If a default
depends on the option or on the environment, they stand in parentheses. For some
methods, `conf/tuned` has other values. This page is generated from the comments in
`conf/`.
"""


def on_files(files, config):
    """Add reference/config.md, made from the comments in conf/."""
    page = File.generated(config, "reference/config.md", content=config_page())
    files.append(page)
    return files


def config_page() -> str:
    """The reference page of all groups and keys."""
    text, known = TOP, entries()
    for group in ("", *GROUPS, *SHORTHANDS):
        text += f"\n## {f'Group `{group}`' if group else 'Keys of no group'}\n"
        if group:
            found = ((f"`{option}`", x) for option, x in option_comments(group).items())
            text += table(["option", "meaning"], found)
        of = [entry for entry in known if entry.group == group]
        rows = [(f"`{e.key}`", e.default, *e.parts[1:], e.parts[0]) for e in of]
        if rows:
            text += table(["key", "default", "unit", "allowed", "meaning"], rows)
    return text


def table(head: list[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    marks = str.maketrans({"|": "&#124;", "<": "&lt;", "[": "\\["})
    return "\n" + "".join(
        f"| {' | '.join(cell.translate(marks) for cell in line)} |\n" for line in lines
    )
