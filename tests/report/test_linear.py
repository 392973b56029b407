"""The report of the DQN family, on made-up runs of the linear system."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bcrl.errors import BcrlError
from bcrl.report import cli
from bcrl.report.claims.document import claims_report
from bcrl.report.figures import style
from bcrl.report.figures.linear import figure_4a, figure_4b, pretraining, prior
from bcrl.report.load import load_runs
from bcrl.report.sweeps import sweep_sections, sweep_table
from bcrl.report.tables import aggregate, number
from bcrl.report.variants import COMPARED
from bcrl.results.layout import DQN_METRICS, FQI_METRICS, INDEX, seed_path
from tests.report.test_report import verdicts_of
from tests.results.made_up import edit_csv, made_up_plan, rerecord, reseal, write_seeds

SEVEN = COMPARED["linear_system", "DQN"]
LEVEL = {"DQN": -100, "C-DQN": -120, "BC-DQN": -80, "SC-DQN": -60, "SBC-DQN": -45}
LEVEL |= {"RPL": -110, "PPR": -105, "S-DQN": -100}
ACTIONS = np.array(
    [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)], float
)
ACTIONS /= np.linalg.norm(ACTIONS, axis=1, keepdims=True)
PLANE = np.array([(x, 0, y, 0) for x in range(-20, 21) for y in range(-20, 21)]) / 4


def steps_of(method: str) -> list[tuple[int, int, list[int]]]:
    """(stage, task, steps of its evaluations), as the paper's budgets give."""
    if method in ("DQN", "S-DQN"):
        return [(1, 2, [500 + 1000 * k - 500 * (k > 0) for k in range(41)])]
    if method == "C-DQN":
        lq = [500 * k for k in range(1, 22)]
        return [(1, 1, lq), (2, 2, [10500 + 1000 * k for k in range(31)])]
    fill = 500 if method == "SC-DQN" else 0
    lspi = (1, 1, [0, 500, 1000, 1500, 2000])
    return [lspi, (2, 2, [2000 + fill + 1000 * k for k in range(39)])]


def made_up(method: str, seed: int, scatter: float = 5.0) -> pd.DataFrame:
    """A learning curve from −150 up to LEVEL, with some noise."""
    rng = np.random.default_rng([seed, SEVEN.index(method) if method in SEVEN else 9])
    blocks = []
    for stage, task, steps in steps_of(method):
        t = (np.array(steps) - steps[0]) / 40000
        if task == 2:
            gain = (LEVEL[method] + 150) * (1 - np.exp(-t * 5))
            value = -150 + gain + rng.normal(0, scatter) * (t > 0)
            value = np.clip(value + rng.normal(0, scatter, len(t)), -150, 0)
        else:
            value = -150 - 2500 * np.exp(-t * 40) + rng.normal(0, 20, len(t))
        block = {"stage": stage, "task": task, "step": steps, "return": value}
        block |= {"discounted_return": 0.6 * value, "q_mean": value}
        block |= {"success_rate": 1 + value / 150 if task == 2 else 0.0}
        loss = np.full(len(t), 0.5)
        loss[0] = np.nan
        if task == 1 and method != "C-DQN":
            loss[:] = np.nan
        block |= {"loss": loss, "greedy_return": value + 1}
        block |= {"greedy_discounted_return": value, "greedy_success_rate": 0.5}
        blocks.append(pd.DataFrame(block))
    table = pd.concat(blocks, ignore_index=True)
    return table[["stage", "task", "step", *DQN_METRICS]]


def arrays(method: str) -> dict[str, np.ndarray]:
    x, y = PLANE[:, 0], PLANE[:, 2]
    value = -30 * (x**2 + y**2) - 100
    pull = -np.stack([x, y], 1) @ ACTIONS.T  # towards the origin
    stages = len(steps_of(method))
    return {
        "states": PLANE,
        "q_stages": np.repeat((value[:, None] + pull)[None], stages, 0),
        "actions": ACTIONS,
        "pathway": np.array([-5, -0.5, 1, 0.5]),
        "goal": np.array([0, 0, 0.2]),
        "start": np.array([-4.001, -0.4, -3.999, 0.4]),
        "drift": np.array([-0.5, 0.0]),
    }


def write(
    runs_dir: Path,
    methods: tuple[str, ...] = SEVEN,
    seeds: range = range(6),
    tag: str = "",
    env: str = "linear_system",
    config: dict | None = None,
    shift: float = 0.0,
    scatter: float = 5.0,
) -> None:
    """Complete runs as the runner leaves them."""
    for method in methods:
        stages = steps_of(method)
        first = "dqn" if method in ("DQN", "C-DQN", "S-DQN") else "lspi"
        facts = {"learners": [first, "dqn"][: len(stages)]}
        facts |= {"optimum": None, "cpu_seconds": 60.0}

        def table(seed: int, method=method) -> pd.DataFrame:
            found = made_up(method, seed, scatter)
            found.loc[found["task"] == 2, "return"] += shift
            return found

        plan = made_up_plan(runs_dir, env, method + tag, seeds, config=config)
        write_seeds(plan, table, lambda seed, method=method: arrays(method), facts)


def run(runs_dir: Path, *arguments: str) -> int:
    return cli.main(["--runs-dir", str(runs_dir), "--scale", "smoke", *arguments])


def csv(runs_dir: Path, folder: str, seed: int) -> Path:
    return seed_path(runs_dir / "smoke" / "linear_system" / folder, seed, "csv")


# --- reading


def test_runs_are_read_without_a_note(tmp_path):
    """nan losses are no oddity; different lengths and starts are meant."""
    write(tmp_path)
    edit_csv(csv(tmp_path, "DQN", 1), lambda t: t.assign(q_mean=np.nan))
    runs = load_runs(tmp_path, "smoke")
    assert runs.notes == []
    methods = runs.methods("linear_system", None, "DQN")
    assert tuple(methods) == SEVEN
    assert methods["C-DQN"].index[[0, -1]].tolist() == [500, 40500]
    assert methods["C-DQN"].metrics["loss"].shape == (6, 52)
    assert runs.methods("linear_system", None) == {}


def test_families_stand_side_by_side(tmp_path):
    write(tmp_path, ("DQN",), env="maze")
    row = dict.fromkeys(("stage", "task", "iteration", *FQI_METRICS["maze"]), 1)
    plan = made_up_plan(tmp_path, "maze", "FQI", range(1))
    write_seeds(plan, lambda seed: pd.DataFrame([row]))
    runs = load_runs(tmp_path, "smoke")
    for family, other, counter in (("FQI", "DQN", "iteration"), ("DQN", "FQI", "step")):
        assert list(runs.methods("maze", None, family)) == [family]
        table = aggregate(runs, family)
        assert set(table["variant"]) == {family} and counter in table
        assert INDEX[other][-1] not in table


def test_failed_seeds_are_left_out_by_name(tmp_path):
    write(tmp_path, ("DQN", "C-DQN", "S-DQN"))
    failed = "failed: non-finite weights at step 12000"
    reseal(csv(tmp_path, "DQN", 2).with_suffix(".json"), status=failed)
    reseal(csv(tmp_path, "S-DQN", 1).with_suffix(".json"), status="running")
    with pytest.raises(BcrlError, match=f'seed_0002.json says "{failed}"'):
        load_runs(tmp_path, "smoke")
    runs = load_runs(tmp_path, "smoke", allow_incomplete=True)
    variant = runs.methods("linear_system", None, "DQN")["DQN"]
    assert (variant.seeds, variant.failed) == ((0, 1, 3, 4, 5), (2,))
    document = claims_report(runs)
    assert "| DQN | 5 (1 failed) |" in document
    assert "S-DQN 5 of 6 seeds" in document
    with style.sheet():
        footer = figure_4a(runs).get_supxlabel()
    assert "INCOMPLETE: DQN 5 of 6 seeds (1 failed)" in footer
    assert "S-DQN 5" not in footer  # which figure 4 does not compare


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t: t.assign(step=t["step"] * 2), "in its step column"),
        (lambda t: t[:30], "in its length (30 rows, not 41)"),
        (lambda t: t.assign(greedy_return=np.inf), "greedy_return in row"),
        (lambda t: t.assign(step=t["step"][::-1].to_numpy()), "fall"),
        (lambda t: t.assign(step=t["step"] + 0.5), "whole number"),
        (lambda t: t.assign(step=t["step"] - 1000), "whole number"),
        (
            lambda t: t.assign(step=range(1, 42)).rename(columns={"step": "iteration"}),
            "has the header stage,task,iteration",
        ),
    ],
)
def test_bad_tables_are_rejected(tmp_path, edit, message):
    write(tmp_path, ("DQN",), range(4))
    edit_csv(csv(tmp_path, "DQN", 3), edit)
    with pytest.raises(BcrlError, match=r"seed_0003\.csv ") as rejected:
        load_runs(tmp_path, "smoke")
    assert message in str(rejected.value)


# --- figure 4


@pytest.mark.parametrize(
    ("methods", "seeds"),
    [
        (("C-DQN", "S-DQN"), 1),
        pytest.param(("DQN",), 1, marks=pytest.mark.slow),
        pytest.param(("RPL",), 2, marks=pytest.mark.slow),
        pytest.param(SEVEN, 3, marks=pytest.mark.slow),
    ],
)
def test_both_figures_are_drawn(tmp_path, capsys, methods, seeds):
    write(tmp_path, methods, range(seeds))
    assert run(tmp_path, "--figures", "4a", "4b") == 0
    names = {f"figure_4{x}_smoke.{k}" for x in "ab" for k in ("png", "pdf")}
    names |= {"aggregate_dqn_smoke.csv", "claims_smoke.md", "report_smoke.html"}
    assert {p.name for p in (tmp_path / "figures").iterdir()} == names
    err = capsys.readouterr().err
    assert "skipped" not in err and ("no runs of" in err) == (methods != SEVEN)


def test_curves_are_the_means_of_the_records(tmp_path):
    """Each method's line covers its target rows only, at steps of all stages."""
    write(tmp_path)
    with style.sheet():
        left, right = figure_4a(load_runs(tmp_path, "smoke")).axes
    lines = {x.get_color(): x for x in left.lines if x.get_linewidth() > 1.5}
    tables = [pd.read_csv(p) for p in csv(tmp_path, "C-DQN", 0).parent.glob("*.csv")]
    target = tables[0]["stage"] == 2
    line = lines[style.colour("C-DQN")]
    assert line.get_xdata().tolist() == tables[0]["step"][target].tolist()
    mean = sum(tables) / len(tables)
    assert line.get_ydata() == pytest.approx(mean["return"][target].to_numpy())
    assert len(lines) == len(SEVEN)
    dotted = [float(x.get_xdata()[0]) for x in left.lines if x.get_linestyle() == ":"]
    assert sorted(dotted) == [2000, 10500]
    assert {t.get_text() for t in left.texts} >= {"LSPI → target", "DQN on LQ → target"}
    lq = {line.get_color(): line for line in right.lines}[style.colour("C-DQN")]
    expected = mean["discounted_return"][~target].to_numpy()
    assert lq.get_ydata() == pytest.approx(expected)


def test_pretraining_is_of_the_variant_with_most_seeds(tmp_path):
    write(tmp_path, ("BC-DQN", "C-DQN"), range(2))
    write(tmp_path, ("RPL",), range(4))
    methods = load_runs(tmp_path, "smoke").compared("linear_system", None, "DQN")
    found = pretraining(methods)
    assert {k: v.method for k, v in found.items()} == {"lspi": "RPL", "dqn": "C-DQN"}


def test_shown_priors(tmp_path):
    """LSPI's seed 0 and DQN's seed 10, or the lowest there is."""
    write(tmp_path, ("C-DQN",), range(3, 12))
    write(tmp_path, ("BC-DQN",), range(3, 5))
    with style.sheet():
        titles = [a.get_title() for a in figure_4b(load_runs(tmp_path, "smoke")).axes]
    assert titles[0].endswith("seed 3") and titles[1].endswith("seed 10")
    variant = load_runs(tmp_path, "smoke").variants[0]
    *_, value, force = prior(variant, 3)
    assert value.shape == (41, 41)
    assert value[20, 20] == value.max()
    assert force[40, 20].tolist() == [-1.0, 0.0]  # x-major: far right, pulled left
    assert force[20, 0].tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q_stages": np.zeros((2, 5, 8))}, "q_stages of shape (2, 5, 8)"),
        ({"states": PLANE[::-1]}, "no grid"),
        ({"goal": np.zeros(2)}, "(2,)"),
        ({"drift": None}, "drift"),
    ],
)
def test_bad_arrays_are_rejected(tmp_path, change, message):
    write(tmp_path, ("C-DQN",), range(1))
    stored = arrays("C-DQN") | change
    path = csv(tmp_path, "C-DQN", 0).with_suffix(".npz")
    changed = io.BytesIO()
    np.savez(changed, **{k: v for k, v in stored.items() if v is not None})
    rerecord(path, changed.getvalue())
    with pytest.raises(BcrlError, match=r"seed_0000\.npz ") as rejected, style.sheet():
        figure_4b(load_runs(tmp_path, "smoke"))
    assert message in str(rejected.value)


# --- tags


@pytest.mark.slow
def test_untagged_runs_stand_in(tmp_path, capsys):
    """`--tag released` compares the released BC-DQN with the one and only DQN."""
    write(tmp_path, seeds=range(4))
    boosted = ("BC-DQN", "SC-DQN", "SBC-DQN")
    write(tmp_path, boosted, range(3), "@released", shift=7.0)
    assert run(tmp_path, "--tag", "released", "--figures", "4a") == 0
    assert "figure_4a_smoke@released.png" in capsys.readouterr().out
    runs = load_runs(tmp_path, "smoke")
    methods = runs.compared("linear_system", "released", "DQN")
    assert [v.name for v in methods.values()] == [
        name + "@released" * (name in boosted) for name in SEVEN
    ]
    with style.sheet():
        footer = figure_4a(runs, "released").get_supxlabel()
    assert "@released: BC-, SC-, SBC-DQN" in footer and "seeds differ" in footer
    document = (tmp_path / "figures" / "claims_smoke@released.md").read_text()
    assert "@released: BC-, SC-, SBC-DQN; the others are untagged." in document
    assert "| BC-DQN@released | 3 |" in document
    assert run(tmp_path, "--tag", "nowhere", "--figures", "4a") == 0
    assert "linear_system/*@nowhere" in capsys.readouterr().err


# --- claims


def test_claims(tmp_path):
    write(tmp_path, scatter=0.5)
    found = verdicts_of(claims_report(load_runs(tmp_path, "smoke")), "Linear")
    assert len(found) == 8
    assert set(found.values()) == {"holds"}
    write(tmp_path, ("BC-DQN",), scatter=0.5, shift=-60.0)
    write(tmp_path, ("RPL",), scatter=0.5, shift=60.0)
    found = verdicts_of(claims_report(load_runs(tmp_path, "smoke")), "Linear")
    assert found["BC-DQN ends better than C-DQN"] == "does not hold"
    assert found["RPL does not improve on DQN"] == "does not hold"
    assert found["PPR does not improve on DQN"] == "holds"


def test_late_returns_recomputed(tmp_path):
    """The last 5000 steps: evaluations at 36 000, …, 40 000; C-DQN's at 36 500, …."""
    write(tmp_path, ("DQN", "C-DQN"))
    methods = load_runs(tmp_path, "smoke").methods("linear_system", None, "DQN")
    for name, variant in methods.items():
        table = pd.read_csv(csv(tmp_path, name, 4))
        expected = table["return"][-5:].mean()
        assert variant.late("return")[4] == pytest.approx(expected)
        target = table["return"][table["task"] == 2]
        assert variant.area("return")[4] == pytest.approx(target.mean())


# --- searches


def test_variants_of_a_method_are_compared(tmp_path):
    """Three target-update frequencies of BC-DQN, the second the best, and a DQN."""
    for update, shift in ((200, 0.0), (2000, 9.0), ([25, 4000], -9.0)):
        tag = "" if update == 200 else f"@f{str(update)[-5:-1]}"
        config = {"algorithm": {"target_update": update, "batch": 32}, "tag": tag}
        config |= {"workers": shift, "device": str(shift)}
        made = {"config": config, "shift": shift, "scatter": 1}
        write(tmp_path, ("BC-DQN",), range(1000, 1005), tag, **made)
    write(tmp_path, ("DQN",), range(1))
    runs = load_runs(tmp_path, "smoke")
    table = sweep_table(runs)
    assert set(table["method"]) == {"BC-DQN"}
    best = table[table["best"]]
    assert best[["variant", "settings"]].to_numpy().tolist() == [
        ["BC-DQN@f200", '{"algorithm.target_update": "2000"}']
    ]
    text = "".join(map(str, sweep_sections(table)))
    assert "3 variants. Seeds 1000–1004." in text
    assert "Best: BC-DQN@f200 (algorithm.target_update = 2000)." in text
    (bold,) = (line for line in text.splitlines() if "**−" in line)
    assert bold.startswith("| BC-DQN@f200 | 2000 | 1000–1004 · 5 | **−")
    assert f"**{number(best['late_return'].item())} [" in bold


def test_variants_of_fqi_and_failed_seeds(tmp_path):
    for tag, trees, value in (("", 50, -5.0), ("@trees100", 100, -3.0)):
        config = {"algorithm": {"regressor": {"trees": trees}}}
        seeds = range(3 if tag else 2)
        plan = made_up_plan(
            tmp_path, "linear_system", f"FQI{tag}", seeds, "smoke", config
        )
        rows = {"stage": 1, "task": 1, "iteration": [1, 2], "return": [-9.0, value]}
        write_seeds(plan, lambda seed, rows=rows: pd.DataFrame(rows))
    path = tmp_path / "smoke/linear_system/FQI@trees100/seed_0002.json"
    reseal(path, status="failed: non-finite weights at step 3")
    assert run(tmp_path, "--allow-incomplete", "--figures", "1") == 0
    text = (tmp_path / "figures/sweep_smoke.md").read_text()
    table = pd.read_csv(tmp_path / "figures/sweep_smoke.csv").set_index("variant")
    assert table["last_return"].to_dict() == {"FQI": -5.0, "FQI@trees100": -3.0}
    assert table["late_return"].isna().all() and table["best"].tolist() == [False, True]
    returns = "– | **−3.000 [−3.000, −3.000]** | – |"
    assert f"| FQI@trees100 | 100 | 0–1 · 2 (1 failed) | {returns}" in text
