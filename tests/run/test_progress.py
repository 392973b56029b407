"""Many jobs in one pool: their order, what is left to go, the closing table."""

import numpy as np
import pytest

from bcrl.errors import BcrlError
from bcrl.run import costs, runner
from bcrl.run.progress import SILENCE, TRUST, Job, Progress, Tick
from tests.conftest import plan, plans

FIGURES = ("experiment=fig1,fig2,fig4", "scale=paper", "workers=2")


def job(kind: str, seconds: float) -> Job:
    return Job(kind, kind, (0,), 10, "step", seconds)


def test_a_sweep_over_experiments_is_all_of_their_jobs():
    found = plans(*FIGURES, multirun=True)
    assert len(found) == 4 + 4 + 7
    assert sum(len(p.seeds) for p in found) == 4 * 20 + 4 * 40 + 7 * 100  # all 940 runs
    again = plans("experiment=fig2,fig3", "scale=smoke", multirun=True)
    assert {p.directory for p in again} == {p.directory for p in again[:4]}


def test_a_launcher_gets_one_experiment_at_a_time():
    with pytest.raises(BcrlError, match="one at a time"):
        plans("experiment=fig1,fig2", "hydra/launcher=slurm", multirun=True)
    assert not any(made.launched for made in plans("experiment=fig2"))


def test_plans_in_one_pool_write_what_they_write_alone(tmp_path):
    small = ("scale=smoke", "seeds.count=2", "progress=none")
    maze = ("env=maze", "curriculum=on", "boosting=on", "algorithm.regressor.trees=3")
    system = ("env=linear_system", "algorithm=dqn", "variant=BC")
    for folder, workers in (("alone", 1), ("together", 2)):
        out = (*small, f"runs_dir={tmp_path / folder}", f"workers={workers}")
        both = [plan(*choice, *out) for choice in (maze, system)]
        if workers == 2:
            runner.run(*both)
        else:
            for each in both:
                runner.run(each)
    files = sorted((tmp_path / "alone").rglob("seed_*.*"))
    files = [file for file in files if file.suffix in (".csv", ".npz")]
    assert len(files) == 2 * 2 * 2
    for file in files:
        other = tmp_path / "together" / file.relative_to(tmp_path / "alone")
        assert file.read_bytes() == other.read_bytes(), file


def test_the_longest_jobs_come_first_and_each_seed_once(tmp_path):
    out = ("progress=none", f"runs_dir={tmp_path}")
    both = plans(*FIGURES[:1], "scale=quick", "workers=2", *out, multirun=True)
    work = runner.ordered([*runner.merged([*both, *both])], {})
    expected = [len(seeds) * costs.expected(plan) for plan, seeds in work]
    assert expected == sorted(expected, reverse=True)
    seeds = [(plan.directory, seed) for plan, group in work for seed in group]
    assert len(seeds) == len(set(seeds)) == 15 * 3


def test_what_is_left_is_a_schedule_of_what_is_expected():
    jobs = [job("a", 60.0), job("a", 50.0), job("b", 40.0), job("b", 10.0)]
    progress = Progress(jobs, 2, "none")
    assert progress.to_go() == pytest.approx(90.0)  # 60 + 10 beside 50 + 40
    for number, spent in ((0, 120.0), (1, 100.0)):  # twice as slow as expected
        progress.tick(Tick(number, 1, 10, spent))
    slower = (220.0 + TRUST) / (110.0 + TRUST)
    assert progress.to_go() == pytest.approx(40.0 * slower)
    progress.tick(Tick(2, 1, 5, 20.0))  # but this kind is as fast as expected
    assert progress.to_go() == pytest.approx(20.0)


def test_the_estimate_is_right_when_the_model_is_off_by_a_factor():
    rng = np.random.default_rng(0)
    jobs = [job("a", s) for s in sorted(rng.uniform(50, 100, 20), reverse=True)]
    progress, clock = Progress(jobs, 2, "none"), [0.0, 0.0]
    for number, each in enumerate(jobs):
        clock[np.argmin(clock)] += 1.5 * each.seconds
        progress.tick(Tick(number, 1, 10, 1.5 * each.seconds))
        if number == 5:
            early = clock[np.argmin(clock)] + progress.to_go()
    assert early == pytest.approx(max(clock), rel=0.1)


def test_the_closing_table_counts_every_run(bcrl, tmp_path):
    small = ("scale=smoke", "seeds.count=1", "algorithm/regressor=tabular", "tag=t")
    sweep = ("-m", "env=maze", "curriculum=on,off", *small)
    for _ in range(2):  # the second finds all complete
        done = bcrl(*sweep)
        assert done.returncode == 0, done.stderr
        lines = [line.split() for line in done.stderr.splitlines()]
        assert [line[:4] for line in lines if line[:1] == ["maze"]][-2:] == [
            ["maze", "C-FQI@t", "1", "0"],
            ["maze", "FQI@t", "1", "0"],
        ]
        assert "peak memory" in done.stderr


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("experiment=fig1,fig11", "fig11"),
        ("experiment=interval(0,1)", "fig1"),
    ],
)
def test_experiments_that_cant_be_are_refused(given, said):
    with pytest.raises(BcrlError, match=said):
        plans(given, multirun=True)


def test_the_directories_two_experiments_share_are_planned_once():
    both = plans("experiment=fig2,fig3,fig5", "scale=smoke", multirun=True)
    once = [*runner.merged(both)]
    assert (len(both), len(once)) == (9, 4)
    more = plans("env=maze", "seeds.count=1,3", multirun=True)
    assert [p.seeds for p in runner.merged(more)] == [(0, 1, 2)]


def test_a_line_is_due_after_a_while_of_silence(monkeypatch, capsys):
    now = [1000.0]
    monkeypatch.setattr("bcrl.run.progress.time.monotonic", lambda: now[0])
    progress = Progress([job("a", 1000.0)], 1, "lines")
    progress.tick(Tick(0, 1, 0, 0.0))
    assert not capsys.readouterr().err
    now[0] += SILENCE
    progress.tick(Tick(0, 1, 0, SILENCE))
    assert "step 0/10 · seed 0" in capsys.readouterr().err
