"""The report's HTML page, and figures of environments that the paper doesn't have."""

import base64
import hashlib
import html
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from bcrl.report.curve_data import curve_data
from bcrl.report.figures.curves import POINTS, figure_curves, shared_spans, spread_rows
from bcrl.report.figures.style import task_spans
from bcrl.report.load import load_runs
from bcrl.report.page import task_values
from bcrl.results.layout import DQN_METRICS
from tests.report.runs import in_memory, report, write_dqn, write_fqi
from tests.results.made_up import made_up_plan, write_seeds

OWN = "my_<i>env"  # folders can be called so
MINE = {"env": {"name": "mine", "metrics": ["return", "height"]}}


def write_steps(root: Path, env: str, method: str, stages: list, tasks: list) -> None:
    """Rows every 1000 steps; where a stage ends and the next begins, two at a step."""
    starts = np.concatenate([[0], np.cumsum(stages)])

    def table(seed: int) -> pd.DataFrame:
        rng = np.random.default_rng(seed)
        blocks = []
        for number, task in enumerate(tasks):
            step = np.arange(starts[number], starts[number + 1] + 1, 1000)
            values = {name: rng.normal(-100, 20, len(step)) for name in DQN_METRICS}
            values["loss"][0] = np.nan
            block = {"stage": number + 1, "task": task, "step": step, **values}
            blocks.append(pd.DataFrame(block))
        return pd.concat(blocks, ignore_index=True)

    write_seeds(made_up_plan(root, env, method, range(3), config=MINE), table)


def write_own(root: Path, env: str = OWN) -> None:
    """Runs of both families in one's own environment, with one's own algorithm."""
    for method in ("FQI", "BC-FQI", "BC-MINE"):

        def fqi(seed: int, method=method) -> pd.DataFrame:
            values = np.random.default_rng([seed, len(method)]).normal(size=(2, 4))
            index = {"stage": [1, 1, 2, 2], "task": [1, 1, 2, 2]}
            index |= {"iteration": [1, 2, 3, 4]}
            return pd.DataFrame(index | {"return": values[0], "height": values[1]})

        made = made_up_plan(root, env, method, range(3), config=MINE)
        write_seeds(made, fqi, facts={"cpu_seconds": 5.0})
    write_steps(root, env, "DQN", [5000], [2])
    write_steps(root, env, "C-DQN", [2000, 3000], [1, 2])


def page_of(runs_dir: Path, name: str = "smoke") -> str:
    """The page that is there."""
    return (runs_dir / f"figures/report_{name}.html").read_text("utf-8")


@pytest.fixture(scope="module")
def reported(tmp_path_factory) -> Path:
    """Runs in one's own environment with everything that bcrl-report makes of them."""
    root = tmp_path_factory.mktemp("reported")
    write_own(root)
    (root / "figures").mkdir()
    for name in (f"agent_{OWN}_FQI_smoke.gif", f"agent_{OWN}_FQI_quick.gif"):
        Image.new("P", (4, 4)).save(root / "figures" / name)
    assert report(root) == 0
    return root


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
    write_steps(tmp_path, OWN, "BC-DQN", [1000, 4000], [1, 2])
    methods = load_runs(tmp_path, "smoke").tagged(OWN, "DQN", None)
    assert shared_spans(methods) == []


def test_a_task_is_shaded_over_iterations_without_a_row():
    task, index = np.array([1, 1, 2]), np.array([9, 25, 50])
    rare = SimpleNamespace(family="FQI", stage=task, task=task, index=index)
    assert task_spans(rare) == [("T1", 0.5, 25.5), ("T2", 25.5, 50.5)]


@pytest.mark.parametrize(
    ("index", "begin"), [([35, 40, 50], 30.5), ([31], 30.5), ([35, 80], 0.5)]
)
def test_a_task_after_another_runs_begins_with_its_own_iterations(index, begin):
    task = np.full(len(index), 4)
    later = SimpleNamespace(family="FQI", stage=task, task=task, index=np.array(index))
    assert task_spans(later) == [("T4", begin, index[-1] + 0.5)]


def test_long_curves_keep_their_stages_ends(tmp_path):
    write_steps(tmp_path, "cart", "C-DQN", [700_000, 1_300_000], [1, 2])
    (variant,) = load_runs(tmp_path, "smoke").variants
    x = variant.index[spread_rows(variant)]
    assert POINTS <= len(x) <= POINTS + 2
    assert x[0] == 0 and x[-1] == 2_000_000
    assert (x == 700_000).sum() == 2


def test_the_pages_curves_are_the_aggregates(reported):
    text = re.search(r'"curves-data">(.*?)</script>', page_of(reported), re.S)[1]
    found = {data["id"]: data for data in json.loads(text)}
    names = {"FQI": ("aggregate", "iteration"), "DQN": ("aggregate_dqn", "step")}
    for family, (name, count) in names.items():
        table = pd.read_csv(reported / f"figures/{name}_smoke.csv")
        for series in found[f"{OWN}-{family}"]["series"]:
            rows = table[table["variant"] == series["name"]]
            for metric, curve in series["metrics"].items():
                mine = rows[rows["metric"] == metric]
                assert series["x"] == mine[count].tolist()
                means = np.array(curve["mean"], float)  # None is nan
                np.testing.assert_allclose(means, mine["mean"], rtol=1e-6)


def test_tags_are_there_to_be_chosen(tmp_path):
    write_fqi(tmp_path, "maze", seeds=2)
    write_fqi(tmp_path, "maze", seeds=2, methods=("FQI",), tag="@mine")
    runs = load_runs(tmp_path, "smoke")
    for tag, shown in ((None, 4), ("mine", 1)):
        series = curve_data(runs, "maze", "FQI", tag)["series"]
        assert [s["on"] for s in series] == [True] * shown + [False] * (5 - shown)
        assert len({(s["light"], s["dash"]) for s in series}) == 5
    assert report(tmp_path, "--tag", "mine", "--figures", "2") == 0
    assert "scale smoke @mine</h1>" in page_of(tmp_path, "smoke@mine")


def test_a_methods_line_is_the_figures(tmp_path):
    """Colour and dashes are the figures'; S-DQN has PPR's colour and other dashes."""
    names = ("DQN", "C-DQN", "BC-DQN", "PPR", "S-DQN")
    write_dqn(tmp_path, names, range(2))
    series = curve_data(load_runs(tmp_path, "smoke"), "linear_system", "DQN", None)
    drawn = {s["name"]: (s["light"], s["dash"]) for s in series["series"]}
    assert {name: drawn[name] for name in names[:3]} == {
        "DQN": ("#0072B2", "8 3.2"),
        "C-DQN": ("#E69F00", "12 3 2.4 3"),
        "BC-DQN": ("#D55E00", ""),
    }
    assert drawn["PPR"][0] == drawn["S-DQN"][0]
    assert len(set(drawn.values())) == len(names)


def test_what_nobody_asked_for_is_not_missed(tmp_path, capsys):
    """Tasks' values, one list for variants with the same; no claims, no lines about
    figures of other environments."""
    lists = {"attributes": [{"force": 0.2}, {"force": 0.1}], "kwargs": None}
    for method, tasks in (("FQI", lists), ("B-FQI", lists), ("C-FQI", {"mass": [2]})):
        config = {"env": MINE["env"] | {"tasks": tasks}}
        plan = made_up_plan(tmp_path, "mine", method, range(1), config=config)
        table = pd.DataFrame({"stage": [1], "task": 1, "iteration": [1]})
        table[["return", "height"]] = 0.0
        write_seeds(plan, lambda seed, table=table: table)
    variants = load_runs(tmp_path, "smoke").of("mine", "FQI")
    assert task_values(variants) == {
        (("T1", "force 0.2"), ("T2, target", "force 0.1")): "FQI, B-FQI",
        (("T1, target", "mass 2"),): "C-FQI",
    }
    assert report(tmp_path) == 0
    assert "figure" not in capsys.readouterr().err
    assert not list(tmp_path.glob("figures/claims_*"))
    page = page_of(tmp_path)
    assert "<h3>Tasks of FQI, B-FQI</h3>" in page
    assert "<dt>T2, target</dt><dd>force 0.1</dd>" in page
    assert report(tmp_path, "--figures", "1") == 0
    assert "skipped figure 1: no runs of car_on_hill" in capsys.readouterr().err


def test_tasks_of_the_run_that_another_starts_from_come_first():
    """As in the CSVs; a task of both has one number, another environment its name."""

    def config(name: str, forces: list | None, source=None) -> dict:
        start = {"start": {"run": {"env": name, "tag": None, "config": source}}}
        env = {"name": name, "gamma": 0.9, "tasks": {"force": forces, "mass": None}}
        return {"env": env} | (start if source else {})

    def listed(config: dict) -> list[tuple[str, str]]:
        made = in_memory("cart/FQI", {"return": np.ones((1, 1))}, config=config)
        return [task for tasks in task_values([made]) for task in tasks]

    first = config("cart", [3, 2])
    second = config("cart", [2, 1], first)
    assert listed(second) == [
        ("T1", "force 3"),
        ("T2", "force 2"),
        ("T3, target", "force 1"),
    ]
    assert listed(config("cart", [3], second))[0] == ("T1, target", "force 3")
    other = listed(config("pole", [2], first))
    assert other == [
        ("T1", "cart, force 3"),
        ("T2", "cart, force 2"),
        ("T3, target", "force 2"),
    ]
    assert listed(config("cart", None)) == []


def test_animations_have_a_still_picture(reported):
    (still,) = re.findall(
        r'reduce\)" srcset="data:image/png;base64,(.*?)"', page_of(reported)
    )
    assert Image.open(io.BytesIO(base64.b64decode(still))).size == (4, 4)


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
    assert "<i>env" not in page and "<h2>my_&lt;i&gt;env, FQI</h2>" in page
    assert page.count("data:image/gif;base64,") == 1  # of this scale
    assert "<figcaption>my_&lt;i&gt;env: FQI</figcaption>" in page


def test_the_page_has_all_parts(tmp_path):
    """Claims, configurations, costs, origins, what differs and what is incomplete."""
    write_fqi(tmp_path, "maze", seeds=6)
    config = {"algorithm": {"name": "fqi", "episodes": 7}}
    plan = made_up_plan(tmp_path, "maze", "FQI@seven", range(2), config=config)
    table = pd.read_csv(tmp_path / "smoke/maze/FQI/seed_0000.csv")
    write_seeds(plan, lambda seed: table)
    write_fqi(tmp_path, "car_on_hill", seeds=3)
    for path in tmp_path.glob("smoke/maze/C-FQI/seed_0005.*"):
        path.unlink()
    assert report(tmp_path, "--allow-incomplete", "--figures", "2", "5") == 0
    page = html.unescape(page_of(tmp_path))
    assert '<p class="warning">INCOMPLETE: C-FQI 5 of 6 seeds</p>' in page
    assert "BC-FQI ends with a smaller error than FQI" in page
    assert '<span class="verdict holds">holds</span>' in page
    assert "algorithm.episodes: 5" in page
    assert "<mark>algorithm.episodes: 7</mark>   <i># FQI: 5</i>" in page
    assert "Variants compared" in page
    assert ">22 s</td>" in page  # 6 × 3.6 s
    facts = dict(re.findall(r"<div><dt>(claims.*?)</dt><dd>(.*?)</dd>", page))
    assert facts.keys() == {"claims", "claims, too few seeds to judge"}
    assert facts["claims"].split(", ")[0].endswith(" hold")
    assert facts["claims, too few seeds to judge"] == "12 as expected"
    assert page.count("<table") == page.count("<caption>") > 5
    assert "<dt>residual, ϱ</dt>" in page
    assert re.search(r"maze BC-FQI 0–5", page)
    assert all(f"Figure {n}. Maze" in page for n in "25")
