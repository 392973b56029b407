"""Generated bad input: each ends in a message and exit code 2, and leaves no file.

BCRL_FUZZ=2500 sets how many command lines and configs are made up.
"""

import contextlib
import io
import os
import re
import sys
import tempfile
from functools import cache
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from bcrl import cli
from bcrl.common.identity import flat
from bcrl.config.hydra_compose import catalog, composed
from bcrl.run import runner

EXAMPLES = int(os.environ.get("BCRL_FUZZ", "90"))
SHOWING = {"--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--info", "-sc"}


def fuzz(share: float, most: float = float("inf")):
    """Settings for a share of the examples, the same ones in every run."""
    return settings(
        max_examples=max(1, min(most, round(share * EXAMPLES))),
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate],  # an example takes too long to make it smaller
        suppress_health_check=list(HealthCheck),
    )


def drive(*arguments: str, files: dict[str, str] | None = None) -> None:
    """Runs `bcrl *arguments` in a fresh folder; bad input must end as it should."""
    if composed.cache_info().currsize > 200:
        composed.cache_clear()
    ran, said = [], io.StringIO()
    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        folder = Path(name, "here")
        folder.mkdir()
        for path, text in (files or {}).items():
            Path(name, path).parent.mkdir(parents=True, exist_ok=True)
            Path(name, path).write_bytes(text.encode("utf-8", "surrogatepass"))
        before = sorted(Path(name).rglob("*"))
        patch.chdir(folder)
        patch.setenv("XDG_CONFIG_HOME", name)
        patch.setattr(runner, "run", lambda *plans: ran.append(plans))
        words = [a.replace("OWN", f"{name}/own") for a in arguments]
        patch.setattr(sys, "argv", ["bcrl", *words])
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            try:
                code = cli.main()
            except SystemExit as ended:
                code = ended.code
        left = sorted(Path(name).rglob("*"))
    assert "Traceback" not in said.getvalue()
    if not ran:
        assert left == before
        rejected = re.search("^(bcrl|usage): ", said.getvalue(), re.M)
        assert SHOWING & set(arguments) if code in (0, None) else code == 2 and rejected


@cache
def keys() -> list[str]:
    """Every key of the composed configs, Hydra's too."""
    chosen = ("env=linear_system", "algorithm=dqn", "transfer=policy_reuse")
    job = OmegaConf.to_container(composed(chosen), resolve=False)
    del job["hydra"]["help"], job["hydra"]["hydra_help"], job["hydra"]["overrides"]
    return sorted(flat(job))


CHOICES = [
    f"{group}={option}" for group, names in catalog().items() for option in names
]
TEXT = st.text(st.one_of(st.characters(), st.characters(categories=["Cs"])), max_size=8)
CALL = "{_target_: os.system, command: touch canary}"
BAD = (
    *("nan", "inf", "1e400", "-1", "0", "2.5", "true", "null", "''", "???", "[]", "{}"),
    *("[1,2]", "{a: 1}", "[[1]]", "[null]", "many", "9" * 30, "9" * 5000, "1_0", "0x1"),
    *("${env}", "${nope}", "${.x}", "${tag}", "${oc.env:NOPE}", "${hydra:job.name}"),
    *("${now:%Y}", "${", "}", "${oc.create:{a: 1}}", "${${tag}}", "$${x}", "$", "1,2"),
    *("range(1,3)", "range(0,1e9)", "range(1,2,0)", "choice(a,b)", "glob(*)", "int(x)"),
    *("interval(0,1)", "sort(3,1)", "shuffle(1,2)", "tag(a,b)", "str([])", "../x"),
    *("~/x", "'~/x'", "/proc/x", "a/../../b", "a b", "'a\nb'", "'", '"', "\\", "-m"),
    *("$(touch canary)", "a;b", "--help", "x" * 300, "é", "\0", CALL, f"[{CALL}]"),
    *("{(): os.system}", "os.system", ",", "ext://os.system", "file://x", "[pkg://a]"),
    *("[" * 60, "{a:" * 60, "(" * 60, "[" * 9 + "]" * 9, "=", ":", "a:b", "[a,", "{a"),
)
DEFAULTS = (
    *("- nope", "- /env: nope", "- override /env: null", "- _self_\n- _self_", "- [a]"),
    *("- mine", "- /experiment: mine", "- ../../x", "- optional x: ${nope}", "- 3"),
    *("- x@_global_: y", "- /env@hydra: maze", "- {a: b, c: d}", "- a: {b: c}", "3"),
)
NUMBERS = st.one_of(st.integers(), st.floats()).map(str)
VALUE = st.one_of(st.sampled_from(BAD), st.sampled_from(BAD), NUMBERS, TEXT)


@st.composite
def typos(draw, words):
    """One of the words with a letter lost, doubled or replaced."""
    word = draw(st.sampled_from(words))
    at = draw(st.integers(0, len(word) - 1))
    by = draw(st.sampled_from(["", word[at] * 2, ".", "x", "/", "@", " "]))
    return word[:at] + by + word[at + 1 :]


KEYS = st.deferred(lambda: st.sampled_from(keys()))


@st.composite
def overrides(draw):
    """One override, most likely bad."""
    key = draw(st.one_of(KEYS, st.sampled_from(list(catalog()))))
    last = draw(st.sampled_from(["_target_", "_args_", "x", "()", "a.b"]))
    section = key.rpartition(".")[0] or "hydra"
    whole = draw(
        st.one_of(
            typos(CHOICES),
            TEXT,
            st.sampled_from(["=", "a", "a=b=c", "=x", "@"]),
            *[VALUE.map(f"{key}={{}}".format)] * 4,
            VALUE.map(f"{section}={{}}".format),
            VALUE.map(f"{section}.{last}={{}}".format),
            st.builds("{}={}".format, typos([key]), VALUE),
        )
    )
    return draw(st.sampled_from(["", "", "", "+", "++", "~"])) + whole


def driven(bad, base):
    drive(*base, "--", *bad) if bad[0][:1] == "-" else drive(*base, *bad)


BASES = [["env=maze"], ["-m", "env=maze"], ["env=maze", "--info", "all"], []]
SOME = given(st.lists(overrides(), min_size=1, max_size=3), st.sampled_from(BASES))
test_some_bad_overrides_end_in_a_message = fuzz(0.1, most=12)(SOME(driven))
test_bad_overrides_end_in_a_message = pytest.mark.slow(fuzz(0.55)(SOME(driven)))

WORDS = st.sampled_from([value for value in BAD if "\0" not in value])
LEAVES = st.one_of(
    *(st.none(), st.integers(-(10**40), 10**40), st.floats(), st.booleans(), WORDS),
    *(st.text(max_size=8), st.dates(), st.binary(max_size=4)),
)
NAMES = st.sampled_from(["_target_", "()", "defaults", "hydra", "name", 0, 3])
#: What YAML can hold, in shapes that no key wants.
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.one_of(st.text(max_size=4), NAMES), inner, max_size=3),
    ),
    max_leaves=6,
)


@st.composite
def documents(draw):
    """The text of a config, most likely bad, perhaps not even YAML."""
    value = draw(VALUES)
    for part in reversed(draw(st.one_of(KEYS, typos(keys()))).split(".")):
        value = {part: value}
    text = yaml.dump(value, allow_unicode=True)
    at = draw(st.integers(0, len(text)))
    others = (
        text[:at] + draw(TEXT) + text[at:],
        draw(TEXT) + draw(st.sampled_from(["", "\n- x", ": [", "\n\tx: 1"])),
        f"defaults:\n{draw(st.sampled_from(DEFAULTS))}\n{text}",
    )
    return draw(st.sampled_from([text, *others]))


@pytest.mark.slow
@fuzz(0.2)
@given(documents(), st.sampled_from(["experiment", "env", "algorithm", "primary"]))
def test_bad_configs_of_ones_own_end_in_a_message(text, place):
    if place == "primary":
        files = {"own/mine.yaml": f"defaults: [config, _self_]\n{text}"}
        return drive("--config-dir=OWN", "--config-name=mine", "env=maze", files=files)
    head = "# @package _global_\n" if place == "experiment" else ""
    files = {f"own/{place}/mine.yaml": head + text}
    base = [] if place == "env" else ["env=maze"]
    drive("--config-dir=OWN", *base, f"{place}=mine", files=files)
