"""`bcrl-report --compare` and `--sweep`: figures of any runs, on made-up ones."""

import re
import shutil
from argparse import Namespace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from bcrl.errors import BcrlError
from bcrl.report.choose import _compared, folders_of, labelled
from bcrl.report.figures import style
from bcrl.report.figures.curves import figure_metrics
from bcrl.report.figures.frames import figure_frame
from bcrl.report.figures.layout import TEXT, inches
from bcrl.report.figures.sweep import figure_final, figure_map, figure_sweep
from bcrl.report.load import load_chosen
from bcrl.report.sweeps import Sweep, sweeps_of
from bcrl.report.variants import _TITLES, Methods, Runs, env_title, tags_shown
from bcrl.results.layout import seed_path
from tests.report.runs import as_claimed, in_memory, report, write_dqn, write_fqi
from tests.results.made_up import made_up_plan, reseal, write_seeds

TAGGED = ("FQI", "BC-FQI", "BC-FQI@a", "BC-FQI@b")
COLUMN = inches("column")
ENVS = Path(__file__).parents[2] / "conf/env"


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """The maze's four methods, two tags of BC-FQI, and two DQNs; not to be changed."""
    root = tmp_path_factory.mktemp("chosen") / "runs"
    write_fqi(root, "maze", seeds=3)
    for tag in ("@a", "@b"):
        write_fqi(root, "maze", seeds=3, methods=("BC-FQI",), tag=tag)
    write_dqn(root, ("DQN", "BC-DQN"), range(3))
    return root


def chosen(root: Path, *names: str, env: str | None = None) -> tuple[Runs, Methods]:
    """The runs of these names and their labels."""
    runs = load_chosen(folders_of(root, "smoke", env, names))
    return runs, labelled(runs.variants)


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_files_have_the_asked_size_in_print(written, tmp_path):
    words = ["--compare", "FQI", "BC-FQI@a", "env=maze", "--metrics", "solved"]
    for width, size in (("column", 3.25), ("5", 5.0)):
        out = tmp_path / width
        kinds = ["svg", "png", "pdf"][: 3 if width == "column" else 2]
        words += ["--format", *kinds, "--width", width, "--out", str(out)]
        assert report(written, *words) == 0
        path = out / "compare_maze_smoke_solved.png"
        assert {p.suffix[1:] for p in out.iterdir()} == set(kinds)
        with Image.open(path) as picture:
            assert picture.width / picture.info["dpi"][0] == pytest.approx(
                size, abs=0.01
            )
        svg = re.search(r'width="([\d.]+)pt"', path.with_suffix(".svg").read_text())
        assert float(svg[1]) == pytest.approx(72 * size)
    pdf = (tmp_path / "column/compare_maze_smoke_solved.pdf").read_bytes()
    assert float(re.search(rb"/MediaBox \[ *0 0 ([\d.]+)", pdf)[1]) == 234.0


def test_a_common_tag_is_in_the_names_of_the_files(written, tmp_path):
    for names in (["FQI", "BC-FQI"], ["FQI", "BC-FQI@a"], ["*@a"], ["*@b"]):
        words = ["--compare", *names, "--env", "maze", "--metrics", "solved"]
        out = ["--format", "svg", "--out", str(tmp_path)]
        assert report(written, *words, *out) == 0
    stems = {f"compare_maze_smoke{tag}_solved" for tag in ("", "@a", "@b")}
    assert {path.stem for path in tmp_path.iterdir()} == stems


def test_only_shipped_environments_have_titles():
    ids = ["linear_system", "Nav2D-v0", "my_env"]
    assert [*map(env_title, ids)] == ["Linear system", "Nav2D-v0", "my_env"]
    assert {path.stem for path in ENVS.glob("*.yaml")} - {"gymnasium"} == {*_TITLES}


def test_type_and_panels_keep_their_size_at_any_width(written):
    runs, methods = chosen(written, *TAGGED)
    for width in (COLUMN, TEXT):
        figure = figure_metrics(runs, methods, ["return"], width)
        (axes,) = figure.axes
        texts = [axes.xaxis.label, axes.yaxis.label, *axes.get_xticklabels()]
        texts += figure.legends[0].get_texts()
        assert {text.get_fontsize() for text in texts} == {8.0}
        figure.draw_without_rendering()
        assert axes.get_window_extent().height / figure.dpi > 1.0
        box = figure.legends[0].get_window_extent()
        assert box.x0 >= 0 and box.x1 <= width * figure.dpi


def test_the_named_variants_are_drawn_and_differ_in_grey(written):
    runs, methods = chosen(written, *TAGGED)
    figure = figure_metrics(runs, methods, ["return"], COLUMN)
    assert legend_of(figure) == [*TAGGED, "optimum of the target"]
    axes = figure.axes[0]
    means = [line for line in axes.lines if line.get_marker() != "None"]
    for name, line in zip(TAGGED, means, strict=True):
        tables = [pd.read_csv(p) for p in (written / "smoke/maze" / name).glob("*.csv")]
        expected = np.mean([table["return"] for table in tables], axis=0)
        np.testing.assert_allclose(line.get_ydata(), expected)
        assert line.get_color() == style.colour(name)
    looks = {(x.get_marker(), x._unscaled_dash_pattern) for x in means}
    assert len(looks) == len(TAGGED)


def test_every_method_has_a_look_of_its_own_without_colours():
    names = [
        "FQI",
        "C-FQI",
        "B-FQI",
        "BC-FQI",
        "SC-DQN",
        "SBC-DQN",
        "RPL",
        "PPR",
        "OWN",
    ]
    names += [f"BC-FQI@{n}" for n in range(5)]
    looks = style.lines_of(names)
    assert len({(x["linestyle"], x["marker"]) for x in looks.values()}) == len(names)
    assert {looks[name]["color"] for name in names[-5:]} == {style.colour("BC-FQI")}
    assert style.lines_of(["BC-FQI"])["BC-FQI"] == looks["BC-FQI"]
    labels = ["RPL@a", "RPL (maze)", "RPL, steps=5", "RPL"]
    assert {style.colour(label) for label in labels} == {looks["RPL"]["color"]}


@pytest.mark.parametrize(
    ("names", "shaded"),
    [(("C-FQI", "BC-FQI@a"), 10), (("FQI", "BC-FQI"), 0), (("FQI", "B-FQI"), 0)],
)
def test_tasks_are_shaded_where_they_are_those_of_all_curves(written, names, shaded):
    runs, methods = chosen(written, *names)
    figure = figure_metrics(runs, methods, ["return"], TEXT)
    named = [text for text in figure.axes[0].texts if text.get_text()[0] == "T"]
    assert len(named) == shaded
    assert ("tasks" in figure.get_label()) == bool(shaded)
    dotted = [line for line in figure.axes[0].lines if line.get_linestyle() == ":"]
    assert len(dotted) == (0 if shaded else 9 * ("BC-FQI" in names))
    assert ("dotted" in figure.get_label()) == bool(dotted)
    assert "bootstrap" in figure.get_label()


def test_runs_of_any_folder_can_be_compared(written, tmp_path):
    write_fqi(tmp_path / "other", "maze", seeds=2, methods=("BC-FQI",))
    far = tmp_path / "other/smoke/maze/BC-FQI"
    runs, methods = chosen(written, f"{far}/", "BC-FQI", env="maze")
    assert [variant.folder for variant in methods.values()] == [
        far,
        written / "smoke/maze/BC-FQI",
    ]
    assert len(methods) == 2 and all("BC-FQI (" in name for name in methods)
    figure = figure_metrics(runs, methods, ["q_error"], COLUMN)
    (first, second), note = methods, figure.get_label()
    assert f"seeds differ: 0–1: {first}; 0–2: {second}" in note


def test_a_linked_variant_is_read_by_its_own_name(written, tmp_path, monkeypatch):
    stored, link = tmp_path / "stored/1", tmp_path / "linked/smoke/maze/BC-FQI@a"
    shutil.copytree(written / "smoke/maze/BC-FQI@a", stored)
    link.parent.mkdir(parents=True)
    link.symlink_to(stored)
    monkeypatch.chdir(tmp_path)
    for name in ("linked/smoke/maze/BC-FQI@a", "./linked/smoke/../smoke/maze/BC-FQI@a"):
        (variant,) = chosen(written, name)[1].values()
        assert (variant.folder, variant.tag) == (link, "a")


def test_a_tag_is_told_unless_a_label_ends_with_it():
    runs = {"return": np.ones((1, 1))}
    bare, whole = in_memory("maze/FQI@Q", runs), in_memory("maze/BC-FQI@Q", runs)
    assert tags_shown({"FQI": bare}) == "variants @Q"
    assert tags_shown({"FQI": bare, "BC-FQI@Q (quick)": whole}) == "@Q: FQI"
    assert tags_shown({"BC-FQI@Q": whole}) == ""


def test_patterns_name_several_variants_once(written):
    found = folders_of(written, "smoke", None, ["BC-FQI@b", "BC-FQI*"])
    assert [path.name for path in found] == ["BC-FQI@b", "BC-FQI", "BC-FQI@a"]


def test_steps_are_counted_for_dqn_and_a_target_can_be_drawn_alone(written):
    runs, methods = chosen(written, "DQN", "BC-DQN")
    figure = figure_metrics(runs, methods, ["return"], COLUMN, target_only=True)
    assert figure.axes[0].get_xlabel() == "environment steps"
    starts = [line.get_xdata()[0] for line in figure.axes[0].lines]
    assert starts == [500, 2000] and figure.axes[0].get_xlim()[0] < 0
    assert "exploring: with random actions" in figure.get_label()


WRONG = [
    (["--compare", "BC-FQ"], ["BC-FQ:", "BC-FQI?", "maze: B-FQI, BC-FQI, BC-FQI@a"]),
    (["--compare", "BC-FQI", "DQN"], ["DQN", "maze"]),
    (
        ["--sweep", "algorithm.episodes", "--env", "mase"],
        ["mase", "linear_system, maze"],
    ),
    (["--compare", "./nowhere"], ["nowhere", "is not a folder"]),
    (["--compare", "FQI", "--metrics", "retrun"], ["retrun", "return", "solved"]),
    (["--compare", "FQI", "--width", "wide"], ["wide", "column", "text"]),
    (["--compare", "FQI", "--format", "gif"], ["gif", "png, pdf, svg"]),
    (["--compare", "FQI", "--tag", "a"], ["--tag"]),
    (["--metrics", "return"], ["--metrics", "--compare"]),
    (["--sweep", "algorithm.episode", "env=maze"], ["algorithm.episode:"]),
    (["--sweep", "a", "b", "c", "env=maze"], ["a b c", "two"]),
]


@pytest.mark.parametrize(("words", "told"), WRONG)
def test_what_is_not_there_gets_an_error_that_lists_what_is(
    written, tmp_path, capsys, words, told
):
    assert report(written, *words, "--out", str(tmp_path / "out")) == 2
    error = capsys.readouterr().err
    assert all(text in error for text in told)
    assert not list(tmp_path.glob("out/*"))


def test_two_counters_are_not_drawn_in_one_figure(written, capsys):
    paths = [str(written / "smoke/maze/FQI"), str(written / "smoke/linear_system/DQN")]
    assert report(written, "--compare", *paths) == 2
    assert "iterations" in capsys.readouterr().err


def test_figures_across_environments_have_all_remarks_and_no_ones_optimum(tmp_path):
    write_fqi(tmp_path, "maze", seeds=2, methods=("FQI",))
    write_fqi(tmp_path, "car_on_hill", seeds=2, methods=("FQI", "BC-FQI"))
    reseal(seed_path(tmp_path / "smoke/car_on_hill/FQI", 1, "json"), status="running")
    folders = [str(tmp_path / "smoke" / x) for x in ("maze/FQI", "car_on_hill/FQI")]
    runs = load_chosen([*map(Path, folders)], allow_incomplete=True)
    methods = labelled(runs.variants)
    figure = figure_metrics(runs, methods, ["return"], COLUMN)
    assert "INCOMPLETE: car_on_hill FQI 1 of 2 seeds" in figure.get_label()
    assert legend_of(figure) == [*methods]
    alone = dict([*methods.items()][:1])
    figure = figure_metrics(runs, alone, ["return"], COLUMN)
    assert legend_of(figure)[-1] == "optimum of the target"
    assert "INCOMPLETE" not in figure.get_label()


def test_a_caption_of_its_own_file_leaves_what_is_incomplete_in_the_figure(
    tmp_path, capsys
):
    write_fqi(tmp_path, "maze", seeds=3, methods=("FQI", "C-FQI"))
    reseal(seed_path(tmp_path / "smoke/maze/FQI", 1, "json"), status="running")
    words = ["--compare", "FQI", "--metrics", "return", "--format", "svg"]
    assert report(tmp_path, *words) == 2
    assert "--allow-incomplete" in capsys.readouterr().err
    assert report(tmp_path, "--compare", "C-FQI", *words[2:]) == 0  # is complete
    words += ["--caption-file", "--name", "mine", "--allow-incomplete"]
    assert report(tmp_path, *words) == 0
    text = (tmp_path / "figures/mine_return.txt").read_text()
    assert "INCOMPLETE: FQI 2 of 3 seeds" in text and "bootstrap" in text
    svg = (tmp_path / "figures/mine_return.svg").read_text()
    drawn = re.findall(r"<!-- (.+?) -->", svg)  # each text is also a comment
    assert any("INCOMPLETE" in line for line in drawn)
    assert not any("bootstrap" in line for line in drawn)


def write_sweep(root: Path, settings: dict[str, dict], method: str = "FQI") -> None:
    """A variant per tag, whose last return is minus its number of episodes."""
    for tag, algorithm in settings.items():
        config = {"algorithm": {"name": "fqi", "episodes": 5, "loss": "l2"} | algorithm}
        plan = made_up_plan(root, "mine", f"{method}@{tag}", range(3), config=config)
        last = -config["algorithm"]["episodes"]
        rows = {"stage": 1, "task": 1, "iteration": [1, 2], "return": [-9.0, last]}
        write_seeds(plan, lambda seed, rows=rows: pd.DataFrame(rows))


def test_a_sweep_is_coloured_by_value_and_its_ends_have_a_logarithmic_axis(tmp_path):
    episodes = {"d": 1000, "b": 10, "a": 1, "c": 100}
    write_sweep(tmp_path, {tag: {"episodes": n} for tag, n in episodes.items()})
    runs, methods = chosen(tmp_path, "*")
    (sweep,) = sweeps_of([*methods.values()], ["algorithm.episodes"])
    figure = figure_sweep(runs, sweep, "return", COLUMN)
    assert legend_of(figure) == ["1", "10", "100", "1000"]
    colours = [to_hex(line.get_color()) for line in figure.axes[0].lines]
    greys = [
        np.dot([0.3, 0.6, 0.1], Image.new("RGB", (1, 1), c).getpixel((0, 0)))
        for c in colours
    ]
    assert greys == sorted(greys) and len(set(greys)) == 4
    axes = figure_final(runs, [sweep], "return", COLUMN).axes[0]
    line = axes.lines[0]
    assert axes.get_xscale() == "log"
    assert [*line.get_xdata()] == [1, 10, 100, 1000]
    assert [*line.get_ydata()] == [-1, -10, -100, -1000]


def test_many_values_have_a_colour_bar_and_words_an_axis_of_their_own(tmp_path):
    write_sweep(tmp_path, {f"e{2**n}": {"episodes": 2**n} for n in range(7)})
    runs, methods = chosen(tmp_path, "*")
    (sweep,) = sweeps_of([*methods.values()], ["algorithm.episodes"])
    figure = figure_sweep(runs, sweep, "return", COLUMN)
    assert not figure.legends and figure.axes[1].get_ylabel() == "algorithm.episodes"
    figure.draw_without_rendering()
    named = {text.get_text() for text in figure.axes[1].get_yticklabels()}
    assert named >= {"1", "2", "5", "10", "20", "50"}
    losses = {"x": {"loss": "l1"}, "y": {"loss": [2, 3]}}
    write_sweep(tmp_path, losses, "C-FQI")
    runs, methods = chosen(tmp_path, "C-FQI*")
    sweeps = sweeps_of([*methods.values()], ["algorithm.loss"])
    axes = figure_final(runs, sweeps, "return", COLUMN).axes[0]
    assert axes.get_xscale() == "linear"
    assert [t.get_text() for t in axes.get_xticklabels()] == ["[2, 3]", "l1"]


def test_two_keys_give_a_map_and_other_settings_sweeps_of_their_own(tmp_path, capsys):
    cells = [(n, loss) for n in (5, 50) for loss in ("l1", "l2")][:3]
    write_sweep(tmp_path, {f"{n}{x}": {"episodes": n, "loss": x} for n, x in cells})
    runs, methods = chosen(tmp_path, "*")
    both = ["algorithm.episodes", "algorithm.loss"]
    (sweep,) = sweeps_of([*methods.values()], both)
    axes, bar = figure_map(runs, sweep, "return", COLUMN).axes
    np.testing.assert_array_equal(
        axes.images[0].get_array().filled(np.nan), [[-5, -50], [-5, np.nan]]
    )
    assert {text.get_text() for text in axes.texts} == {"−5.00", "−50.0", "–"}
    assert bar.get_ylabel() == "discounted return"
    write_sweep(tmp_path, {"rest": {"episodes": 50, "loss": "l2"}})
    methods = chosen(tmp_path, "*")[1]
    labels = [s.label for s in sweeps_of([*methods.values()], both[:1])]
    assert sorted(labels) == ["FQI, loss=l1", "FQI, loss=l2"]
    with pytest.raises(
        BcrlError, match=r"env\.name.*algorithm\.episodes and algorithm\.loss"
    ):
        sweeps_of([*methods.values()], ["env.name"])
    words = ["--sweep", *both, "--metrics", "return", "--format", "svg"]
    assert report(tmp_path, *words) == 0
    (path,) = capsys.readouterr().out.split()
    assert Path(path).name == "sweep_mine_smoke_FQI_return.svg"


def test_one_diverging_method_is_cut_off_and_a_success_is_not(tmp_path):
    curves = {"A": np.array([-50.0, -40]), "B": np.array([-60.0, -45])}
    assert style.strays("return", curves | {"C": np.array([-50.0, -1e6])}) == ["C"]
    assert style.strays("return", curves | {"C": np.array([-1e6]), "D": -curves["A"]})
    weak = {"A": np.array([0.0, 1e-4]), "B": np.array([0.0, 0.0])}
    assert style.strays("return", weak | {"C": np.array([0.0, 0.9])}) == []
    assert style.strays("loss", weak | {"C": np.array([0.0, 0.9])}) == ["C"]
    assert style.strays("loss", {"A": np.array([np.nan]), "B": np.array([1.0])}) == []

    def far(env, method, seed, stage):
        found = as_claimed(env, method, seed, stage)
        if method == "C-FQI":
            found["return"] = found["return"] * 1e6
        return found

    write_fqi(tmp_path, "maze", seeds=2, curves=far)
    runs, methods = chosen(tmp_path, "FQI", "C-FQI", "B-FQI")
    axes = figure_metrics(runs, methods, ["return"], COLUMN).axes[0]
    assert axes.get_ylim()[0] > -200
    assert "cut: C-FQI diverges" in {text.get_text() for text in axes.texts}


def test_sweeps_have_different_labels_and_short_file_names(tmp_path, capsys):
    """Of two keys with the same end, and of long lists with the same begin."""
    for tag in range(8):
        on = {"name": "on" if tag // 2 % 2 else "off"}
        env = {"metrics": ["return"], "tasks": {"x": [0.5] * 20 + [tag // 4]}}
        config = {"algorithm": {"name": "fqi", "episodes": tag % 2}, "boosting": on}
        config |= {"curriculum": on, "env": {"name": "mine"} | env}
        plan = made_up_plan(tmp_path, "mine", f"FQI@{tag}", range(1), config=config)
        rows = {"stage": 1, "task": 1, "iteration": [1], "return": [tag]}
        write_seeds(plan, lambda seed, rows=rows: pd.DataFrame(rows))
    words = ["--sweep", "algorithm.episodes", "--format", "svg", "--name", "n" * 100]
    assert report(tmp_path, *words) == 0
    names = [Path(line).name for line in capsys.readouterr().out.split()]
    assert len(set(names)) == 5 and max(map(len, names)) < 130
    variants = chosen(tmp_path, "*")[1].values()
    labels = [s.label for s in sweeps_of([*variants], ["algorithm.episodes"])]
    assert len(set(labels)) == 4 and max(map(len, labels)) < 120
    assert all("boosting.name=o" in x and "curriculum.name=o" in x for x in labels)


def test_values_that_differ_little_have_labels_of_their_own():
    values = [0.001, 1000000, 1234567, 1234568.0, 1e20, 0.1 + 0.2]
    texts = ["0.001", "1000000", "1234567", "1234568", "1e+20", "0.30000000000000004"]
    made = {
        (v,): in_memory(f"maze/FQI@{v}", {"return": np.ones((2, 1))}) for v in values
    }
    sweep = Sweep("FQI", ("algorithm.episodes",), made)
    assert [*sweep.methods] == texts
    frame = pd.DataFrame({"learner.x": values, "return": 0.5})
    frame = frame.assign(method="FQI", seed=0, stage=1, task=1, iteration=1)
    labels = legend_of(figure_frame(frame, "return"))
    assert labels == [f"FQI x={text}" for text in texts]


@pytest.mark.filterwarnings("error")
def test_a_map_without_values_has_no_colour_bar():
    nothing = {"loss": np.full((2, 1), np.nan)}
    cells = {(x, y): in_memory(f"maze/FQI@{x}{y}", nothing) for x in "ab" for y in "cd"}
    figure = figure_map(
        Runs("smoke", ()), Sweep("FQI", ("k", "l"), cells), "loss", TEXT
    )
    figure.draw_without_rendering()
    assert len(figure.axes) == 1
    assert {text.get_text() for text in figure.axes[0].texts} == {"–"}


def test_a_variant_looks_alike_in_the_figures_of_all_metrics():
    """Also where one of the others lacks a metric."""
    drawn = {"return": np.ones((1, 2)), "solved": np.ones((1, 2))}
    some = {"a": {"return": drawn["return"]}, "b": drawn, "c": drawn}
    methods = {f"FQI@{x}": in_memory(f"maze/FQI@{x}", m) for x, m in some.items()}
    how = Namespace(target_only=False)
    runs = Runs("smoke", (*methods.values(),))
    figures = dict(_compared(runs, methods, ["return", "solved"], TEXT, how))

    def looks(lines) -> list[tuple]:
        marked = [line for line in lines if line.get_marker() != "None"]
        return [(x.get_marker(), x._unscaled_dash_pattern) for x in marked]

    first, second = (looks(figure.axes[0].lines) for figure in figures.values())
    assert first[1:] == second and len({*first}) == 3
    assert looks(figures["solved"].legends[0].legend_handles) == second


def test_equal_seeds_have_a_final_value_without_an_interval():
    """The mean of 30 such values is a bit apart from each of them."""
    returns = {"return": np.full((30, 1), -46.90944570448864)}
    both = {(n,): in_memory(f"maze/FQI@{n}", returns) for n in (1, 2)}
    sweep = Sweep("FQI", ("algorithm.episodes",), both)
    axes = figure_final(Runs("smoke", ()), [sweep], "return", COLUMN).axes[0]
    assert axes.lines[0].get_ydata() == pytest.approx(returns["return"][:2, 0])
