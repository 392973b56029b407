"""The report of the DQN family, on made-up runs of the linear system."""

import numpy as np
import pandas as pd
import pytest

from bcrl.common.text import number
from bcrl.errors import BcrlError
from bcrl.report.figures import style
from bcrl.report.figures.linear import figure_4a, figure_4b, pretraining, prior
from bcrl.report.load import load_runs
from bcrl.report.tables import sweep_sections, sweep_table
from tests.report.runs import SEVEN, claims_of, csv_of, report, verdicts_of, write_dqn
from tests.results.made_up import edit_csv, made_up_plan, reseal, write_seeds


def test_runs_are_read_without_a_note(tmp_path):
    """nan losses are no oddity; different lengths and starts are meant."""
    write_dqn(tmp_path)
    edit_csv(csv_of(tmp_path, "DQN", 1), lambda t: t.assign(q_mean=np.nan))
    runs = load_runs(tmp_path, "smoke")
    assert runs.notes == []
    methods = runs.methods("linear_system", None, "DQN")
    assert tuple(methods) == SEVEN
    assert methods["C-DQN"].metrics["loss"].shape == (6, 52)


def test_failed_seeds_are_left_out_by_name(tmp_path):
    write_dqn(tmp_path, ("DQN", "C-DQN", "S-DQN"))
    failed = "failed: non-finite weights at step 12000"
    reseal(csv_of(tmp_path, "DQN", 2).with_suffix(".json"), status=failed)
    reseal(csv_of(tmp_path, "S-DQN", 1).with_suffix(".json"), status="running")
    with pytest.raises(BcrlError, match=f'seed_0002.json says "{failed}"'):
        load_runs(tmp_path, "smoke")
    runs = load_runs(tmp_path, "smoke", allow_incomplete=True)
    variant = runs.methods("linear_system", None, "DQN")["DQN"]
    assert (variant.seeds, variant.failed) == ((0, 1, 3, 4, 5), (2,))
    document = claims_of(runs)
    assert "| DQN | 5 (1 failed) |" in document
    assert "S-DQN 5 of 6 seeds" in document
    footer = figure_4a(runs).get_supxlabel()
    assert "INCOMPLETE: DQN 5 of 6 seeds (1 failed)" in footer
    assert "S-DQN 5" not in footer  # which figure 4 does not compare


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t: t.assign(greedy_return=np.inf), "greedy_return in row"),
        (lambda t: t.assign(step=t["step"][::-1].to_numpy()), "fall"),
        (lambda t: t.assign(step=t["step"] + 0.5), "whole number"),
    ],
)
def test_bad_tables_are_rejected(tmp_path, edit, message):
    write_dqn(tmp_path, ("DQN",), range(4))
    edit_csv(csv_of(tmp_path, "DQN", 3), edit)
    with pytest.raises(BcrlError, match=r"seed_0003\.csv ") as rejected:
        load_runs(tmp_path, "smoke")
    assert message in str(rejected.value)


@pytest.mark.parametrize(
    "methods", [("C-DQN", "S-DQN"), pytest.param(SEVEN, marks=pytest.mark.slow)]
)
def test_both_figures_are_drawn(tmp_path, capsys, methods):
    write_dqn(tmp_path, methods, range(2))
    assert report(tmp_path, "--figures", "4a", "4b") == 0
    names = {f"figure_4{x}_smoke.{k}" for x in "ab" for k in ("png", "pdf")}
    names |= {"aggregate_dqn_smoke.csv", "finals_dqn_smoke.csv"}
    names |= {"claims_smoke.md", "report_smoke.html"}
    assert {p.name for p in (tmp_path / "figures").iterdir()} == names
    err = capsys.readouterr().err
    assert "skipped" not in err and ("no runs of" in err) == (methods != SEVEN)


def test_curves_are_the_means_of_the_records(tmp_path):
    """Each method's line covers its target rows only, at steps of all stages."""
    write_dqn(tmp_path)
    left, right = figure_4a(load_runs(tmp_path, "smoke")).axes
    lines = {x.get_color(): x for x in left.lines if x.get_linewidth() > 1.2}
    paths = csv_of(tmp_path, "C-DQN", 0).parent.glob("*.csv")
    tables = [pd.read_csv(path) for path in paths]
    target = tables[0]["stage"] == 2
    line = lines[style.colour("C-DQN")]
    assert line.get_xdata().tolist() == tables[0]["step"][target].tolist()
    mean = sum(tables) / len(tables)
    assert line.get_ydata() == pytest.approx(mean["return"][target].to_numpy())
    assert len(lines) == len(SEVEN)  # no two have the same colour
    dotted = [float(x.get_xdata()[0]) for x in left.lines if x.get_linestyle() == ":"]
    assert sorted(dotted) == [2000, 10500]
    assert {t.get_text() for t in left.texts} >= {"LSPI → target", "DQN on LQ → target"}
    lq = {line.get_color(): line for line in right.lines}[style.colour("C-DQN")]
    expected = mean["discounted_return"][~target].to_numpy()
    assert lq.get_ydata() == pytest.approx(expected)


def test_shown_pretraining_and_priors(tmp_path):
    """Of the variant with most seeds: LSPI's seed 0 and DQN's seed 10, or the lowest"""
    write_dqn(tmp_path, ("C-DQN",), range(3, 12))
    write_dqn(tmp_path, ("BC-DQN",), range(3, 5))
    write_dqn(tmp_path, ("RPL",), range(3, 8))
    runs = load_runs(tmp_path, "smoke")
    found = pretraining(runs.compared("linear_system", None, "DQN"))
    assert {k: v.method for k, v in found.items()} == {"lspi": "RPL", "dqn": "C-DQN"}
    titles = [axes.get_title() for axes in figure_4b(runs).axes]
    assert titles[0].endswith("seed 3") and titles[1].endswith("seed 10")
    *_, value, force = prior(found["lspi"], 3)
    assert value.shape == (41, 41)
    assert value[20, 20] == value.max()
    assert force[40, 20].tolist() == [-1.0, 0.0]  # x-major: far right, pulled left
    assert force[20, 0].tolist() == [0.0, 1.0]


@pytest.mark.slow
def test_untagged_runs_stand_in(tmp_path, capsys):
    """`--tag released` compares the released BC-DQN with the one and only DQN."""
    write_dqn(tmp_path, seeds=range(4))
    boosted = ("BC-DQN", "SC-DQN", "SBC-DQN")
    write_dqn(tmp_path, boosted, range(3), "@released", shift=7.0)
    assert report(tmp_path, "--tag", "released", "--figures", "4a") == 0
    assert "figure_4a_smoke@released.png" in capsys.readouterr().out
    runs = load_runs(tmp_path, "smoke")
    footer = figure_4a(runs, "released").get_supxlabel()
    shown = "@released: BC-DQN, SC-DQN, SBC-DQN"
    assert shown in footer and "seeds differ" in footer
    document = (tmp_path / "figures" / "claims_smoke@released.md").read_text()
    assert f"{shown}; the others are untagged." in document
    assert "| BC-DQN@released | 3 |" in document


def test_claims(tmp_path):
    write_dqn(tmp_path, scatter=0.5)
    found = verdicts_of(claims_of(load_runs(tmp_path, "smoke")), "Linear")
    assert len(found) == 8
    assert set(found.values()) == {"holds"}
    write_dqn(tmp_path, ("BC-DQN",), scatter=0.5, shift=-60.0)
    write_dqn(tmp_path, ("RPL",), scatter=0.5, shift=60.0)
    found = verdicts_of(claims_of(load_runs(tmp_path, "smoke")), "Linear")
    assert found["BC-DQN ends better than C-DQN"] == "does not hold"
    assert found["RPL does not improve on DQN"] == "does not hold"
    assert found["PPR does not improve on DQN"] == "holds"


def test_late_returns_recomputed(tmp_path):
    """The last 5000 steps: evaluations at 36 000, …, 40 000; C-DQN's at 36 500, …."""
    write_dqn(tmp_path, ("DQN", "C-DQN"))
    methods = load_runs(tmp_path, "smoke").methods("linear_system", None, "DQN")
    for name, variant in methods.items():
        table = pd.read_csv(csv_of(tmp_path, name, 4))
        assert variant.late("return")[4] == pytest.approx(table["return"][-5:].mean())
        target = table["return"][table["task"] == 2]
        assert variant.area("return")[4] == pytest.approx(target.mean())


def test_variants_of_a_method_are_compared(tmp_path):
    """Three target-update frequencies of BC-DQN, the second the best, and a DQN."""
    for update, shift in ((200, 0.0), (2000, 9.0), ([25, 4000], -9.0)):
        tag = "" if update == 200 else f"@f{str(update)[-5:-1]}"
        config = {"algorithm": {"target_update": update, "batch": 32}, "tag": tag}
        config |= {"workers": shift, "device": str(shift)}
        made = {"config": config, "shift": shift, "scatter": 1}
        write_dqn(tmp_path, ("BC-DQN",), range(1000, 1005), tag, **made)
    write_dqn(tmp_path, ("DQN",), range(1))
    table = sweep_table(load_runs(tmp_path, "smoke"))
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
        seeds, name = range(3 if tag else 2), f"FQI{tag}"
        plan = made_up_plan(tmp_path, "linear_system", name, seeds, config=config)
        rows = {"stage": 1, "task": 1, "iteration": [1, 2], "return": [-9.0, value]}
        write_seeds(plan, lambda seed, rows=rows: pd.DataFrame(rows))
    path = csv_of(tmp_path, "FQI@trees100", 2).with_suffix(".json")
    reseal(path, status="failed: non-finite weights at step 3")
    assert report(tmp_path, "--allow-incomplete", "--figures", "1") == 0
    text = (tmp_path / "figures/sweep_smoke.md").read_text()
    table = pd.read_csv(tmp_path / "figures/sweep_smoke.csv").set_index("variant")
    assert table["last_return"].to_dict() == {"FQI": -5.0, "FQI@trees100": -3.0}
    assert table["late_return"].isna().all() and table["best"].tolist() == [False, True]
    assert f"- {path.parent}: INCOMPLETE, 2 of 3 seeds drawn: seed_0002.json" in text
    returns = "– | **−3.000 [−3.000, −3.000]** | – |"
    assert f"| FQI@trees100 | 100 | 0–1 · 2 (1 failed) | {returns}" in text
