"""The report of car on the hill and the maze, on made-up runs."""

import io
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from bcrl.errors import BcrlError
from bcrl.report.claims import EXPECTED, UNEXPECTED, verdict
from bcrl.report.figures import curves, style
from bcrl.report.figures.maze import figure_3, seed_mean_value
from bcrl.report.load import load_runs
from bcrl.report.tables import aggregate, finals
from bcrl.report.variants import METHODS, remarks
from bcrl.results import statistics as st
from bcrl.results.layout import FQI_METRICS, seed_path
from tests.report.runs import (
    as_claimed,
    claims_of,
    maze_arrays,
    report,
    the_opposite,
    verdicts_of,
    write_fqi,
)
from tests.results.made_up import made_up_plan, rerecord, reseal, write_seeds


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """Complete runs of both environments, not to be changed."""
    root = tmp_path_factory.mktemp("written") / "runs"
    for env in FQI_METRICS:
        write_fqi(root, env)
    return root


@pytest.fixture
def runs_dir(written, tmp_path: Path) -> Path:
    """A copy of them to be changed."""
    return shutil.copytree(written, tmp_path / "runs")


def test_standard_error():
    values = np.array([[1.0, 4.0], [3.0, 4.0]])
    assert st.standard_error(values) == pytest.approx([1.0, 0.0])
    assert np.isnan(st.standard_error(values[:1])).all()


def test_bootstrap_of_two_values_is_the_binomial():
    """Means of resamples of 0, 1 are 0, ½, 1 with ¼, ½, ¼: both ends are reached."""
    assert st.bootstrap([0.0, 1.0]) == (0.0, 1.0)
    # 0 and 1 in equal numbers, n = 100: the binomial's 2.5 and 97.5 % points
    found = st.bootstrap(np.repeat([0.0, 1.0], 50))
    expected = stats.binom.ppf([0.025, 0.975], 100, 0.5) / 100
    assert found == pytest.approx(expected, abs=0.0101)
    for values in ([1.0], [1.0, np.nan], []):
        assert np.isnan(st.bootstrap(values)).all()


def test_bootstrap_of_a_difference():
    """Resampling is independent: variances add, the interval is √2 times as wide."""
    values = np.random.default_rng(2).normal(size=50)
    low, high = st.bootstrap(values + 2, values)
    assert low < 2 < high
    ratio = (high - low) / np.ptp(st.bootstrap(values))
    assert ratio == pytest.approx(np.sqrt(2), rel=0.05)


def test_share_intervals():
    # Wilson 0 of n: [0, z² / (n + z²)]
    z2 = stats.norm.ppf(0.975) ** 2
    assert st.share_interval(0, 40) == pytest.approx((0, z2 / (40 + z2)))
    # Newcombe (1998), table II, example (a): 56/70 − 48/80
    interval = st.share_difference_interval(56, 70, 48, 80)
    assert interval == pytest.approx((0.0524, 0.3339), abs=1e-4)


def test_intervals_of_curves_are_those_of_means(monkeypatch):
    values = np.random.default_rng(0).normal(size=(8, 5))
    low, high = st.bootstrap_curves(values)
    each = [st.bootstrap(column) for column in values.T]
    np.testing.assert_allclose(np.transpose([low, high]), each)
    monkeypatch.setattr(st, "MOST_DRAWS", 8 * 777)  # blocks change no draw
    np.testing.assert_array_equal(st.bootstrap_curves(values), (low, high))
    values[3, 1] = np.nan
    gaps = np.isnan(st.bootstrap_curves(values))
    assert gaps.tolist() == [[False, True, False, False, False]] * 2


@pytest.mark.slow
def test_everything_is_written_listed_and_byte_identical(runs_dir, tmp_path, capsys):
    names = {f"figure_{n}_smoke.{k}" for n in "1235" for k in ("png", "pdf")}
    names |= {"aggregate_smoke.csv", "finals_smoke.csv"}
    names |= {"claims_smoke.md", "report_smoke.html"}
    for out in (tmp_path / "a", tmp_path / "b"):
        assert report(runs_dir, "--out", str(out)) == 0
        captured = capsys.readouterr()
        assert captured.err == ""  # not about figures that were not requested
        assert set(captured.out.split()) == {str(out / name) for name in names}
        assert {path.name for path in out.iterdir()} == names
    for name in names:
        first, second = ((tmp_path / d / name).read_bytes() for d in "ab")
        assert first == second


def test_task_labels_do_not_overlap(tmp_path):
    """At the paper's stage lengths, where the first four bands are very narrow."""
    lengths = {"maze": (10, 10, 10, 10, 20, 20, 50, 50, 50, 50)}
    write_fqi(tmp_path, "maze", seeds=2, methods=("BC-FQI",), lengths=lengths)
    runs, named = load_runs(tmp_path, "smoke"), {f"T{i}" for i in range(1, 11)}
    for width in (2.2, 7.0):
        figure = curves.figure_5(runs, width=width)
        figure.draw_without_rendering()
        (axes,) = figure.axes
        boxes = [text.get_window_extent() for text in axes.texts]
        shown = {text.get_text() for text in axes.texts}
        assert shown == named if width > 3 else {"T1", "T10"} < shown < named
        for i, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[:i])


def test_curves_and_aggregates_are_recomputed(written):
    """Figure 1's bold lines and a row of the table, from the CSVs."""
    runs = load_runs(written, "smoke")
    axes = curves.figure_1(runs).axes[0]
    bold = {line.get_color(): line for line in axes.lines if line.get_linewidth() > 1}
    paths = sorted((written / "smoke/car_on_hill/BC-FQI").glob("*.csv"))
    tables = np.stack([pd.read_csv(path)[["q_error", "return"]] for path in paths])
    line = bold[style.colour("BC-FQI")]
    assert line.get_xdata().tolist() == list(range(1, 10))
    assert line.get_ydata() == pytest.approx(tables.mean(axis=0)[:, 0])
    table = aggregate(runs)
    columns = "scale env variant stage task iteration metric seeds mean standard_error"
    assert list(table.columns) == columns.split()
    where = "env == 'car_on_hill' and variant == 'BC-FQI' and iteration == 7"
    row = table.query(f"{where} and metric == 'return'")
    assert row["mean"].item() == pytest.approx(tables[:, 6, 1].mean())
    expected = tables[:, 6, 1].std(ddof=1) / np.sqrt(6)
    assert row["standard_error"].item() == pytest.approx(expected)
    assert row[["stage", "task", "seeds"]].to_numpy().tolist() == [[3, 3, 6]]
    ends = finals(runs).query("env == 'car_on_hill' and variant == 'BC-FQI'")
    assert ends["seed"].tolist() == list(range(6))
    assert ends["return"].to_numpy() == pytest.approx(tables[:, -1, 1])


def test_values_are_of_the_seed_mean(runs_dir):
    """max_a of the mean, not the mean of max_a, and x-major states seen as x, y."""
    variant = load_runs(runs_dir, "smoke").methods("maze", None)["FQI"]
    x, y, value = seed_mean_value(variant)
    assert value.shape == (21, 21)
    assert value[3, 20] == pytest.approx((x[3] + y[20]) * 20 - 60 + np.mean(range(6)))
    for seed in range(6):  # every seed prefers another action, by as much
        q = np.tile([1 - seed % 2, seed % 2, 0, 0], (441, 1))
        path = seed_path(variant.folder, seed, "npz")
        np.savez(path, **(maze_arrays(seed) | {"q": q}))
    assert seed_mean_value(variant)[2] == pytest.approx(0.5)


def test_figure_3_with_fewer_methods(tmp_path):
    write_fqi(tmp_path, "maze", methods=("FQI", "BC-FQI"), seeds=2)
    figure = figure_3(load_runs(tmp_path, "smoke"))
    titles = [a.get_title() for a in figure.axes if a.get_title()]
    assert titles[:4] == ["T1", "T4", "T7", "T10"]
    assert titles[-4:] == ["FQI: 0/2", *METHODS[1:3], "BC-FQI: 2/2"]


def test_tagged_variants_are_drawn_on_request(tmp_path, capsys):
    write_fqi(tmp_path, "maze", methods=("FQI", "BC-FQI"))
    write_fqi(tmp_path, "maze", methods=("BC-FQI",), tag="@released", seeds=3)
    assert report(tmp_path, "--figures", "1", "2", "--tag", "released") == 0
    captured = capsys.readouterr()
    assert "figure_2_smoke@released.png" in captured.out
    assert "experiment=fig1_released" in captured.err  # which makes what figure 1 lacks
    table = pd.read_csv(tmp_path / "figures" / "aggregate_smoke.csv")
    assert set(table["variant"]) == {"FQI", "BC-FQI", "BC-FQI@released"}


@pytest.mark.parametrize("curves", [as_claimed, the_opposite])
def test_true_claims_hold_and_false_ones_do_not(tmp_path, curves):
    for env in FQI_METRICS:
        write_fqi(tmp_path, env, curves=curves)
    document = claims_of(load_runs(tmp_path, "smoke"))
    car, maze = (verdicts_of(document, section) for section in ("Car", "Maze"))
    assert (len(car), len(maze)) == (12, 17)
    if curves is as_claimed:
        assert {*car.values(), *maze.values()} == {"holds"}
        return
    assert maze["BC-FQI ends with a larger return than FQI"] == "does not hold"
    assert maze["FQI never solves the target"] == "does not hold"
    assert maze["BC-FQI's residual at s0 shrinks from T1 to T6"] == "does not hold"
    assert maze["most seeds of BC-FQI end at the optimum"] == "does not hold"
    assert car["C-FQI's error rises on the target task"] == "does not hold"


#: An interval, what is expected of the value, and the verdict.
VERDICTS = [(-1.0, 1.0, "< 0", "undecided"), (-1.0, 0.0, "≤ 0", "holds")]
VERDICTS += [(0.0, 1.0, "< 0", "does not hold"), (0.4, 0.9, "> ½", "undecided")]


@pytest.mark.parametrize(("low", "high", "expect", "expected"), VERDICTS)
def test_verdicts(low, high, expect, expected):
    value = (low + high) / 2
    assert verdict(value, (low, high), expect, seeds=5) == expected


@pytest.mark.parametrize(
    ("value", "expect", "expected"),
    [
        *((-0.1, "< 0", EXPECTED), (0.0, "< 0", UNEXPECTED), (0.1, "< 0", UNEXPECTED)),
        *((0.0, "= 0", EXPECTED), (0.2, "= 0", UNEXPECTED)),
        *((0.0, "≤ 0", EXPECTED), (0.1, "≤ 0", UNEXPECTED), (0.1, "> 0", EXPECTED)),
        *((0.6, "> ½", EXPECTED), (0.5, "> ½", UNEXPECTED)),
        (np.nan, "> 0", "undecided (non-finite values)"),
    ],
)
def test_few_seeds_only_point_somewhere(value, expect, expected):
    """However narrow the interval is: there is no verdict."""
    for interval in ((value, value), (np.nan, np.nan), (-9.0, 9.0)):
        assert verdict(value, interval, expect, seeds=4) == expected


def test_a_diverging_method_is_named_and_cut_off(tmp_path):
    def far(env, method, seed, stage):
        curves = as_claimed(env, method, seed, stage)
        if method == "B-FQI":
            curves["q_error"] *= 1000.0 ** (stage - 1)
        return curves

    write_fqi(tmp_path, "car_on_hill", curves=far)
    runs = load_runs(tmp_path, "smoke")
    (note,) = runs.notes
    assert "B-FQI: diverges, q_error up to 4.5" in note.text
    axes = curves.figure_1(runs).axes[0]
    assert axes.get_ylim()[1] < 1.0
    assert "cut: B-FQI diverges" in {text.get_text() for text in axes.texts}


def test_incomplete_seeds_are_named_and_left_out_on_request_only(runs_dir, capsys):
    """B-FQI's seeds 2 (never begun), 4 (not ended) and 5 (diverged)."""
    folder = runs_dir / "smoke/car_on_hill/B-FQI"
    for path in folder.glob("seed_0002.*"):
        path.unlink()
    reseal(folder / "seed_0004.json", status="running")
    reseal(folder / "seed_0005.json", status="failed: non-finite weights")
    names = ("seeds 2", '"running"', '"failed: non-finite weights"')
    assert report(runs_dir, "--figures", "2") == 2  # the aggregate has both
    err = capsys.readouterr().err
    assert all(name in err for name in (*names, "--allow-incomplete"))
    assert not (runs_dir / "figures").exists()
    assert report(runs_dir, "--figures", "1", "--allow-incomplete") == 0
    err = capsys.readouterr().err
    assert all(name in err for name in (*names, "3 of 6 seeds"))
    assert "0–5: FQI, C-FQI and BC-FQI; 0–1, 3: B-FQI" in err
    runs = load_runs(runs_dir, "smoke", allow_incomplete=True)
    shown = "INCOMPLETE: B-FQI 3 of 6 seeds (1 failed)"
    assert shown in curves.figure_1(runs).get_supxlabel().splitlines()
    document = (runs_dir / "figures" / "claims_smoke.md").read_text()
    assert f"**{shown}**" in document.splitlines()[:4]
    assert "seeds 2" in document.split("## Notes")[1]
    fqi = {"FQI": runs.methods("car_on_hill", None)["FQI"]}
    assert remarks(runs, fqi, compares=False) == []


def test_a_method_without_a_complete_seed_is_named(runs_dir):
    for path in runs_dir.glob("smoke/car_on_hill/C-FQI/seed_*.json"):
        reseal(path, status="running")
    runs = load_runs(runs_dir, "smoke", allow_incomplete=True)
    for text in (curves.figure_1(runs).get_supxlabel(), claims_of(runs)):
        assert "INCOMPLETE: C-FQI 0 of 6 seeds" in text and "no runs of C-FQI" in text


def test_broken_files_are_rejected_even_so(runs_dir, capsys):
    folder = runs_dir / "smoke/car_on_hill/FQI"
    for seed in range(6):
        (folder / f"seed_{seed:04d}.csv").write_text("")
        (folder / f"seed_{seed:04d} (copy).npz").write_text("")
    assert report(runs_dir, "--figures", "1", "--allow-incomplete") == 2
    err = capsys.readouterr().err
    assert f"{folder}/seed_0003.csv " in err
    assert f"delete {folder}/seed_0003.*" in err
    assert f"and 2 more; `bcrl-verify {runs_dir}`" in err


def test_unequal_methods_and_absent_ones_are_named(tmp_path):
    write_fqi(tmp_path, "car_on_hill", methods=METHODS[:2], seeds=2)
    seven = {"car_on_hill": (7,)}
    write_fqi(tmp_path, "car_on_hill", methods=("B-FQI",), lengths=seven, seeds=2)
    noted = " ".join(note.text for note in load_runs(tmp_path, "smoke").notes)
    assert "9: FQI and C-FQI; 7: B-FQI" in noted and "no runs of BC-FQI" in noted


def test_variants_that_record_too_little_are_left_out_by_name(tmp_path):
    write_fqi(tmp_path, "car_on_hill", methods=("FQI",), seeds=2)
    config = {"env": {"name": "car_on_hill", "metrics": ["return"]}}
    name = "C-FQI@own"
    plan = made_up_plan(tmp_path, "car_on_hill", name, range(2), config=config)
    row = {"stage": 1, "task": 1, "iteration": 1, "return": 0.5}
    write_seeds(plan, lambda seed: pd.DataFrame([row]))
    runs = load_runs(tmp_path, "smoke")
    assert [v.name for v in runs.variants] == ["FQI"]
    assert "C-FQI@own" in runs.notes[0].text and "q_error" in runs.notes[0].text


def test_pickled_arrays_are_rejected(runs_dir, capsys):
    path = seed_path(runs_dir / "smoke" / "maze" / "FQI", 2, "npz")
    stored = io.BytesIO()
    np.savez(stored, states=0, q=np.array([{}], dtype=object))
    rerecord(path, stored.getvalue())
    assert report(runs_dir, "--figures", "3") == 2
    assert f"{path} is not a readable NPZ: delete" in capsys.readouterr().err


def test_without_runs_or_a_place_to_write_the_remedy_is_named(tmp_path, capsys):
    assert report(tmp_path) == 2
    assert "`bcrl experiment=fig1 scale=smoke`" in capsys.readouterr().err
    write_fqi(tmp_path, "car_on_hill", seeds=1)
    (tmp_path / "smoke").rename(tmp_path / "quick")
    assert report(tmp_path) == 2
    assert "there are runs at scale quick" in capsys.readouterr().err
    for path in (tmp_path / "quick").rglob("seed_*.json"):
        reseal(path, scale="quick", status="running")
    with pytest.raises(BcrlError, match=r"FQI: INCOMPLETE.*; `bcrl experiment=fig1"):
        load_runs(tmp_path, "quick", allow_incomplete=True)
    # Runs of another scale do not matter, even broken ones.
    write_fqi(tmp_path, "car_on_hill", seeds=1)
    assert report(tmp_path, "--figures", "2") == 0
    (tmp_path / "out").write_text("")
    assert report(tmp_path, "--out", str(tmp_path / "out"), "--figures", "2") == 2
    assert f"--out: can't make {tmp_path}/out" in capsys.readouterr().err
