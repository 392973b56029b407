"""bcrl-inspect: its numbers against the run's own, and what it can't look into."""

import numpy as np
import pandas as pd
import pytest

import bcrl
from bcrl.inspection import cli
from bcrl.inspection.measures import UPTO, WHOLE, WITHOUT, Inspection, values
from bcrl.inspection.stack import stack
from bcrl.report import cli as report
from bcrl.results.layout import INSPECTION
from bcrl.results.tables import read_results
from tests.run.runs import DQN, FQI, MAZE, SHORT, run

CART = ("env=cart_pole", "algorithm=fqi", "variant=BC", *FQI, "env.horizon=20")
KINDS = {
    "maze": MAZE,
    "maze, shaped": ("env=maze", "variant=SBC", *FQI),
    "maze, scaled": (*MAZE, "boosting.alpha=0.5"),
    "forests": (*SHORT, "variant=BC"),
    "point mass": (*DQN, "variant=BC_line_search"),
    "point mass, shaped": (*DQN, "variant=SBC"),
    "gymnasium": CART,
}


@pytest.fixture(scope="module", params=KINDS)
def inspected(request, tmp_path_factory):
    """A run, and the inspection of its seed 1."""
    made = run(tmp_path_factory.mktemp("runs"), *KINDS[request.param])
    return made, Inspection(stack(made.directory, 1), episodes=2)


def test_the_sum_of_the_residuals_is_the_agents_q(inspected):
    made, own = inspected
    npz = np.load(made.directory / "seed_0001.npz")
    found = values(
        own.stack.upto(len(made.stages)), npz["states"], made.target.n_actions
    )
    recorded = bcrl.load(made.directory, 1).q(npz["states"])
    assert np.allclose(found, recorded, rtol=1e-12, atol=1e-9)


def test_contributions_are_parts_of_the_value(inspected):
    made, own = inspected
    states = own.visits[-1].points[:50]
    total = sum(own.contributions(states))
    value = bcrl.load(made.directory, 1).q(states).max(-1)
    if own.stack.shaped:  # it has the potential, too
        assert not np.allclose(total, value)
    else:
        assert np.allclose(total, value)


def test_errors_and_returns_are_those_of_the_csv(inspected):
    made, own = inspected
    rows = read_results(made.directory)
    rows = rows[rows.seed == 1].groupby("stage").last()
    stages = own.stages().set_index("stage")
    if "q_error" in rows:
        assert np.allclose(stages.q_error, rows.q_error)
    if "alpha" in rows:
        assert np.array_equal(stages.alpha, rows.alpha, equal_nan=True)
    ablations = own.ablations()
    whole = ablations[ablations.kind == WHOLE].iloc[0]
    if made.env in ("maze", "car_on_hill"):
        last = rows["return"].iloc[-1]
        assert whole.discounted_return == pytest.approx(last, rel=0.1, abs=0.05)
    n = len(made.stages)
    assert ablations.kind.value_counts().to_dict() == {
        WHOLE: 1,
        WITHOUT: n,
        UPTO: n - 1,
    }
    assert whole.greedy_changed == 0.0
    without = ablations[(ablations.kind == WITHOUT) & (ablations.stage == n)].iloc[0]
    upto = ablations[(ablations.kind == UPTO) & (ablations.stage == n - 1)].iloc[0]
    if own.stack.alphas[-1] == 1.0 and not own.stack.shaped:  # the same Q
        assert without.iloc[3:].equals(upto.iloc[3:].rename(without.name))


def test_the_data_are_the_runs_own(inspected):
    """FQI's last fit had these rows."""
    _, own = inspected
    for seen, q in zip(own.visits, own.stack.residuals, strict=True):
        assert seen.multiplicity.sum() > 0 and len(seen.points) > 1
        for a, fitted in enumerate(getattr(q, "models", [[]])[0]):
            rows = seen.points[seen.state[seen.action == a]]
            assert np.array_equal(fitted.problem.x, np.float32(rows))


def test_the_command_writes_tables_and_figures(inspected, capsys):
    made, _ = inspected
    assert cli.main([str(made.directory), "--episodes", "2", "--format", "png"]) == 0
    out = made.directory / INSPECTION
    names = {path.name for path in out.iterdir()}
    assert names >= {"stages.csv", "ablations.csv", "stages.png", "maps.png"}
    table = pd.read_csv(out / "stages.csv")
    assert set(table.seed) == {0, 1} and len(table) == 2 * len(made.stages)
    assert (table.residual_l1 <= table.residual_l2 + 1e-12).all()
    assert (table.residual_l2 <= table.residual_sup + 1e-12).all()
    assert "residual_l2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("variant=C",), "no boosting"),
        (("variant=BC", "keep=none"), "no agents"),
        (("variant=BC", "boosting.fold=always"), "keep=stages"),
    ],
)
def test_what_has_no_residuals_gets_one_sentence(words, why, tmp_path, capsys):
    made = run(tmp_path, "env=maze", *FQI, *words)
    assert cli.main([str(made.directory)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert why in line


def test_other_bad_input(tmp_path, capsys):
    made = run(tmp_path, *MAZE)
    for words, why in (
        (["nowhere"], "nowhere"),
        ([made.directory, "--seed", "7"], "seeds 0–1"),
        ([made.directory, "--components", "0", "2"], "two of 0 to 1"),
        ([made.directory, "--episodes", "0"], "at least 1"),
    ):
        assert cli.main([str(word) for word in words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert why in line


def test_folded_runs_that_keep_stages_are_shown_as_they_learned(tmp_path):
    made = run(tmp_path, *MAZE, "boosting.fold=always", "keep=stages")
    own = stack(made.directory, 0)
    assert own.folded and len(own.residuals) == len(made.stages)


def test_the_reports_page_shows_the_figures(tmp_path):
    made = run(tmp_path, *MAZE)
    assert cli.main([str(made.directory), "--seed", "0", "--format", "png"]) == 0
    assert report.main(["--runs-dir", str(tmp_path), "--scale", "smoke"]) == 0
    page = (tmp_path / "figures" / "report_smoke.html").read_text()
    section = page.partition('<section id="residuals">')[2].partition("</section>")[0]
    assert section.count("<img") == 3 and "Maze: BC-FQI" in section
