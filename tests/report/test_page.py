"""The report's HTML page, and figures of environments that the paper doesn't have."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from bcrl.report import cli
from bcrl.report.curve_data import curve_data
from bcrl.report.figures.curves import (
    POINTS,
    figure_curves,
    shared_spans,
    spread_rows,
)
from bcrl.report.load import load_runs
from bcrl.results.layout import DQN_METRICS
from tests.report.test_report import write_runs
from tests.results.made_up import made_up_plan, write_seeds

OWN = "my_<i>env"  # folders can be called so


def dqn_table(seed: int, stages: list[int], tasks: list[int]) -> pd.DataFrame:
    """Rows every 1000 steps; where a stage ends and the next begins, two at a step."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(stages)])
    blocks = []
    for number, task in enumerate(tasks):
        step = np.arange(starts[number], starts[number + 1] + 1, 1000)
        values = {name: rng.normal(-100, 20, len(step)) for name in DQN_METRICS}
        values["loss"][0] = np.nan
        block = {"stage": number + 1, "task": task, "step": step, **values}
        blocks.append(pd.DataFrame(block))
    return pd.concat(blocks, ignore_index=True)


def write_own(root: Path, env: str = OWN) -> None:
    """Runs of both families in one's own environment, with one's own algorithm."""
    config = {"env": {"name": "mine", "metrics": ["return", "height"]}}
    for method in ("FQI", "BC-FQI", "BC-MINE"):

        def fqi(seed: int, method=method) -> pd.DataFrame:
            rng = np.random.default_rng([seed, len(method)])
            index = {"stage": [1, 1, 2, 2], "task": [1, 1, 2, 2]}
            index |= {"iteration": [1, 2, 3, 4]}
            values = rng.normal(size=(2, 4))
            return pd.DataFrame(index | {"return": values[0], "height": values[1]})

        made = made_up_plan(root, env, method, range(3), config=config)
        write_seeds(made, fqi, facts={"cpu_seconds": 5.0})
    for method, stages, tasks in (
        ("DQN", [5000], [2]),
        ("C-DQN", [2000, 3000], [1, 2]),
    ):
        made = made_up_plan(root, env, method, range(3), config=config)
        write_seeds(made, lambda s, a=stages, b=tasks: dqn_table(s, a, b))


@pytest.fixture(scope="module")
def reported(tmp_path_factory) -> Path:
    """Runs in one's own environment with everything that bcrl-report makes of them."""
    root = tmp_path_factory.mktemp("reported")
    write_own(root)
    (root / "figures").mkdir()
    for name in (f"agent_{OWN}_FQI_smoke.gif", f"agent_{OWN}_FQI_quick.gif"):
        Image.new("P", (4, 4)).save(root / "figures" / name)
    written(root)
    return root


def page_of(runs_dir: Path) -> str:
    """The page that is there."""
    return (runs_dir / "figures/report_smoke.html").read_text("utf-8")


def written(runs_dir: Path, *arguments: str) -> str:
    """The page that bcrl-report writes."""
    asked = ["--runs-dir", str(runs_dir), "--scale", "smoke", *arguments]
    assert cli.main(asked) == 0
    (path,) = runs_dir.glob("figures/report_*.html")
    return path.read_text("utf-8")


def data_of(page: str) -> list[dict]:
    """The curves inside a page."""
    return json.loads(re.search(r'"curves-data">(.*?)</script>', page, re.S)[1])


# --- curves


def test_an_environment_of_ones_own_is_drawn(reported):
    runs = load_runs(reported, "smoke")
    assert set(runs.pairs) == {(OWN, "FQI"), (OWN, "DQN")}
    figure = figure_curves(runs, OWN, "FQI")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["discounted return", "height"]
    lines = {(x.get_color(), x.get_linestyle()): x for x in figure.axes[0].lines}
    assert len(lines) == 3  # one's own algorithm, too
    tables = map(pd.read_csv, reported.glob("smoke/*/BC-FQI/seed_*.csv"))
    means = pd.concat(tables).groupby("iteration")["return"].mean()
    np.testing.assert_allclose(lines["#D55E00", "-"].get_ydata(), means)


def test_tasks_are_shaded_where_the_curricula_agree(tmp_path):
    write_own(tmp_path)
    methods = load_runs(tmp_path, "smoke").tagged(OWN, "DQN", None)
    assert shared_spans(methods) == [("T1", 0.0, 2000.0), ("T2", 2000.0, 5000.0)]
    plan = made_up_plan(tmp_path, OWN, "BC-DQN", range(3))
    write_seeds(plan, lambda s: dqn_table(s, [1000, 4000], [1, 2]))
    methods = load_runs(tmp_path, "smoke").tagged(OWN, "DQN", None)
    assert shared_spans(methods) == []


def test_long_curves_keep_their_stages_ends(tmp_path):
    plan = made_up_plan(tmp_path, "cart", "C-DQN", range(2))
    write_seeds(plan, lambda s: dqn_table(s, [700_000, 1_300_000], [1, 2]))
    (variant,) = load_runs(tmp_path, "smoke").variants
    x = variant.index[spread_rows(variant)]
    assert POINTS <= len(x) <= POINTS + 2
    assert x[0] == 0 and x[-1] == 2_000_000
    assert (x == 700_000).sum() == 2


def test_the_pages_curves_are_the_aggregates(reported):
    page = page_of(reported)
    for family, name, count in (
        ("FQI", "aggregate", "iteration"),
        ("DQN", "aggregate_dqn", "step"),
    ):
        table = pd.read_csv(reported / f"figures/{name}_smoke.csv")
        (data,) = (d for d in data_of(page) if d["id"] == f"{OWN}-{family}")
        for series in data["series"]:
            rows = table[table["variant"] == series["name"]]
            for metric, found in series["metrics"].items():
                mine = rows[rows["metric"] == metric]
                assert series["x"] == mine[count].tolist()
                means = np.array(found["mean"], float)  # None is nan
                np.testing.assert_allclose(means, mine["mean"], rtol=1e-6)


def test_tags_are_there_to_be_chosen(tmp_path):
    write_runs(tmp_path, "maze", seeds=2)
    write_runs(tmp_path, "maze", seeds=2, methods=("FQI",), tag="@mine")
    runs = load_runs(tmp_path, "smoke")
    for tag, shown in ((None, 4), ("mine", 1)):
        series = curve_data(runs, "maze", "FQI", tag)["series"]
        assert len(series) == 5
        assert [s["on"] for s in series] == [True] * shown + [False] * (5 - shown)
    page = written(tmp_path, "--tag", "mine", "--figures", "2")
    assert "scale smoke @mine</h1>" in page


# --- the page


def test_it_is_whole_and_names_no_other_place(reported):
    page = page_of(reported)
    assert set(re.findall(r"\w+://[\w./]+", page)) == {"http://www.w3.org/2000/svg"}
    links = re.findall(r'(?:src|href)="(.{5})', page)
    assert links and all(link.startswith(("data:", "#")) for link in links)
    policy = html.unescape(re.search(r'Policy" content="(.+?)"', page)[1])
    assert policy.startswith("default-src 'none'; img-src data:;")
    for element in ("style", "script"):
        (content,) = re.findall(rf"<{element}>(.*?)</{element}>", page, re.S)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{element}-src 'sha256-{digest}'" in policy
    assert not re.search(r'<[^>]+ (style|on\w+)="', page)  # the policy forbids them


def test_names_are_escaped(reported):
    page = page_of(reported)
    assert "<i>env" not in page
    assert "<h2>My &lt;i&gt;env, FQI</h2>" in page


def test_the_page_has_all_parts(tmp_path):
    """Claims, configurations, costs, origins, what differs and what is incomplete."""
    write_runs(tmp_path, "maze", seeds=6)
    config = {"algorithm": {"name": "fqi", "episodes": 7}}
    plan = made_up_plan(tmp_path, "maze", "FQI@seven", range(2), config=config)
    table = pd.read_csv(tmp_path / "smoke/maze/FQI/seed_0000.csv")
    write_seeds(plan, lambda seed: table)
    for path in tmp_path.glob("smoke/maze/C-FQI/seed_0005.*"):
        path.unlink()
    page = html.unescape(written(tmp_path, "--allow-incomplete", "--figures", "2", "5"))
    assert '<p class="warning">INCOMPLETE: C-FQI 5 of 6 seeds</p>' in page
    assert "BC-FQI ends with a smaller error than FQI" in page
    assert '<span class="verdict holds">holds</span>' in page
    assert "algorithm.episodes: 5" in page
    assert "<mark>algorithm.episodes: 7</mark>   <i># FQI: 5</i>" in page
    assert "Variants compared" in page
    assert '<td data-name="CPU time">22 s</td>' in page  # 6 × 3.6 s
    assert re.search(r"maze BC-FQI 0–5", page)
    assert all(f"Figure {n}. Maze" in page for n in "25")


def test_animations_of_the_scale_are_shown(reported):
    page = page_of(reported)
    assert page.count("data:image/gif;base64,") == 1
    assert "<figcaption>My &lt;i&gt;env: FQI</figcaption>" in page
