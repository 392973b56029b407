"""Many jobs in one pool: their order and parts, the time to go, damaged results."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from bcrl.config.plan import part
from bcrl.errors import BcrlError
from bcrl.results.layout import seed_path
from bcrl.run import costs, progress, records, runner, status, summary
from bcrl.run.progress import Progress, Tick
from bcrl.run.schedule import merged, ordered
from bcrl.run.workers import cores, do_jobs
from tests.conftest import arguments, plan, plans
from tests.results.made_up import made_up_plan, write_seeds
from tests.run.light import work
from tests.run.runs import LINEAR, TABULAR


def test_the_longest_jobs_come_first_and_each_seed_once(tmp_path):
    figure = ("experiment=fig2", "scale=quick", "workers=2")
    some = plans(*figure, f"runs_dir={tmp_path}", multirun=True)
    work = ordered(merged([*some, *some]), {})
    expected = [len(each.seeds) * costs.expected(each.plan) for each in work]
    assert expected == sorted(expected, reverse=True)
    seeds = [(each.plan.directory, seed) for each in work for seed in each.seeds]
    assert len(seeds) == len(set(seeds)) == 4 * 3


def test_processes_share_the_seeds_but_on_a_gpu_one_has_as_many_as_may_be(tmp_path):
    words = (*LINEAR, "seeds=90", "seeds.lockstep=60", "workers=4", "variant=plain")
    made = plan(*words, f"runs_dir={tmp_path}")
    sizes = {
        device: [len(job.seeds) for job in ordered([replace(made, device=device)], {})]
        for device in ("cpu", "cuda")
    }
    assert sizes == {"cpu": [23, 23, 22, 22], "cuda": [45, 45]}


def test_groups_are_larger_on_a_gpu_unless_their_size_is_given(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    words = (*LINEAR, "variant=plain", "device=cuda")
    own, given = plan(*words), plan(*words, "seeds.lockstep=7")
    assert (own.lockstep, given.lockstep) == (500, 7)
    assert plan(*LINEAR, "variant=plain", "device=cpu").lockstep == 20


def test_the_parts_of_seeds_are_all_of_them_once():
    for count in (1, 2, 7, 20):
        seeds = tuple(range(count))
        for parts in range(1, count + 1):
            each = [part(seeds, f"{k}/{parts}") for k in range(1, parts + 1)]
            assert sum(each, ()) == seeds and all(each)
    second = plan("env=maze", "seeds.first=10", "seeds.count=5", "seeds.part=2/2")
    assert second.seeds == (12, 13, 14) and second.asked == tuple(range(10, 15))
    whole = plans("env=maze", "seeds.count=5", "seeds.part=1/2,2/2", multirun=True)
    assert [p.seeds for p in merged(whole)] == [(0, 1, 2, 3, 4)]
    for bad in ("3/2", "a/b"):
        with pytest.raises(BcrlError, match=r"seeds\.part"):
            plan("env=maze", "seeds.count=3", f"seeds.part={bad}")


def test_plans_of_one_directory_are_one(tmp_path):
    parts = [plan(*TABULAR, f"seeds=[{n}]", f"runs_dir={tmp_path}") for n in (0, 2)]
    runner.run(*parts)
    facts = json.loads((parts[0].directory / "seed_0002.json").read_text())
    assert facts["asked"] == [[0, 0], [2, 2]]
    (one,) = merged(parts)
    assert one.command.splitlines() == [each.command for each in parts]


def shown(mode: str, *seconds: float) -> Progress:
    """The progress of jobs that are expected to take so long."""
    made = SimpleNamespace(env="maze", name="BC", family="DQN", length=10)
    jobs = [SimpleNamespace(plan=made, seeds=(0,), seconds=each) for each in seconds]
    return Progress(jobs, 2, mode)


def test_the_estimate_is_right_when_the_model_is_off_by_a_factor():
    seconds = sorted(np.random.default_rng(0).uniform(50, 100, 20), reverse=True)
    bar, clock = shown("none", *seconds), [0.0, 0.0]
    for number, each in enumerate(seconds):
        clock[np.argmin(clock)] += 1.5 * each
        bar.tick(number, Tick(1, 10, 1.5 * each))
        if number == 5:
            early = clock[np.argmin(clock)] + bar.to_go()
    assert early == pytest.approx(max(clock), rel=0.1)


def test_a_line_is_due_after_a_while_of_silence(monkeypatch, capsys):
    lines = shown("lines", 1000.0)
    lines.tick(0, Tick(1, 0, 0.0))
    assert not capsys.readouterr().err
    later = progress.time.monotonic() + 60.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: later)
    lines.tick(0, Tick(1, 0, 60.0))
    assert "step 0/10 · seed 0" in capsys.readouterr().err


def test_a_process_that_dies_loses_its_job_and_is_replaced():
    reports = []
    stop = SimpleNamespace(requested=False)
    found = do_jobs(work, [0, 1, 2, 3], 2, lambda *each: reports.append(each), stop)
    results = {number: str(result) for number, result in found}
    died = "its process ended with exit code 3"
    assert results == {0: "0", 1: died, 2: "20", 3: "30"}
    assert sorted(reports) == [(number, number) for number in range(4)]


def test_the_cores_are_those_that_slurm_has_given(monkeypatch):
    for value in ("1", "4096", "", "-1", "2(x3)"):
        monkeypatch.setenv("SLURM_CPUS_PER_TASK", value)
        assert cores() == (1 if value == "1" else len(os.sched_getaffinity(0)))


def made(folder: Path, seeds: range, name: str = "BC-FQI", error: float = 3.0):
    config = {"env": {"name": "hill", "metrics": ["q_error"]}}
    result = made_up_plan(folder, "hill", name, seeds, config=config)
    columns = {"stage": 1, "task": 1, "iteration": [1, 2], "q_error": [4.5, error]}
    write_seeds(result, lambda seed: pd.DataFrame(columns))
    return result


DAMAGES = {
    "csv": lambda path: path.write_text(path.read_text().replace("4.5", "4.6")),
    "npz": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "json": lambda path: path.write_bytes(path.with_stem("seed_0000").read_bytes()),
}


@pytest.mark.parametrize("suffix", DAMAGES)
def test_a_changed_result_is_not_complete_and_is_named(tmp_path, suffix):
    for damage in (DAMAGES[suffix], Path.unlink):
        p = made(tmp_path, range(3))
        assert records.pending(p) == []
        damage(seed_path(p.directory, 1, suffix))
        assert records.pending(p) == [1]
        table = status.status(arguments(f"runs_dir={tmp_path}"))
        (line,) = (x for x in table.splitlines() if "hill BC-FQI, seed 1: " in x)
        assert f"the {suffix.upper()} " in line


def test_a_variant_that_diverges_is_named_at_the_end(tmp_path):
    both = [made(tmp_path, range(3), "FQI"), made(tmp_path, range(3), "SBC-FQI", 1e3)]
    lines = [line for plan in both for line in summary.diverging_lines(plan)]
    assert lines == ["hill SBC-FQI, seeds 0–2: q_error diverges"]
