"""Generated bad input: each ends in a message and exit code 2, and leaves no file.

BCRL_FUZZ=2500 sets how many command lines and configs are made up.
"""

import contextlib
import io
import os
import re
import sys
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from bcrl import cli
from bcrl.common.identity import flat
from bcrl.config.hydra_compose import CONF, composed
from bcrl.run import runner

EXAMPLES = int(os.environ.get("BCRL_FUZZ", "90"))
SHOWING = ("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--info", "-i")
outcomes = Counter()


def fuzz(share: float):
    """Settings for a share of the examples, the same ones in every run."""
    return settings(
        max_examples=max(1, round(share * EXAMPLES)),
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate],  # an example takes too long to make it smaller
        suppress_health_check=list(HealthCheck),
    )


def drive(*arguments: str, files: dict[str, str] | None = None) -> None:
    """Runs `bcrl *arguments` in a fresh folder; bad input must end as it should."""
    if sum(outcomes.values()) % 200 == 0:
        composed.cache_clear()
    ran, said, shown = [], io.StringIO(), io.StringIO()
    before = os.getcwd(), sys.argv, runner.run
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "here")
        folder.mkdir()
        for path, text in (files or {}).items():
            Path(name, path).parent.mkdir(parents=True, exist_ok=True)
            Path(name, path).write_bytes(text.encode("utf-8", "surrogatepass"))
        os.chdir(folder)
        sys.argv = ["bcrl", *(a.replace("OWN", f"{name}/own") for a in arguments)]
        runner.run = lambda *plans: ran.append(plans)
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(shown):
                try:
                    code = cli.main()
                except SystemExit as ended:
                    code = ended.code
            left = sorted(str(p.relative_to(name)) for p in Path(name).rglob("*"))
        finally:
            os.chdir(before[0])
            sys.argv, runner.run = before[1:]
    given = sorted({str(q) for p in files or {} for q in (p, *Path(p).parents)} - {"."})
    assert "Traceback" not in said.getvalue() + shown.getvalue()
    if ran:
        outcomes["valid"] += 1
        return
    assert left == sorted([*given, "here"])
    if code in (0, None):
        assert set(SHOWING) & set(arguments) or "-sc" in arguments
        outcomes["shown"] += 1
        return
    assert code == 2
    assert re.search("^(bcrl|usage): ", said.getvalue(), re.M), said.getvalue()
    outcomes["refused"] += 1


@cache
def keys() -> list[str]:
    """Every key of the composed configs, Hydra's too."""
    found = set()
    for chosen in (
        ("env=maze", "variant=SBC", "algorithm=dqn"),
        ("env=linear_system", "algorithm=dqn", "transfer=policy_reuse"),
        ("env=car_on_hill", "curriculum=on", "hydra/job_logging=default"),
    ):
        job = OmegaConf.to_container(composed("config", chosen, ()), resolve=False)
        del job["hydra"]["help"], job["hydra"]["hydra_help"], job["hydra"]["overrides"]
        found |= flat(job).keys()
    return sorted(found)


@cache
def options() -> list[str]:
    """Every choice there is, `env=maze` and the like."""
    files = [path.relative_to(CONF).with_suffix("") for path in CONF.rglob("*/*.yaml")]
    return sorted(f"{path.parent}={path.name}" for path in files)


TEXT = st.text(st.one_of(st.characters(), st.characters(categories=["Cs"])), max_size=8)
CALL = "{_target_: os.system, command: touch canary}"
BAD = (
    *("nan", "inf", "-inf", "1e400", "-1", "-0.5", "0", "2.5", "true", "null", "''"),
    *("???", "[]", "{}", "[1,2]", "{a: 1}", "[[1]]", "[null]", "many", "9" * 30),
    *(
        "9" * 5000,
        "1_0",
        "0x1",
        "1e9",
        "${env}",
        "${nope}",
        "${.x}",
        "${..a}",
        "${tag}",
    ),
    *("${oc.env:NOPE}", "${oc.env:HOME}", "${hydra:job.name}", "${now:%Y}", "${", "}"),
    *("${oc.create:{a: 1}}", "${oc.decode:'1'}", "${${tag}}", "${a.b}", "$${x}", "$"),
    *("1,2", "range(1,3)", "range(0,1e9)", "range(1,2,0)", "choice(a,b)", "glob(*)"),
    *("interval(0,1)", "sort(3,1)", "shuffle(1,2)", "int(x)", "tag(a,b)", "str([])"),
    *("../x", "~/x", "'~/x'", "/proc/x", "a/../../b", "a b", "'a\nb'", "'", '"', "\\"),
    *("$(touch canary)", "`touch canary`", "a;b", "-m", "--help", "x" * 300, "é", "\0"),
    *(CALL, f"[{CALL}]", "{(): os.system}", "'{\"()\": os.system}'", "os.system", ","),
    *("ext://os.system", "cfg://x", "file://x", "pkg://antigravity", "[pkg://this]"),
    *("[" * 60, "{a:" * 60, "(" * 60, "[" * 9 + "]" * 9, "=", ":", "a:b", "[a,", "{a"),
)


DEFAULTS = (
    *("- nope", "- /env: nope", "- override /env: null", "- _self_\n- _self_", "- [a]"),
    *("- mine", "- /experiment: mine", "- ../../x", "- optional x: ${nope}", "- 3"),
    *("- x@_global_: y", "- /env@hydra: maze", "- {a: b, c: d}", "- a: {b: c}", "3"),
)


def scalars():
    """Values as the command line writes them, hardly any of which fits anywhere."""
    numbers = st.one_of(st.integers(), st.floats()).map(str)
    return st.one_of(st.sampled_from(BAD), st.sampled_from(BAD), numbers, TEXT)


@st.composite
def typos(draw, words):
    """One of the words with a letter lost, doubled or replaced."""
    word = draw(st.sampled_from(words))
    at = draw(st.integers(0, len(word) - 1))
    by = draw(st.sampled_from(["", word[at] * 2, ".", "x", "/", "@", " "]))
    return word[:at] + by + word[at + 1 :]


@st.composite
def overrides(draw):
    """One override, most likely bad."""
    prefix = draw(st.sampled_from(["", "", "", "+", "++", "~"]))
    kind = draw(st.integers(0, 9))
    if kind == 0:
        return prefix + draw(typos(options()))
    if kind == 1:
        group = draw(st.sampled_from(options())).partition("=")[0]
        return f"{prefix}{group}={draw(scalars())}"
    if kind == 2:
        return draw(st.one_of(TEXT, st.sampled_from(["=", "a", "a=b=c", "=x", "@"])))
    if kind == 3:
        return f"{prefix}{draw(typos(keys()))}={draw(scalars())}"
    if kind == 4:
        section = draw(st.sampled_from(keys())).rpartition(".")[0] or "hydra"
        return f"{prefix}{section}={draw(scalars())}"
    if kind == 5:
        place = draw(st.sampled_from([*keys(), "env", "hydra.launcher", "algorithm"]))
        last = draw(st.sampled_from(["_target_", "_args_", "x", "()", "a.b"]))
        return f"{prefix}{place}.{last}={draw(scalars())}"
    return f"{prefix}{draw(st.sampled_from(keys()))}={draw(scalars())}"


@fuzz(0.55)
@given(
    st.lists(overrides(), min_size=1, max_size=3),
    st.sampled_from([["env=maze"], ["env=maze"], ["-m", "env=maze"], []]),
)
def test_bad_overrides_end_in_a_message(bad, base):
    drive(*base, "--", *bad) if bad[0][:1] == "-" else drive(*base, *bad)


@fuzz(0.1)
@given(st.data())
def test_choices_that_can_not_be_together_end_in_a_message(data):
    chosen = data.draw(st.lists(st.sampled_from(options()), min_size=2, max_size=6))
    value = data.draw(st.sampled_from(["env.tasks={}", "tag=a b", "scale.name=null"]))
    drive("env=maze", *chosen, *([value] * data.draw(st.booleans())))


def plain_values():
    """What YAML can hold, in shapes that no key wants."""
    leaf = st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.integers(-(10**40), 10**40),
        st.floats(),
        st.text(max_size=8),
        st.sampled_from([v for v in BAD if "\0" not in v]),
        st.dates(),
        st.binary(max_size=4),
    )
    return st.recursive(
        leaf,
        lambda inner: st.one_of(
            st.lists(inner, max_size=3),
            st.dictionaries(
                st.one_of(
                    st.text(max_size=4),
                    st.integers(0, 3),
                    st.sampled_from(["_target_", "()", "defaults", "hydra", "name"]),
                ),
                inner,
                max_size=3,
            ),
        ),
        max_leaves=6,
    )


@st.composite
def documents(draw):
    """The text of a config, most likely bad, perhaps not even YAML."""
    key = draw(st.one_of(st.sampled_from(keys()), typos(keys())))
    value = draw(plain_values())
    for part in reversed(key.split(".")):
        value = {part: value}
    text = yaml.dump(value, allow_unicode=True)
    kind = draw(st.integers(0, 7))
    if kind == 0:
        at = draw(st.integers(0, len(text)))
        text = text[:at] + draw(TEXT) + text[at:]
    elif kind == 1:
        text = draw(TEXT) + draw(st.sampled_from(["", "\n- x", ": [", "\n\tx: 1"]))
    elif kind == 2:
        wrong = st.one_of(plain_values(), st.lists(plain_values(), max_size=3))
        text = yaml.dump({"defaults": draw(wrong)}) + text
    elif kind == 3:
        text = f"defaults:\n{draw(st.sampled_from(DEFAULTS))}\n{text}"
    elif kind == 4:
        chain = "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
        text = f"a0: &a0 [x]\n{chain}"
    return text


@fuzz(0.3)
@given(documents(), st.sampled_from(["experiment", "env", "algorithm", "primary"]))
def test_bad_configs_of_ones_own_end_in_a_message(text, place):
    if place == "primary":
        files = {"own/mine.yaml": f"defaults: [config, _self_]\n{text}"}
        return drive("--config-dir=OWN", "--config-name=mine", "env=maze", files=files)
    head = "# @package _global_\n" if place == "experiment" else ""
    files = {f"own/{place}/mine.yaml": head + text}
    base = [] if place == "env" else ["env=maze"]
    drive("--config-dir=OWN", *base, f"{place}=mine", files=files)


@fuzz(0.05)
@given(
    st.lists(
        st.one_of(
            st.sampled_from(["--cfg", "job", "hydra", "--info", "all", "--resolve"]),
            st.sampled_from(["--help", "--hydra-help", "-m", "--run", "-sc", "-x"]),
            st.sampled_from(["--package", "--config-name", "--config-path", "--"]),
            st.sampled_from(["--config-dir", "--experimental-rerun", "install=bash"]),
            st.sampled_from(["env=maze", "env=maz", "nope", "", "query=bash"]),
            overrides(),
        ),
        min_size=1,
        max_size=5,
    )
)
def test_odd_command_lines_end_in_a_message(arguments):
    # A valid one without an override is what `bcrl env=maze` is.
    drive(*arguments)


def test_most_of_what_was_made_up_was_bad(capsys):
    if not outcomes:
        pytest.skip("runs after the tests above")
    with capsys.disabled():
        print(f"\n{sum(outcomes.values())} made up: {dict(outcomes)}")
    assert outcomes["refused"] > 0.6 * sum(outcomes.values())
