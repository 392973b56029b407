"""Many jobs in one pool: their order and parts, the time to go, damaged results."""

import json
import os
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from bcrl import api
from bcrl.config.plan import part
from bcrl.errors import BcrlError
from bcrl.results.layout import recorded_seeds, seed_path
from bcrl.run import costs, progress, records, runner, status
from bcrl.run.origin import run_origin
from bcrl.run.progress import Progress, Tick
from bcrl.run.schedule import merged, ordered
from bcrl.run.workers import cores, do_jobs
from tests.conftest import arguments, plan, plans
from tests.results.made_up import made_up_plan, write_seeds
from tests.run.light import work
from tests.run.runs import FQI, MAZE, results, run


def job(family: str, seconds: float):
    made = SimpleNamespace(env="maze", name="BC", family=family, length=10)
    return SimpleNamespace(plan=made, seeds=(0,), seconds=seconds)


# --- order and parts ---


@pytest.mark.slow
def test_plans_in_one_pool_write_what_they_write_alone(tmp_path):
    system = ("env=linear_system", "algorithm=dqn", "variant=BC", *FQI)
    for folder, workers in (("alone", 1), ("together", 2)):
        out = (f"runs_dir={tmp_path / folder}", f"workers={workers}")
        both = [plan(*choice, *out) for choice in (MAZE, system)]
        for some in [both] if workers == 2 else [both[:1], both[1:]]:
            runner.run(*some)
    for p in both:
        name = p.directory.relative_to(tmp_path / "together")
        other = SimpleNamespace(directory=tmp_path / "alone" / name)
        assert [results(p, s) for s in (0, 1)] == [results(other, s) for s in (0, 1)]


def test_the_longest_jobs_come_first_and_each_seed_once(tmp_path):
    figures = ("experiment=fig2", "scale=quick", "workers=2")
    both = plans(*figures, f"runs_dir={tmp_path}", multirun=True)
    work = ordered(merged([*both, *both]), {})
    expected = [len(each.seeds) * costs.expected(each.plan) for each in work]
    assert expected == sorted(expected, reverse=True)
    seeds = [(each.plan.directory, seed) for each in work for seed in each.seeds]
    assert len(seeds) == len(set(seeds)) == 4 * 3


def test_the_parts_of_seeds_are_all_of_them_once():
    for count in (1, 2, 7, 20):
        seeds = tuple(range(count))
        for parts in range(1, count + 1):
            each = [part(seeds, f"{k}/{parts}") for k in range(1, parts + 1)]
            assert sum(each, ()) == seeds and all(each)
    second = plan("env=maze", "seeds.first=10", "seeds.count=5", "seeds.part=2/2")
    assert second.seeds == (12, 13, 14) and second.asked == tuple(range(10, 15))
    assert second.directory == plan("env=maze").directory
    whole = plans("env=maze", "seeds.count=5", "seeds.part=1/2,2/2", multirun=True)
    assert [p.seeds for p in merged(whole)] == [(0, 1, 2, 3, 4)]


@pytest.mark.slow
def test_a_sweep_over_experiments_is_all_of_their_jobs():
    found = plans("experiment=fig1,fig2,fig4", "scale=paper", multirun=True)
    assert len(found) == 4 + 4 + 7
    assert sum(len(p.seeds) for p in found) == 4 * 20 + 4 * 40 + 7 * 100  # all 940 runs


@pytest.mark.parametrize("name", ["fig1,fig11", "interval(0,1)"])
def test_an_unknown_experiment_is_rejected(name):
    with pytest.raises(BcrlError, match=r"fig11|interval"):
        plans(f"experiment={name}", multirun=True)


@pytest.mark.parametrize("part", ["0/2", "3/2", "1/4", "1", "a/b", "1/0", "-1/2"])
def test_an_invalid_part_is_rejected(part):
    with pytest.raises(BcrlError, match=r"seeds\.part"):
        plan("env=maze", "seeds.count=3", f"seeds.part={part}")


def test_plans_of_one_directory_are_one(tmp_path):
    both = plans("experiment=fig2,fig3,fig5", "scale=smoke", multirun=True)
    assert (len(both), len(merged(both))) == (9, 4)
    out = (*FQI, "algorithm/regressor=tabular", f"runs_dir={tmp_path}")
    parts = [plan("env=maze", *out, f"seeds=[{seed}]") for seed in (0, 2)]
    runner.run(*parts)
    asked = json.loads((parts[0].directory / "seed_0002.json").read_text())["asked"]
    assert asked == [[0, 0], [2, 2]]
    (one,) = merged(parts)
    assert one.command.splitlines() == [each.command for each in parts]


# --- the time to go ---


def test_the_time_to_go_is_a_schedule_of_expected_times():
    jobs = [job(*each) for each in (("a", 60), ("a", 50), ("b", 40), ("b", 10))]
    shown = Progress(jobs, 2, "none")
    assert shown.to_go() == pytest.approx(90.0)  # 60 + 10 beside 50 + 40
    for number, spent in ((0, 120.0), (1, 100.0)):  # twice as slow as expected
        shown.tick(number, Tick(1, 10, spent))
    slower = (220.0 + progress._PRIOR) / (110.0 + progress._PRIOR)
    assert shown.to_go() == pytest.approx(40.0 * slower)
    shown.tick(2, Tick(1, 5, 20.0))  # as fast as expected, half done
    slower = (240.0 + progress._PRIOR) / (130.0 + progress._PRIOR)
    assert shown.to_go() == pytest.approx(20.0 * slower)


def test_the_estimate_is_right_when_the_model_is_off_by_a_factor():
    rng = np.random.default_rng(0)
    jobs = [job("a", s) for s in sorted(rng.uniform(50, 100, 20), reverse=True)]
    shown, clock = Progress(jobs, 2, "none"), [0.0, 0.0]
    for number, each in enumerate(jobs):
        clock[np.argmin(clock)] += 1.5 * each.seconds
        shown.tick(number, Tick(1, 10, 1.5 * each.seconds))
        if number == 5:
            early = clock[np.argmin(clock)] + shown.to_go()
    assert early == pytest.approx(max(clock), rel=0.1)


def test_a_line_is_due_after_a_while_of_silence(monkeypatch, capsys):
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    shown = Progress([job("DQN", 1000.0)], 1, "lines")
    shown.tick(0, Tick(1, 0, 0.0))
    assert not capsys.readouterr().err
    now[0] += progress._SILENCE
    shown.tick(0, Tick(1, 0, progress._SILENCE))
    assert "step 0/10 · seed 0" in capsys.readouterr().err


def test_a_bar_that_cannot_be_is_lines(monkeypatch, capsys):
    class Refuses(progress.tqdm):
        def __init__(self, **_):
            raise ValueError("could not convert string to float: 'abc'")  # TQDM_…=abc

        def __del__(self): ...

    monkeypatch.setattr(progress, "tqdm", Refuses)
    shown = Progress([job("a", 1.0)], 1, "bar")
    shown.tick(0, Tick(1, 10, 1.0))
    shown.close()
    assert "100%" in capsys.readouterr().err


# --- processes ---


def test_a_process_that_dies_loses_its_job_and_is_replaced():
    reports: list[tuple[int, int]] = []
    stop = SimpleNamespace(requested=False)
    found = dict(
        do_jobs(work, [0, 1, 2, 3], 1, lambda *each: reports.append(each), stop)
    )
    assert found == {0: 0, 1: "its process ended with exit code 3", 2: 20, 3: 30}
    assert reports == [(number, number) for number in range(4)]


@pytest.mark.parametrize("value", ["1", "4096", "", "0", "-1", "2(x3)", "abc", " "])
def test_the_cores_are_those_that_slurm_has_given(value, monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", value)
    assert cores() == (1 if value == "1" else len(os.sched_getaffinity(0)))


# --- results that were changed ---


def made(folder: Path, seeds: range):
    columns = {"stage": 1, "task": 1, "iteration": [1, 2]}
    result = made_up_plan(folder, "hill", "BC-FQI", seeds)
    write_seeds(result, lambda seed: pd.DataFrame(columns | {"return": [0.5, seed]}))
    return result


def replaced(old: str, new: str):
    return lambda path: path.write_text(path.read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        ("csv", replaced("0.5", "0.6")),
        ("csv", Path.unlink),
        ("npz", lambda path: path.write_bytes(path.read_bytes()[:-9])),
        ("npz", Path.unlink),
        ("json", replaced("1,", "2,")),
        ("json", lambda path: path.write_bytes(path.read_bytes()[:-7])),
        ("json", lambda path: path.write_text("[" * 10**5)),
        (
            "json",
            lambda path: path.write_bytes(
                path.with_name("seed_0000.json").read_bytes()
            ),
        ),
        ("json", Path.unlink),
    ],
)
def test_a_changed_result_is_not_complete_and_is_named(tmp_path, suffix, damage):
    p = made(tmp_path, range(3))
    assert records.pending(p) == []
    damage(seed_path(p.directory, 1, suffix))
    assert records.pending(p) == [1]
    why = records.state(p.directory, 1)[1]
    assert suffix.upper() in why
    table = status.status(arguments(f"runs_dir={tmp_path}"))
    assert f"smoke hill BC-FQI, seed 1: damaged: {why}" in table


def test_a_seed_of_another_variant_is_not_complete(tmp_path):
    p = made(tmp_path, range(1))
    other = made_up_plan(tmp_path, "hill", "C-FQI", range(1))
    p.directory.rename(other.directory)
    assert records.pending(other) == [0]
    assert "belongs to variant" in records.state(other.directory, 0)[1]


def test_a_rerun_makes_a_changed_seed_again_and_reports_it(tmp_path, capsys):
    words = ("env=maze", *FQI, "algorithm/regressor=tabular")
    p = run(tmp_path, *words)
    first, second = (seed_path(p.directory, seed, "csv") for seed in (0, 1))
    before, when = second.read_bytes(), first.stat().st_mtime_ns
    second.write_bytes(before.replace(b"1", b"2", 1))
    runner.run(p)
    assert second.read_bytes() == before and first.stat().st_mtime_ns == when
    assert "seed 1: damaged: the CSV is not" in capsys.readouterr().err
    assert records.pending(p) == []


def test_seeds_are_in_the_order_of_their_numbers(tmp_path):
    p = made(tmp_path, range(9998, 10002))
    (p.directory / "seed_mine.csv").write_text("a\n1\n")
    assert recorded_seeds(p.directory, "csv") == [9998, 9999, 10000, 10001]
    frame = api.read(p.directory)
    assert list(dict.fromkeys(frame["seed"])) == [9998, 9999, 10000, 10001]


def test_recorded_commands_can_be_pasted(monkeypatch):
    words = ["/some/where/bcrl", "-m", "env.x=[1, 2]", "tag=it's"]
    monkeypatch.setattr(sys, "argv", words)
    assert shlex.split(run_origin()["command"]) == ["bcrl", *words[1:]]


def test_seeds_in_words():
    assert records.named([7]) == "seed 7"
    assert records.named([2, 0, 1, 5]) == "seeds 0–2, 5"


def test_a_variant_that_diverges_is_named_at_the_end(tmp_path):
    config = {"env": {"name": "hill", "metrics": ["q_error"]}}
    lines = []
    for name, last in (("FQI", 3.0), ("SBC-FQI", 1300.0)):
        p = made_up_plan(tmp_path, "hill", name, range(3), config=config)
        table = {"stage": 1, "task": 1, "iteration": [1, 2], "q_error": [4.0, last]}
        write_seeds(p, lambda seed, table=table: pd.DataFrame(table))
        lines.append(status.diverging_lines(p))
    assert lines[0] == []
    assert "hill SBC-FQI, seeds 0–2: q_error" in lines[1][0]
