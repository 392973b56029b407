"""The report of the DQN family, on made-up runs of the linear system."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bcrl.errors import BcrlError
from bcrl.report import cli
from bcrl.report import late as curves
from bcrl.report.claims.document import claims_report
from bcrl.report.figures import style
from bcrl.report.figures.linear import figure_4a, figure_4b, prior
from bcrl.report.load import load_runs
from bcrl.report.notes import tags_shown
from bcrl.report.sweeps import groups, sweep_report, sweep_table
from bcrl.report.variants import COMPARED
from bcrl.results.layout import DQN_METRICS
from bcrl.results.layout import FQI_METRICS as METRICS
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
    return runs_dir / "smoke" / "linear_system" / folder / f"seed_{seed:04d}.csv"


def verdicts_of(document: str) -> dict[str, str]:
    part = document.split("## Linear system")[1].split("All returns")[0]
    lines = [line.strip("| ") for line in part.splitlines() if line.startswith("| ")]
    rows = [line.split(" | ") for line in lines[1:]]
    return {cells[0]: cells[-1] for cells in rows}


# --- reading


def test_runs_are_read_without_a_note(tmp_path):
    """nan losses are no oddity; different lengths and starts are meant."""
    write(tmp_path)
    runs = load_runs(tmp_path, "smoke")
    assert runs.notes == []
    methods = runs.methods("linear_system", None, "DQN")
    assert tuple(methods) == SEVEN
    assert methods["C-DQN"].index[[0, -1]].tolist() == [500, 40500]
    assert methods["C-DQN"].metrics["loss"].shape == (6, 52)
    assert runs.methods("linear_system", None) == {}


def test_families_stand_side_by_side(tmp_path):
    write(tmp_path, ("DQN",), env="maze")
    row = dict.fromkeys(("stage", "task", "iteration", *METRICS["maze"]), 1)
    plan = made_up_plan(tmp_path, "maze", "FQI", range(1))
    write_seeds(plan, lambda seed: pd.DataFrame([row]))
    runs = load_runs(tmp_path, "smoke")
    assert list(runs.methods("maze", None)) == ["FQI"]
    assert list(runs.methods("maze", None, "DQN")) == ["DQN"]
    assert run(tmp_path, "--figures", "4a") == 0
    fqi, dqn = (
        pd.read_csv(tmp_path / "figures" / f"aggregate{name}_smoke.csv")
        for name in ("", "_dqn")
    )
    assert set(fqi["variant"]) == {"FQI"}
    assert set(dqn["variant"]) == {"DQN"}
    assert "iteration" in fqi
    assert "step" not in fqi


def test_failed_seeds_are_left_out_by_name(tmp_path):
    write(tmp_path, ("DQN", "C-DQN"))
    failed = "failed: non-finite weights at step 12000"
    reseal(csv(tmp_path, "DQN", 2).with_suffix(".json"), status=failed)
    with pytest.raises(BcrlError, match=f'seed_0002.json says "{failed}"'):
        load_runs(tmp_path, "smoke")
    runs = load_runs(tmp_path, "smoke", allow_incomplete=True)
    assert f'seed_0002.json says "{failed}"' in runs.notes[0].text
    variant = runs.methods("linear_system", None, "DQN")["DQN"]
    assert variant.seeds == (0, 1, 3, 4, 5)
    assert variant.failed == (2,)
    assert "| DQN | 5 (1 failed) |" in claims_report(runs)
    with style.sheet():
        footer = figure_4a(runs).get_supxlabel()
    assert "INCOMPLETE: DQN 5 of 6 seeds (1 failed)" in footer


def test_methods_outside_the_figure_are_not_its_concern(tmp_path):
    write(tmp_path, ("DQN", "C-DQN", "S-DQN"), range(2))
    reseal(csv(tmp_path, "S-DQN", 1).with_suffix(".json"), status="running")
    runs = load_runs(tmp_path, "smoke", allow_incomplete=True)
    with style.sheet():
        assert "INCOMPLETE" not in figure_4a(runs).get_supxlabel()
    assert "INCOMPLETE: S-DQN 1 of 2 seeds" in claims_report(runs)


def test_nothing_to_average_is_no_fault(tmp_path):
    write(tmp_path, ("DQN",))
    edit_csv(csv(tmp_path, "DQN", 1), lambda t: t.assign(q_mean=np.nan))
    assert load_runs(tmp_path, "smoke").variants[0].seeds == tuple(range(6))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t: t.assign(step=t["step"] * 2), "in its step column"),
        (lambda t: t[:30], "in its length (30 rows, not 41)"),
        (lambda t: t.assign(greedy_return=np.inf), "a non-finite greedy_return in row"),
        (lambda t: t.assign(step=t["step"][::-1].to_numpy()), "or fall"),
        (lambda t: t.assign(step=t["step"] + 0.5), "not whole numbers"),
        (lambda t: t.assign(step=t["step"] - 1000), "not whole numbers"),
        (
            lambda t: t.assign(step=range(1, 42)).rename(columns={"step": "iteration"}),
            "has the header stage,task,iteration",
        ),
    ],
)
def test_bad_tables_are_refused(tmp_path, capsys, edit, message):
    write(tmp_path, ("DQN",))
    edit_csv(csv(tmp_path, "DQN", 3), edit)
    assert run(tmp_path) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "seed_0003.* and run the same command again" in err


def test_absent_methods_are_named(tmp_path, capsys):
    write(tmp_path, ("DQN", "SBC-DQN"))
    assert run(tmp_path, "--figures", "4a") == 0
    expected = "no runs of C-DQN, BC-DQN, SC-DQN, RPL and PPR"
    assert expected in capsys.readouterr().err


# --- figure 4


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("methods", [SEVEN, ("DQN",), ("C-DQN", "S-DQN"), ("RPL",)])
def test_both_figures_are_drawn(tmp_path, capsys, seeds, methods):
    write(tmp_path, methods, range(seeds))
    assert run(tmp_path, "--figures", "4a", "4b") == 0
    names = {f"figure_4{x}_smoke.{k}" for x in "ab" for k in ("png", "pdf")}
    names |= {"aggregate_dqn_smoke.csv", "claims_smoke.md", "report_smoke.html"}
    assert {p.name for p in (tmp_path / "figures").iterdir()} == names
    assert "skipped" not in capsys.readouterr().err


def test_curves_are_the_means_of_the_records(tmp_path):
    """Each method's line covers its target rows only, at steps of all stages."""
    write(tmp_path)
    with style.sheet():
        left, right = figure_4a(load_runs(tmp_path, "smoke")).axes
    lines = {
        line.get_color(): line for line in left.lines if line.get_linewidth() > 1.5
    }
    tables = [pd.read_csv(p) for p in csv(tmp_path, "C-DQN", 0).parent.glob("*.csv")]
    target = tables[0]["stage"] == 2
    line = lines[style.colour("C-DQN")]
    assert line.get_xdata().tolist() == tables[0]["step"][target].tolist()
    mean = sum(t["return"] for t in tables) / len(tables)
    assert line.get_ydata() == pytest.approx(mean[target].to_numpy())
    assert len(lines) == len(SEVEN)
    dotted = [float(x.get_xdata()[0]) for x in left.lines if x.get_linestyle() == ":"]
    assert sorted(dotted) == [2000, 10500]
    assert {t.get_text() for t in left.texts} >= {"LSPI → target", "DQN on LQ → target"}
    mean = sum(t["discounted_return"] for t in tables) / len(tables)
    lq = {line.get_color(): line for line in right.lines}[style.colour("C-DQN")]
    assert lq.get_ydata() == pytest.approx(mean[~target].to_numpy())
    assert left.get_ylabel() == "return in the target task (undiscounted)"


def test_pretraining_is_of_the_variant_with_most_seeds(tmp_path):
    write(tmp_path, ("BC-DQN", "C-DQN"), range(2))
    write(tmp_path, ("RPL",), range(4))
    found = curves.pretraining(
        curves.figure_methods(load_runs(tmp_path, "smoke"), None)
    )
    assert {k: v.method for k, v in found.items()} == {"lspi": "RPL", "dqn": "C-DQN"}


def test_shown_priors(tmp_path):
    """LSPI's seed 0 and DQN's seed 10, or the lowest there is."""
    write(tmp_path, ("C-DQN",), range(3, 12))
    write(tmp_path, ("BC-DQN",), range(3, 5))
    with style.sheet():
        titles = [a.get_title() for a in figure_4b(load_runs(tmp_path, "smoke")).axes]
    assert titles[0].endswith("seed 3")
    assert titles[1].endswith("seed 10")
    variant = load_runs(tmp_path, "smoke").variants[0]
    *_, value, force = prior(variant, 3)
    assert value.shape == (41, 41)
    assert value[20, 20] == value.max()
    assert force[40, 20].tolist() == [-1.0, 0.0]  # x-major: far right, pulled left
    assert force[20, 0].tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q_stages": np.zeros((2, 5, 8))}, "has a q_stages of shape (2, 5, 8)"),
        ({"states": PLANE[::-1]}, "no grid"),
        ({"goal": np.zeros(2)}, "describes its target in shapes"),
        ({"drift": None}, "does not hold what is needed"),
    ],
)
def test_bad_arrays_are_refused(tmp_path, capsys, change, message):
    write(tmp_path, ("C-DQN",), range(1))
    stored = arrays("C-DQN") | change
    path = csv(tmp_path, "C-DQN", 0).with_suffix(".npz")
    changed = io.BytesIO()
    np.savez(changed, **{k: v for k, v in stored.items() if v is not None})
    rerecord(path, changed.getvalue())
    assert run(tmp_path, "--figures", "4b") == 2
    assert message in capsys.readouterr().err


def test_without_runs_the_experiment_is_named(tmp_path, capsys):
    assert run(tmp_path, "--figures", "4a") == 2
    assert "experiment=fig4 those of figure 4" in capsys.readouterr().err
    write(tmp_path, ("DQN",), env="maze")
    assert run(tmp_path) == 0
    err = capsys.readouterr().err
    assert err.count("`bcrl experiment=fig4 scale=smoke` makes them") == 2


# --- tags


def test_untagged_runs_stand_in(tmp_path, capsys):
    """`--tag released` compares the released BC-DQN with the one and only DQN."""
    write(tmp_path)
    boosted = ("BC-DQN", "SC-DQN", "SBC-DQN")
    write(tmp_path, boosted, range(3), "@released", shift=7.0)
    assert run(tmp_path, "--tag", "released", "--figures", "4a", "4b") == 0
    assert "figure_4a_smoke@released.png" in capsys.readouterr().out
    runs = load_runs(tmp_path, "smoke")
    methods = curves.figure_methods(runs, "released")
    assert [v.name for v in methods.values()] == [
        name + "@released" * (name in boosted) for name in SEVEN
    ]
    assert tags_shown(methods) == "@released: BC-, SC-, SBC-DQN"
    with style.sheet():
        figure = figure_4a(runs, "released")
    assert "@released: BC-, SC-, SBC-DQN" in figure.get_supxlabel()
    assert "seeds differ" in figure.get_supxlabel()
    document = (tmp_path / "figures" / "claims_smoke@released.md").read_text()
    assert "@released: BC-, SC-, SBC-DQN; the others are untagged." in document
    assert "| BC-DQN@released | 3 |" in document
    assert run(tmp_path, "--tag", "nowhere", "--figures", "4a") == 0
    assert "no runs of linear_system/*@nowhere" in capsys.readouterr().err


# --- claims


def test_claims(tmp_path):
    write(tmp_path, scatter=0.5)
    found = verdicts_of(claims_report(load_runs(tmp_path, "smoke")))
    assert len(found) == 8
    assert set(found.values()) == {"holds"}
    write(tmp_path, ("BC-DQN",), scatter=0.5, shift=-60.0)
    write(tmp_path, ("RPL",), scatter=0.5, shift=60.0)
    found = verdicts_of(claims_report(load_runs(tmp_path, "smoke")))
    assert found["BC-DQN ends better than C-DQN"] == "does not hold"
    assert found["RPL does not improve on DQN"] == "does not hold"
    assert found["PPR does not improve on DQN"] == "holds"
    write(tmp_path / "few", ("DQN", "RPL"), range(2))
    found = verdicts_of(claims_report(load_runs(tmp_path / "few", "smoke")))
    assert found["BC-DQN ends better than DQN"] == "no runs of BC-DQN"
    assert found["RPL does not improve on DQN"] == "undecided (fewer than 5 seeds)"


def test_late_returns_recomputed(tmp_path):
    """The last 5000 steps: evaluations at 36 000, …, 40 000; C-DQN's at 36 500, …."""
    write(tmp_path, ("DQN", "C-DQN"))
    methods = curves.linear_methods(load_runs(tmp_path, "smoke"), None)
    for name, variant in methods.items():
        table = pd.read_csv(csv(tmp_path, name, 4))
        assert len(curves.late_rows(variant)) == 5
        expected = table["return"][-5:].mean()
        assert curves.late(variant, "return")[4] == pytest.approx(expected)
        target = table["return"][table["task"] == 2]
        assert curves.area(variant, "return")[4] == pytest.approx(target.mean())


# --- searches


def search(tmp_path: Path) -> None:
    """Three target-update frequencies of BC-DQN, the second the best, and an FQI."""
    for update, shift in ((200, 0.0), (2000, 9.0), ([25, 4000], -9.0)):
        tag = "" if update == 200 else f"@f{str(update)[-5:-1]}"
        config = {"algorithm": {"target_update": update, "batch": 32}, "tag": tag}
        config |= {"workers": shift, "device": str(shift)}
        seeds = range(1000, 1005)
        write(tmp_path, ("BC-DQN",), seeds, tag, config=config, shift=shift, scatter=1)


def test_sweeps(tmp_path, capsys):
    search(tmp_path)
    write(tmp_path, ("DQN",))
    assert run(tmp_path, "--figures", "4a") == 0
    assert "sweep_smoke.md" in capsys.readouterr().out
    found = groups(load_runs(tmp_path, "smoke"))
    assert [(g.method, g.keys) for g in found] == [
        ("BC-DQN", ("algorithm.target_update",))
    ]
    assert found[0].best.name == "BC-DQN@f200"
    text = (tmp_path / "figures" / "sweep_smoke.md").read_text()
    best = re.search(r"## Best\n\n.*\n.*\n(.*)\n", text)[1]
    assert "BC-DQN@f200 | algorithm.target_update = 2000 |" in best
    assert "Seeds 1000–1004." in text
    bold = [line for line in text.splitlines() if "**−" in line]
    assert len(bold) == 1
    assert bold[0].startswith("| BC-DQN@f200 | 2000 | 1000–1004 · 5 | **−")
    table = pd.read_csv(tmp_path / "figures" / "sweep_smoke.csv")
    assert table["best"].sum() == 1
    assert len(table) == 3
    assert json.loads(table["settings"][0]) == {"algorithm.target_update": "200"}
    variant = found[0].best
    row = table.set_index("variant").loc["BC-DQN@f200"]
    assert row["late_return"] == pytest.approx(curves.late(variant, "return").mean())


def test_sweep_over_fqi_and_failed_seeds(tmp_path):
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
    runs = load_runs(tmp_path, "smoke", allow_incomplete=True)
    (group,) = groups(runs)
    text = sweep_report(runs, [group])
    returns = "– | **−3.000 [−3.000, −3.000]** | – |"
    row = f"| FQI@trees100 | 100 | 0–1 · 2 (1 failed) | {returns}"
    assert row in text
    assert 'seed_0002.json says "failed: non-finite weights at step 3"' in text
    assert sweep_table([group])["last_return"].tolist() == [-5.0, -3.0]


def test_no_sweep_without_a_second_variant(tmp_path):
    write(tmp_path, ("DQN",), range(1))
    assert groups(load_runs(tmp_path, "smoke")) == []
