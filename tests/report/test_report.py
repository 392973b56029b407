"""The report, on made-up runs whose right answers are known beforehand."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from scipy import stats

from bcrl.report import cli
from bcrl.report import statistics as st
from bcrl.report.claims.document import claims_report
from bcrl.report.claims.judge import verdict
from bcrl.report.figures import curves, style
from bcrl.report.figures.maze import figure_3, seed_mean_value
from bcrl.report.load import load_runs
from bcrl.report.tables import aggregate, interquartile_mean
from bcrl.report.variants import METHODS, Runs
from bcrl.results.layout import FQI_METRICS, seed_path
from tests.results.made_up import made_up_plan, rerecord, reseal, write_seeds

LENGTHS = {
    "car_on_hill": (20, 20, 20),
    "maze": (10, 10, 10, 10, 20, 20, 50, 50, 50, 50),
}
SHORT = {"car_on_hill": (3, 3, 3), "maze": (2,) * 10}
OPTIMUM = -47.557563488
LATTICE = np.array([(x, y) for x in range(21) for y in range(21)]) / 20


def as_the_paper_says(env, method, seed, stage):
    """Runs in which every claim is true, with a little spread between seeds."""
    jitter = 0.001 * seed
    first = np.concatenate([[True], np.diff(stage) > 0])
    ones = np.ones(len(stage))
    if env == "car_on_hill":
        error = {"FQI": 0.5, "C-FQI": 0.3, "B-FQI": 0.45, "BC-FQI": 0.1}[method] * ones
        last = np.concatenate([first[1:], [True]])
        if method == "C-FQI":
            error = error + 0.1 * (stage > 1) + 0.05 * (last & (stage == 3))
        if method == "BC-FQI":
            error = error - 0.02 * (stage == 2) + 0.04 * (first & (stage == 3))
        return {"q_error": error + jitter, "return": 1 - error + jitter}
    solves = method == "BC-FQI" or (method == "C-FQI" and seed == 0)
    residual = np.array([9, 7, 5, 4, 3, 2, 6, 4, 3, 1])[stage - 1]
    reached = OPTIMUM if solves else (-65 if method == "C-FQI" else -90) - 2 * seed
    error = {"FQI": 30, "C-FQI": 10, "B-FQI": 25, "BC-FQI": 1}[method] + jitter
    return {
        "return": reached - 0.5 * np.arange(len(stage))[::-1],  # rising to its end
        "q_error_start": error * ones,
        "q_error": error * ones,
        "residual_start": -residual - jitter,
        "solved": int(solves) * ones,
    }


def maze_arrays(method: str, seed: int) -> dict[str, np.ndarray]:
    path = np.linspace(0, 0.95, 20 + seed % 8)[:, None] * [1, 1]
    h = np.linspace(0.05, 0.95, 10)
    ones, zeros = np.ones(10), np.zeros(10)
    low = np.stack([0.15 * ones, zeros, 0.25 * ones, h], -1)
    high = np.stack([0.55 * ones, 1 - h, 0.65 * ones, ones], -1)
    values = LATTICE.sum(1) * 20 - 60 + seed
    return {
        "states": LATTICE,
        "q": values[:, None] - np.arange(4),
        "residuals": np.zeros((10, 441, 4)),
        "trajectory": path,
        "walls": np.stack([low, high], 1),
        "goal": np.array([0.95, 0.95]),
    }


def write_runs(
    runs_dir: Path,
    env: str,
    scale: str = "smoke",
    seeds: int = 6,
    methods: tuple[str, ...] = METHODS,
    lengths: dict = SHORT,
    tag: str = "",
    curves=as_the_paper_says,
) -> None:
    """Complete runs as the runner leaves them."""
    stage = np.repeat(np.arange(1, len(lengths[env]) + 1), lengths[env])
    facts = {"optimum": OPTIMUM if env == "maze" else None}
    facts |= {"cpu_seconds": 3.6, "wall_seconds": 4.0}
    for method in methods:
        curriculum = method.startswith(("C-", "BC-"))

        def table(seed: int, method=method, curriculum=curriculum) -> pd.DataFrame:
            columns = {
                "stage": stage,
                "task": stage if curriculum else np.full(len(stage), stage[-1]),
                "iteration": np.arange(1, len(stage) + 1),
                **curves(env, method, seed, stage),
            }
            return pd.DataFrame(columns)

        def arrays(seed: int, method=method) -> dict[str, np.ndarray]:
            return maze_arrays(method, seed) if env == "maze" else {}

        plan = made_up_plan(runs_dir, env, method + tag, range(seeds), scale)
        write_seeds(plan, table, arrays, facts)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """Complete runs of both environments, not to be changed."""
    root = tmp_path_factory.mktemp("written") / "runs"
    for env in FQI_METRICS:
        write_runs(root, env)
    return root


@pytest.fixture
def runs_dir(written, tmp_path: Path) -> Path:
    """A copy of them to be changed."""
    return shutil.copytree(written, tmp_path / "runs")


def run(runs_dir: Path, *arguments: str) -> int:
    return cli.main(["--runs-dir", str(runs_dir), "--scale", "smoke", *arguments])


def verdicts_of(document: str, section: str) -> dict[str, str]:
    """Claim → verdict, read back from the Markdown table of a section."""
    part = document.split(f"## {section}")[1].split("\n\n")[2]
    lines = [line.strip("| ") for line in part.splitlines() if line.startswith("| ")]
    rows = [re.split(r" (?<!\\)\| ", line) for line in lines[2:]]
    return {cells[0]: cells[-1] for cells in rows}


# --- statistics


def test_standard_error_is_the_papers():
    values = np.array([[1.0, 4.0], [3.0, 4.0]])
    # deviation of 1, 3 with ddof = 0 is 1, over √2
    assert st.standard_error(values) == pytest.approx([1 / np.sqrt(2), 0.0])
    assert st.standard_error(values, ddof=1) == pytest.approx([1.0, 0.0])
    assert np.isnan(st.standard_error(values[:1], ddof=1)).all()


def test_interquartile_mean():
    assert interquartile_mean([100.0, 1.0, 2.0, 3.0, -50.0]) == "2.000"


def test_bootstrap_of_two_values_is_the_binomial():
    """Means of resamples of 0, 1 are 0, ½, 1 with ¼, ½, ¼: both ends are reached."""
    assert st.bootstrap([0.0, 1.0]) == (0.0, 1.0)
    # 0 and 1 in equal numbers, n = 100: the binomial's 2.5 and 97.5 % points
    low, high = st.bootstrap(np.repeat([0.0, 1.0], 50))
    expected = stats.binom.ppf([0.025, 0.975], 100, 0.5) / 100
    assert (low, high) == pytest.approx(expected, abs=0.0101)


def test_bootstrap_of_a_difference():
    same = np.full(5, 3.0)
    assert st.bootstrap(same + 2, same) == (2.0, 2.0)
    # independent resampling: variances add, so the interval is √2 times as wide
    values = np.random.default_rng(2).normal(size=50)
    low, high = st.bootstrap(values, values)
    one = st.bootstrap(values)
    assert low < 0 < high
    assert (high - low) / (one.high - one.low) == pytest.approx(np.sqrt(2), rel=0.05)


@pytest.mark.parametrize("values", [[1.0], [1.0, np.nan], []])
def test_no_interval_without_data(values):
    assert np.isnan(st.bootstrap(values)).all()


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
    np.testing.assert_allclose(low, [i.low for i in each])
    np.testing.assert_allclose(high, [i.high for i in each])
    monkeypatch.setattr(st, "MOST_DRAWS", 8 * 777)  # blocks change no draw
    np.testing.assert_array_equal(st.bootstrap_curves(values), (low, high))
    values[3, 1] = np.nan
    gaps = np.isnan(st.bootstrap_curves(values))
    assert gaps.tolist() == [[False, True, False, False, False]] * 2
    assert np.isnan(st.bootstrap_curves(values[:1])).all()


# --- figures


@pytest.mark.slow
def test_everything_is_written_and_listed(runs_dir, capsys):
    assert run(runs_dir) == 0
    captured = capsys.readouterr()
    skipped = [line[:17] for line in captured.err.splitlines()]
    assert skipped == ["skipped figure 4a", "skipped figure 4b"]  # no linear system
    listed = {Path(line) for line in captured.out.splitlines()}
    names = {f"figure_{n}_smoke.{k}" for n in "1235" for k in ("png", "pdf")}
    names |= {"aggregate_smoke.csv", "claims_smoke.md", "report_smoke.html"}
    assert listed == {runs_dir / "figures" / name for name in names}
    assert {p.name for p in (runs_dir / "figures").iterdir()} == names


@pytest.mark.slow
def test_two_reports_are_byte_identical(written, tmp_path):
    for name in ("a", "b"):
        assert run(written, "--out", str(tmp_path / name), "--figures", "3") == 0
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert len(names) == 5
    for name in names:
        first, second = ((tmp_path / d / name).read_bytes() for d in "ab")
        assert first == second


@pytest.mark.parametrize("draw", [curves.figure_2, curves.figure_5])
def test_task_labels_do_not_overlap(tmp_path, draw):
    """At the paper's stage lengths, where the first four bands are very narrow."""
    write_runs(tmp_path, "maze", seeds=2, lengths=LENGTHS)
    runs = load_runs(tmp_path, "smoke")
    with style.sheet():
        figure: Figure = draw(runs)
        figure.draw_without_rendering()
        for axes in figure.axes:
            boxes = [text.get_window_extent() for text in axes.texts]
            assert [t.get_text() for t in axes.texts] == [f"T{i}" for i in range(1, 11)]
            for i, box in enumerate(boxes):
                assert not any(box.overlaps(other) for other in boxes[:i])


def test_curves_are_the_means_of_the_records(written):
    """Figure 1's bold lines, recomputed from the CSVs."""
    with style.sheet():
        axes = curves.figure_1(load_runs(written, "smoke")).axes[0]
    bold = {line.get_color(): line for line in axes.lines if line.get_linewidth() > 1}
    folder = written / "smoke" / "car_on_hill" / "BC-FQI"
    tables = [pd.read_csv(path) for path in folder.glob("*.csv")]
    expected = sum(table["q_error"] for table in tables) / len(tables)
    line = bold[style.colour("BC-FQI")]
    assert line.get_xdata().tolist() == list(range(1, 10))
    assert line.get_ydata() == pytest.approx(expected.to_numpy())


def test_one_colour_per_prefix():
    assert style.colour("BC-FQI") == style.colour("BC-DQN")
    methods = ["DQN", "C-DQN", "B-DQN", "BC-DQN", "SC-DQN", "SBC-DQN", "RPL", "PPR"]
    assert len({style.colour(name) for name in methods}) == len(methods)


def test_values_are_of_the_seed_mean(runs_dir):
    """max_a of the mean, not the mean of max_a, and x-major states seen as x, y."""
    variant = load_runs(runs_dir, "smoke").methods("maze", None)["FQI"]
    x, y, value = seed_mean_value(variant)
    assert value.shape == (21, 21)
    assert value[3, 20] == pytest.approx((x[3] + y[20]) * 20 - 60 + np.mean(range(6)))
    for seed in range(6):  # every seed prefers another action, by as much
        q = np.zeros((441, 4))
        q[:, seed % 2] = 1.0
        np.savez(variant.npz(seed), **(maze_arrays("FQI", seed) | {"q": q}))
    assert seed_mean_value(variant)[2] == pytest.approx(0.5)


def test_figure_3_with_fewer_methods(tmp_path):
    write_runs(tmp_path, "maze", methods=("FQI", "BC-FQI"), seeds=2)
    with style.sheet():
        figure = figure_3(load_runs(tmp_path, "smoke"))
    titles = [a.get_title() for a in figure.axes if a.get_title()]
    assert titles[:4] == ["T1", "T4", "T7", "T10"]
    assert titles[-4:] == ["FQI: 0 of 2 arrive", *METHODS[1:3], "BC-FQI: 2 of 2 arrive"]


def test_tagged_variants_are_drawn_on_request(tmp_path, capsys):
    write_runs(tmp_path, "maze", methods=("FQI", "BC-FQI"))
    write_runs(tmp_path, "maze", methods=("BC-FQI",), tag="@released", seeds=3)
    assert run(tmp_path, "--figures", "1", "2", "--tag", "released") == 0
    captured = capsys.readouterr()
    assert "figure_2_smoke@released.png" in captured.out
    assert "experiment=fig1_released" in captured.err  # which makes what figure 1 lacks
    table = pd.read_csv(tmp_path / "figures" / "aggregate_smoke.csv")
    assert set(table["variant"]) == {"FQI", "BC-FQI", "BC-FQI@released"}


def test_aggregate_recomputed(written):
    table = aggregate(load_runs(written, "smoke"))
    columns = "scale env variant stage task iteration metric seeds mean standard_error"
    assert list(table.columns) == columns.split()
    row = table.query(
        "env == 'maze' and variant == 'C-FQI' and iteration == 7 and metric == 'return'"
    )
    folder = written / "smoke" / "maze" / "C-FQI"
    values = [pd.read_csv(p)["return"][6] for p in sorted(folder.glob("*.csv"))]
    assert row["mean"].item() == pytest.approx(np.mean(values))
    expected = np.std(values, ddof=1) / np.sqrt(6)
    assert row["standard_error"].item() == pytest.approx(expected)
    assert row[["stage", "task", "seeds"]].to_numpy().tolist() == [[4, 4, 6]]


# --- claims


def the_opposite(env, method, seed, stage):
    """The same with BC-FQI's and FQI's runs exchanged, and C-FQI's and B-FQI's."""
    other = dict(zip(METHODS, METHODS[::-1], strict=True))
    curves = as_the_paper_says(env, other[method], seed, stage)
    if env == "maze":
        curves["residual_start"] = curves["residual_start"][::-1]
    return curves


def claims(tmp_path: Path, curves, seeds: int = 6) -> tuple[dict, dict]:
    for env in FQI_METRICS:
        write_runs(tmp_path, env, curves=curves, seeds=seeds)
    document = claims_report(load_runs(tmp_path, "smoke"))
    return verdicts_of(document, "Car"), verdicts_of(document, "Maze")


def test_true_claims_hold(tmp_path):
    car, maze = claims(tmp_path, as_the_paper_says)
    assert (len(car), len(maze)) == (12, 17)
    assert {**car, **maze} == dict.fromkeys([*car, *maze], "holds")


def test_false_claims_do_not(tmp_path):
    car, maze = claims(tmp_path, the_opposite)
    for found in (car, maze):
        assert found["BC-FQI ends with a smaller error than FQI"] == "does not hold"
        assert found["BC-FQI ends with a larger return than FQI"] == "does not hold"
    assert car["C-FQI's error rises on the target task"] == "does not hold"
    assert maze["FQI never solves the target"] == "does not hold"
    assert maze["BC-FQI's residual at s0 shrinks from T1 to T6"] == "does not hold"
    assert maze["most seeds of BC-FQI end at the optimum"] == "does not hold"


def test_few_seeds_and_absent_methods_decide_nothing(tmp_path):
    write_runs(tmp_path, "car_on_hill", seeds=2, methods=("FQI", "BC-FQI"))
    found = verdicts_of(claims_report(load_runs(tmp_path, "smoke")), "Car")
    few = "undecided (fewer than 5 seeds)"
    assert found["BC-FQI ends with a smaller error than FQI"] == few
    assert found["C-FQI's error jumps from T1 to T2"] == "no runs of C-FQI"


@pytest.mark.parametrize(
    ("low", "high", "expect", "expected"),
    [
        (-2.0, -1.0, "< 0", "holds"),
        (-2.0, -1.0, "> 0", "does not hold"),
        (-1.0, 1.0, "< 0", "undecided"),
        (-1.0, 0.0, "≤ 0", "holds"),
        (0.0, 1.0, "< 0", "does not hold"),
        (0.6, 0.9, "> ½", "holds"),
        (0.4, 0.9, "> ½", "undecided"),
        (0.0, 0.0, "= 0", "holds"),
    ],
)
def test_verdicts(low, high, expect, expected):
    interval = st.Interval(low, high)
    assert verdict((low + high) / 2, interval, expect, seeds=9) == expected


# --- what is incomplete, odd or broken


def folder_of(runs_dir: Path, method: str) -> Path:
    return runs_dir / "smoke" / "car_on_hill" / method


def footer_of(runs: Runs, *methods: str, compares: bool = True) -> str:
    found = runs.methods("car_on_hill", None)
    shown = {name: found[name] for name in methods or found}
    figure = Figure(figsize=(7.0, 3.0))
    style.footer(figure, runs, shown, "", compares)
    return figure.get_supxlabel()


def lose_seeds(runs_dir: Path) -> None:
    """B-FQI's seeds 2 (never begun), 4 (not ended) and 5 (diverged)."""
    folder = folder_of(runs_dir, "B-FQI")
    for path in folder.glob("seed_0002.*"):
        path.unlink()
    reseal(folder / "seed_0004.json", status="running")
    reseal(folder / "seed_0005.json", status="failed: non-finite weights")


def test_incomplete_seeds_are_named_and_left_out_on_request_only(runs_dir, capsys):
    lose_seeds(runs_dir)
    names = ("seed 2", '"running"', '"failed: non-finite weights"')
    assert run(runs_dir, "--figures", "2") == 2  # the aggregate has all environments
    err = capsys.readouterr().err
    assert all(name in err for name in (*names, "--allow-incomplete"))
    assert not (runs_dir / "figures").exists()
    assert run(runs_dir, "--figures", "1", "--allow-incomplete") == 0
    err = capsys.readouterr().err
    assert all(name in err for name in (*names, "3 of 6 seeds"))
    assert "0–5: FQI, C-FQI and BC-FQI; 0–1, 3: B-FQI" in err
    runs = load_runs(runs_dir, "smoke", allow_incomplete=True)
    shown = "INCOMPLETE: B-FQI 3 of 6 seeds (1 failed)"
    assert shown in footer_of(runs).splitlines()
    with style.sheet():
        assert shown in curves.figure_1(runs).get_supxlabel()
    document = (runs_dir / "figures" / "claims_smoke.md").read_text()
    assert f"**{shown}**" in document.splitlines()[:4]
    assert "seed 2" in document.split("## Notes")[1]
    alone = footer_of(runs, "FQI", compares=False)
    assert "INCOMPLETE" not in alone and "Note" not in alone


def test_a_method_without_a_complete_seed_is_named(runs_dir):
    for path in folder_of(runs_dir, "C-FQI").glob("seed_*.json"):
        reseal(path, status="running")
    runs = load_runs(runs_dir, "smoke", allow_incomplete=True)
    assert "C-FQI" not in runs.methods("car_on_hill", None)
    assert "INCOMPLETE: C-FQI 0 of 6 seeds" in footer_of(runs)
    assert "no runs of C-FQI" in footer_of(runs)
    assert "INCOMPLETE" not in footer_of(runs, "BC-FQI", compares=False)
    assert "INCOMPLETE: C-FQI 0 of 6 seeds" in claims_report(runs)


def test_complete_runs_have_no_note(written):
    runs = load_runs(written, "smoke", allow_incomplete=True)
    assert runs.notes == []
    assert "INCOMPLETE" not in footer_of(runs) + claims_report(runs)


def test_broken_files_are_rejected_even_so(runs_dir, capsys):
    folder = folder_of(runs_dir, "FQI")
    for seed in range(6):
        (folder / f"seed_{seed:04d}.csv").write_text("")
        (folder / f"seed_{seed:04d} (copy).npz").write_text("")
    for more in ([], ["--allow-incomplete"]):
        assert run(runs_dir, "--figures", "1", *more) == 2
        err = capsys.readouterr().err
        assert f"{folder}/seed_0003.csv " in err
        assert f"delete {folder}/seed_0003.*" in err
        assert f"and 2 more; `bcrl-verify {runs_dir}`" in err
        assert "Traceback" not in err
    assert not (runs_dir / "figures").exists()


def test_runs_of_another_scale_do_not_matter(runs_dir):
    write_runs(runs_dir, "car_on_hill", scale="quick", seeds=1)
    (runs_dir / "quick" / "car_on_hill" / "FQI" / "config.yaml").unlink()
    assert run(runs_dir, "--figures", "1") == 0


def test_unequal_methods_and_absent_ones_are_named(tmp_path):
    write_runs(tmp_path, "car_on_hill", methods=METHODS[:2], seeds=2)
    seven = {"car_on_hill": (7,)}
    write_runs(tmp_path, "car_on_hill", methods=("B-FQI",), lengths=seven, seeds=2)
    noted = [note.text for note in load_runs(tmp_path, "smoke").notes]
    assert any("9: FQI and C-FQI; 7: B-FQI" in text for text in noted)
    assert any("no runs of BC-FQI" in text for text in noted)


def test_variants_that_record_too_little_are_left_out_by_name(tmp_path):
    write_runs(tmp_path, "car_on_hill", methods=("FQI",), seeds=2)
    env = {"name": "car_on_hill", "metrics": ["return"]}
    plan = made_up_plan(
        tmp_path, "car_on_hill", "C-FQI@own", range(2), config={"env": env}
    )
    row = {"stage": 1, "task": 1, "iteration": 1, "return": 0.5}
    write_seeds(plan, lambda seed: pd.DataFrame([row]))
    runs = load_runs(tmp_path, "smoke")
    assert [v.name for v in runs.variants] == ["FQI"]
    assert "C-FQI@own" in runs.notes[0].text and "q_error" in runs.notes[0].text


def test_pickled_arrays_are_rejected(runs_dir, capsys):
    path = seed_path(runs_dir / "smoke" / "maze" / "FQI", 2, "npz")
    stored = io.BytesIO()
    np.savez(stored, q=np.array([{}], dtype=object), states=LATTICE)
    rerecord(path, stored.getvalue())
    assert run(runs_dir, "--figures", "3") == 2
    assert f"{path} is not a readable NPZ: delete" in capsys.readouterr().err


def test_without_runs_the_commands_are_named(tmp_path, capsys):
    assert run(tmp_path) == 2
    assert "`bcrl experiment=fig1 scale=smoke`" in capsys.readouterr().err
    write_runs(tmp_path, "car_on_hill", scale="quick", seeds=1)
    assert run(tmp_path) == 2
    assert "there are runs at scale quick" in capsys.readouterr().err


def test_out_that_is_a_file(written, tmp_path, capsys):
    (tmp_path / "out").write_text("")
    assert run(written, "--out", str(tmp_path / "out"), "--figures", "1") == 2
    assert f"--out: can't make {tmp_path}/out" in capsys.readouterr().err


def test_reading_and_drawing_load_neither_hydra_nor_torch_nor_numba():
    program = "import sys, bcrl.report.cli, bcrl.results.verify, bcrl.results.loggers; "
    program += "print({'hydra', 'torch', 'numba'} & {*sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True
    )
    assert done.stdout == "set()\n", done.stderr
