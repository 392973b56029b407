"""Logged transitions: their files, their checks, and learning from them."""

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from bcrl import api
from bcrl.api import FQI, Boost, Shape, Transitions, warm_start
from bcrl.common.seeding import stream
from bcrl.errors import ConfigError
from bcrl.learning.rollout import rollout, starts_and_draws
from bcrl.learning.transitions import read_transitions
from bcrl.q.functions import ZERO
from bcrl.results.layout import SETTING
from tests.offline import needs
from tests.toys import Corridor, OpenCorridor

TASKS = [OpenCorridor(prize=p) for p in (3.0, 1.0)]
LISTED = [Corridor(prize=p) for p in (3.0, 1.0)]
FITS = {"iterations": 3, "regressor": api.Forest(trees=3)}
KINDS = ["npz", pytest.param("parquet", marks=needs("pyarrow"))]


def collected(env, seed, stage, episodes=15):
    """What FQI collects by itself in a stage, at random."""
    start, u = starts_and_draws([stream(seed, "data", stage)], env, episodes)
    return Transitions.of_episodes(rollout(env, ZERO, start, u, 1.0))


def train(tasks, learners, *transfers, seeds=(0,)):
    """The rows of a run, without its learners' settings."""
    course = api.stages(tasks, learners, *transfers)
    frame = api.run(course, seeds, ("return", "residual_start"), progress=False)
    return frame.loc[:, ~frame.columns.str.startswith(SETTING)]


ARRAYS = vars(collected(TASKS[0], 0, 1))
N = len(ARRAYS["reward"])


def measured(frame):
    """A frame without the columns of the learner's settings."""
    return frame.loc[:, ~frame.columns.str.startswith("learner.")]


@pytest.mark.parametrize("tasks", [TASKS, LISTED], ids=["continuous", "finite"])
@pytest.mark.parametrize("transfer", [warm_start, Boost(), Shape()], ids="CBS")
def test_logged_data_that_fqi_would_collect_give_equal_numbers(
    tasks, transfer, tmp_path
):
    files = [tmp_path / f"{task}.npz" for task in (1, 2)]
    for number, (env, file) in enumerate(zip(tasks, files, strict=True), 1):
        collected(env, 4, number).save(file)
    own = train(tasks, FQI(episodes=15, **FITS), transfer, seeds=[4])
    logged = train(tasks, [FQI(dataset=f, **FITS) for f in files], transfer, seeds=[4])
    assert measured(own).equals(measured(logged))


def test_all_seeds_see_the_same_data_and_grow_trees_of_their_own():
    hill = api.CarOnHill(mass=0.8)
    learner = FQI(dataset=collected(hill, 0, 1, episodes=60), **FITS)
    both = train([hill] * 2, learner, Boost(), seeds=(5, 6))
    alone = train([hill] * 2, learner, Boost(), seeds=(6,))
    five, six = (both[both.seed == seed].reset_index(drop=True) for seed in (5, 6))
    assert six.equals(alone)
    assert (five.residual_start != six.residual_start).any()


def test_logged_rewards_count_in_a_finite_environment_too():
    env = Corridor()
    data = collected(env, 0, 1)
    doubled = replace(data, reward=2 * data.reward)
    one, two = (
        train([env], FQI(80, regressor=api.Tabular(), dataset=d))
        for d in (data, doubled)
    )
    assert np.allclose(two.residual_start, 2 * one.residual_start)
    assert two.iloc[-1].residual_start != 0


def test_a_cut_episode_is_bootstrapped_and_an_absorbing_one_is_not():
    def value(absorbing):  # at state 1, which both transitions of reward 1 lead to
        states = np.array([[0.0], [1.0]])
        rows = states, np.array([1, 1]), np.ones(2), np.ones((2, 1))
        data = Transitions(*rows, np.array([False, absorbing]))
        learner = FQI(200, regressor=api.Tabular(), dataset=data, evaluate_every=200)
        return train([Corridor()], learner).residual_start.iloc[-1]  # of state 0

    # Two actions at state 0: the untried one is worth 0.
    assert value(True) == pytest.approx((1 + 0.9 * 1.0) / 2)
    assert value(False) == pytest.approx((1 / (1 - 0.9)) / 2, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_brings_every_array_back(kind, tmp_path):
    task = np.arange(N) % 2 + 1
    data = Transitions(**ARRAYS | {"task": task})
    found = read_transitions(data.save(tmp_path / f"data.{kind}"))
    for name, values in vars(data).items():
        assert np.array_equal(getattr(found, name), values), name
        assert getattr(found, name).dtype == values.dtype
    assert np.array_equal(found.of_task(2).reward, data.reward[task == 2])
    named = vars(data) | {"terminated": data.absorbing, "source": np.ones(3)}
    del named["absorbing"]
    np.savez_compressed(tmp_path / "other.npz", **named)
    again = read_transitions(tmp_path / "other.npz")
    assert np.array_equal(again.absorbing, data.absorbing)


@needs("pyarrow")
def test_a_table_of_pandas_with_a_list_per_row_is_read(tmp_path):
    import pandas as pd

    columns = {
        k: v if v.ndim == 1 else list(v) for k, v in ARRAYS.items() if k != "task"
    }
    frame = pd.DataFrame(columns)
    frame.to_parquet(tmp_path / "data.parquet", row_group_size=20)
    found = read_transitions(tmp_path / "data.parquet")
    assert np.array_equal(found.next_observation, ARRAYS["next_observation"])
    frame.loc[3, "reward"] = None
    frame.to_parquet(tmp_path / "gap.parquet")
    frame.at[5, "observation"] = np.zeros(4)
    frame.to_parquet(tmp_path / "ragged.parquet")
    for name, word in (("gap", "reward has 1"), ("ragged", "observation has lists")):
        with pytest.raises(ConfigError, match=word):
            read_transitions(tmp_path / f"{name}.parquet")


def test_one_file_with_the_array_task_serves_a_curriculum(tmp_path):
    parts = [vars(collected(env, 4, n)) for n, env in enumerate(TASKS, 1)]
    parts = [p | {"task": np.full(len(p["reward"]), n)} for n, p in enumerate(parts, 1)]
    whole = {k: np.concatenate([part[k] for part in parts]) for k in parts[0]}
    path = Transitions(**whole).save(tmp_path / "all.npz")
    logged = train(TASKS, FQI(dataset=path, **FITS), Boost(), seeds=[4])
    own = train(TASKS, FQI(episodes=15, **FITS), Boost(), seeds=[4])
    assert measured(logged).equals(measured(own))
    with pytest.raises(ConfigError, match="task 3"):
        api.stages([*TASKS, Corridor(prize=9.0)], FQI(dataset=path, **FITS))


WRONG = [
    ("action", ARRAYS["action"].astype(float), "action=float64"),
    ("action", ARRAYS["action"] + 1, "action"),  # no action 2
    ("action", ARRAYS["action"] - 1, "action"),
    ("absorbing", ARRAYS["action"], "absorbing=int64"),
    ("reward", ARRAYS["reward"][1:], "reward="),
    ("reward", np.where(np.arange(N) == 2, np.nan, 1.0), "reward=1 numbers"),
    ("observation", np.full((N, 1), 1e39), f"observation={N} numbers"),  # > float32
    ("observation", np.zeros((N, 2)), "next_observation"),
    ("observation", np.zeros(N), "observation"),
    ("next_observation", np.zeros((N, 0)), "next_observation"),
    ("observation", ARRAYS["observation"].astype(str), "observation=<U"),
    ("observation", ARRAYS["observation"].astype(object), "can't be read"),  # pickled
    ("reward", None, "lacks reward"),
    ("terminated", ARRAYS["absorbing"], "absorbing and terminated"),
]


@pytest.mark.parametrize(("name", "values", "words"), WRONG)
def test_a_file_with_wrong_arrays_is_rejected_by_name(name, values, words, tmp_path):
    path, arrays = tmp_path / "wrong.npz", ARRAYS | {name: values}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(ConfigError) as rejection:
        api.stages(TASKS[-1:], FQI(dataset=path, **FITS))
    assert rejection.value.key == "dataset"
    assert str(path) in str(rejection.value) and words in str(rejection.value)


def test_states_that_do_not_exist_and_other_sizes_are_rejected():
    data = Transitions(**ARRAYS)
    off = replace(data, observation=data.observation + 0.5)
    assert api.stages(TASKS[-1:], FQI(dataset=off, **FITS))
    for env, given in ((LISTED[0], off), (api.CarOnHill(), data)):
        with pytest.raises(ConfigError, match="observation"):
            api.stages([env], FQI(dataset=given, **FITS))
    with pytest.raises(ConfigError, match="task"):  # one task's data for two
        api.stages(TASKS, FQI(dataset=data, **FITS))
    with pytest.raises(ConfigError, match="dataset=3"):
        api.stages(TASKS, FQI(dataset=3, **FITS))
    with pytest.raises(ConfigError, match="one transition"):
        Transitions(**{k: v[:0] for k, v in ARRAYS.items() if v is not None})


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_or_foreign_file_is_rejected_by_name(kind, tmp_path):
    path = Transitions(**ARRAYS).save(tmp_path / f"data.{kind}")
    whole = path.read_bytes()
    for content in (whole[:-40], whole[: len(whole) // 2], b"", b"no such format" * 9):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=f"data.{kind}.*can't be read"):
            read_transitions(path)
    for name in ("none.npz", "sharde", "", "data", "data.csv"):
        (tmp_path / "data.csv").write_text("1")
        with pytest.raises(ConfigError):
            read_transitions(tmp_path / name)


def test_a_header_cannot_claim_more_than_the_file_has(tmp_path):
    path, head = tmp_path / "large.npz", io.BytesIO()
    about = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    np.lib.format.write_array_header_1_0(head, about)
    np.savez(path, **{k: v for k, v in ARRAYS.items() if k not in ("reward", "task")})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("reward.npy", head.getvalue())
    with pytest.raises(ConfigError, match=r"reward\.npy"):
        read_transitions(path)
    np.savez_compressed(path, reward=np.zeros(2**23), action=ARRAYS["action"])  # 64 MiB
    with pytest.raises(ConfigError, match="bytes"):
        read_transitions(path)


@needs("pyarrow")
def test_texts_in_parquet_are_refused_before_they_are_read(tmp_path):
    import pandas as pd

    half = vars(Transitions(**ARRAYS)) | {"reward": ARRAYS["reward"].astype("f2")}
    path = Transitions(**half).save(tmp_path / "data.parquet")
    assert read_transitions(path).reward.dtype == "f2"
    for texts in (["a"] * 10, [b"a"] * 10, [["a"]] * 10):
        pd.DataFrame({"reward": texts}).to_parquet(path)
        with pytest.raises(ConfigError, match=r"reward.* has no numbers"):
            read_transitions(path)
