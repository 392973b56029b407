"""Whole DQN runs at smoke scale: records, identical bytes, diverging seeds, the GPU."""

import csv
import hashlib
import io
import json
import math

import numpy as np
import pandas as pd
import pytest
import torch

from bcrl import api
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.stage import SeedBatch, learn
from bcrl.report.seedfiles import read_csv
from bcrl.run import runner
from bcrl.run.records import is_complete, pending
from tests.conftest import plan
from tests.run.test_runs import digest

COLUMNS = (
    "stage,task,step,return,discounted_return,success_rate,q_mean,loss,"
    "greedy_return,greedy_discounted_return,greedy_success_rate"
)
METHODS = ("plain", "C", "BC", "SC", "SBC", "RPL", "PPR")
RELEASED = ("BC_released", "SC_released", "SBC_released")
LINEAR = ("env=linear_system", "algorithm=dqn")


def run(folder, *overrides: str):
    p = plan(*overrides, "scale=smoke", "progress=none", f"runs_dir={folder}")
    runner.run(p)
    return p


def rows(p, seed: int) -> list[dict[str, float]]:
    lines = csv.DictReader((p.directory / f"seed_{seed:04d}.csv").open())
    # A missing value is an empty cell.
    return [{k: float(v or "nan") for k, v in line.items()} for line in lines]


@pytest.mark.parametrize("variant", METHODS + RELEASED)
def test_a_seed_is_the_same_alone_among_others_and_with_two_workers(tmp_path, variant):
    # Short of the offset, RPL would only copy; so short runs have a short one.
    short = ("scale.max_steps=540", "algorithm.evaluation_episodes=5")
    short += ("algorithm.target_update=7",)  # several copies in 40 updates
    short += ("transfer.offset=510",) * (variant == "RPL")
    choice = (*LINEAR, f"variant={variant}", *short, "tag=x")
    alone = run(tmp_path / "a", *choice, "seeds.first=3", "seeds.count=1", "threads=1")
    among = run(tmp_path / "b", *choice, "seeds.count=10", "threads=2")
    pair = ("seeds.first=2", "seeds.count=2", "workers=2")
    ways = [alone, among] + ([run(tmp_path / "c", *choice, *pair)] * (variant == "BC"))
    for suffix in ("csv", "npz"):
        assert len({digest(p, 3, suffix) for p in ways}) == 1, suffix
    assert len({digest(among, s) for s in range(10)}) == 10  # seeds differ


def test_what_a_run_leaves(tmp_path):
    p = run(tmp_path, *LINEAR, "variant=BC")
    assert p.directory == tmp_path / "smoke" / "linear_system" / "BC-DQN"
    header = (p.directory / "seed_0000.csv").read_text().splitlines()[0]
    assert header == COLUMNS
    found = rows(p, 0)
    assert [(r["stage"], r["task"], r["step"]) for r in found] == [
        *((1, 1, step) for step in (0, 500, 1000, 1500, 2000)),
        *((2, 2, step) for step in (2000, 2700)),
    ]
    assert all(math.isfinite(v) for r in found for k, v in r.items() if k != "loss")
    assert [math.isnan(r["loss"]) for r in found] == [True] * 6 + [False]
    text = (p.directory / "seed_0000.csv").read_text()
    assert "nan" not in text and text.splitlines()[1].split(",")[7] == ""
    document = json.loads((p.directory / "seed_0000.json").read_text())
    for form in (text, text.replace(",,", ",nan,")):  # now, and as it once was
        path = tmp_path / "seed_0000.csv"
        path.write_text(form)
        document["sha256"]["csv"] = hashlib.sha256(form.encode()).hexdigest()
        for table in (pd.read_csv(io.StringIO(form)), read_csv(path, document)):
            assert table["loss"].dtype == float and table["loss"].isna().sum() == 6
    assert api.read(p.directory)["loss"].dtype == float
    assert all(-150 <= r["return"] <= 0 for r in found[5:])
    about = json.loads((p.directory / "seed_0000.json").read_text())
    assert about["status"] == "complete" and about["learners"] == ["lspi", "dqn"]
    arrays = np.load(p.directory / "seed_0000.npz", allow_pickle=False)
    assert arrays["q_stages"].shape == (2, 41 * 41, 8)
    assert np.array_equal(arrays["q"], arrays["q_stages"][-1])
    assert {"states", "actions", "pathway", "goal", "start", "drift"} <= set(arrays)


def test_the_x_axis_counts_every_step_of_every_stage(tmp_path):
    p = run(tmp_path, *LINEAR, "variant=C", "algorithm.evaluation_episodes=3", "tag=x")
    steps = [(r["stage"], r["step"]) for r in rows(p, 0)]
    # 500 random steps, 700 in LQ (evaluated every 500), 700 in the target
    assert steps == [(1, 500), (1, 1000), (1, 1200), (2, 1200), (2, 1900)]


def test_evaluating_twice_as_often_leaves_training_unchanged(tmp_path):
    ends = []
    for every in (400, 200):
        often = f"algorithm.evaluate_every={every}"
        p = run(tmp_path / str(every), *LINEAR, "variant=SBC", often, "tag=x")
        *_, last = learn(p.stages, SeedBatch((0, 1), np.zeros((1, 4))))
        ends.append(last.result.residual.online.flat.numpy().copy())
        assert len(rows(p, 0)) > 6
    assert np.array_equal(*ends)
    a, b = (
        rows(
            plan(
                *LINEAR,
                "variant=SBC",
                "scale=smoke",
                "tag=x",
                f"algorithm.evaluate_every={n}",
                f"runs_dir={tmp_path / str(n)}",
            ),
            0,
        )
        for n in (400, 200)
    )
    common = {r["step"]: r for r in b if r["stage"] == 2}
    for row in a:
        if row["stage"] == 2:  # the loss is a mean over another span
            assert {k: v for k, v in row.items() if k != "loss"} == {
                k: v for k, v in common[row["step"]].items() if k != "loss"
            }


def test_a_diverging_seed_is_recorded_and_told_at_the_end(tmp_path, capsys):
    choice = (*LINEAR, "variant=BC", "algorithm.learning_rate=1e30", "tag=x")
    with pytest.raises(
        runner.SeedsFailed, match="0–1: non-finite weights at step 2700"
    ):
        run(tmp_path, *choice)
    p = plan(*choice, "scale=smoke", f"runs_dir={tmp_path}")
    about = json.loads((p.directory / "seed_0000.json").read_text())
    assert about["status"] == "failed: non-finite weights at step 2700"
    assert math.isnan(rows(p, 0)[-1]["q_mean"])
    assert "seed 0 failed: non-finite weights" in capsys.readouterr().err
    assert not is_complete(p.directory, 0) and pending(p) == [0, 1]


@pytest.mark.parametrize(
    "overrides",
    [
        ("env=maze", "algorithm=dqn", "variant=plain"),
        ("env=maze", "algorithm=dqn", "variant=SBC"),
        ("env=maze", "algorithm=dqn", "variant=RPL"),
        ("env=car_on_hill", "algorithm=dqn", "variant=BC"),
        ("env=car_on_hill", "algorithm=dqn", "variant=PPR"),
        ("env=linear_system", "algorithm=fqi", "variant=BC"),
        ("env=linear_system", "algorithm=fqi", "variant=SBC"),
        ("env=maze", "algorithm=fqi", "variant=SC"),
        ("env=linear_system", "algorithm=dqn", "variant=B"),
        (*LINEAR, "boosting=on", "transfer=shaping"),
    ],
)
def test_combinations_beyond_the_paper_run(tmp_path, overrides):
    small = ("scale.max_steps=60", "scale.max_episodes=3", "seeds.count=1")
    if "algorithm=dqn" in overrides:
        small += ("algorithm.random_steps=40", "algorithm.learning_starts=40")
        small += ("algorithm.evaluation_episodes=2",)
    else:
        small += ("algorithm.regressor.trees=3",)
    p = run(tmp_path, *overrides, *small, "tag=x")
    assert is_complete(p.directory, 0)


def test_sb_dqn_is_named_so():
    p = plan(*LINEAR, "boosting=on", "transfer=shaping")
    assert p.variant == "SB-DQN" and {s.task for s in p.stages} == {2}


BAD = {
    "cuda without one": (["device=cuda"], "device=cuda: torch finds no CUDA"),
    "target update": (["algorithm.target_update=0"], "target_update=0: every entry"),
    "small replay": (["algorithm.replay_size=16"], "replay_size=16: holds less than"),
    "late start": (
        ["algorithm.learning_starts=10000"],
        "replay_size=10000: never holds more",
    ),
    "no transfer source": (
        ["env.tasks.task=[target]", "env.tasks.horizon=[150]", "transfer=shaping"],
        "transfer=shaping: linear_system has one task",
    ),
    "reuse of nothing": (["transfer=policy_reuse"], "needs an earlier task"),
    "residual policy of nothing": (["transfer=residual_policy"], "an earlier task"),
    "residual policy and boosting": (
        ["curriculum=on", "transfer=residual_policy", "boosting=on"],
        "residual_policy: its Q is about its own actions",
    ),
    "LSPI on the target": (
        ["variant=BC", "algorithm.learners=lspi"],
        "algorithm.learners=lspi: learns quadratic",
    ),
    "LSPI's networks": (
        ["variant=C", "algorithm.learners=[lspi,dqn]"],
        "leaves no network",
    ),
    "LSPI's steps": (
        ["variant=BC", "algorithm.steps=[2100,500]"],
        "algorithm.steps=2100: LSPI needs a multiple",
    ),
    "unknown learner": (["algorithm.learners=dqm"], "did you mean dqn?"),
    "unknown device": (["device=gpu"], "device=gpu"),
    "unknown transfer": (["transfer=shapin"], "did you mean transfer=shaping?"),
    "nu": (["variant=PPR", "transfer.nu=1.5"], "transfer.nu=1.5"),
    "offset": (["variant=RPL", "transfer.offset=-1"], "transfer.offset=-1"),
    "switch": (["boosting=on", "boosting.maxima=three"], "boosting.maxima=three"),
    "layers": (["algorithm.hidden=[]"], "algorithm.hidden=[]"),
    "rate": (["algorithm.learning_rate=0"], "learning_rate=0"),
    "preset": (["env.preset=relesed"], "did you mean released?"),
    "task": (["env.tasks.task=[lq,targt]"], "did you mean target?"),
    "features": (
        ["variant=BC", "algorithm.lspi.features=cubic"],
        "algorithm.lspi.features=cubic",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused(case):
    overrides, words = BAD[case]
    if case == "cuda without one" and torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(BcrlError) as refusal:
        plan(*LINEAR, *overrides)
    assert words in str(refusal.value)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["boosting=released"], "boosting=released: is the released DQN's"),
        (["curriculum=on", "transfer=policy_reuse"], "FQI learns from whole episodes"),
    ],
)
def test_fqi_refuses_what_belongs_to_dqn(overrides, words):
    with pytest.raises(ConfigError, match=words):
        plan("env=maze", "algorithm=fqi", *overrides)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_run_is_much_like_a_cpu_run(tmp_path):
    here = run(tmp_path / "cpu", *LINEAR, "variant=BC")
    there = run(tmp_path / "gpu", *LINEAR, "variant=BC", "device=cuda")
    assert rows(there, 0)[5]["q_mean"] == pytest.approx(rows(here, 0)[5]["q_mean"])
