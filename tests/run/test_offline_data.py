"""Commands with `algorithm.dataset`: equal files are the same run in any folder."""

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

import bcrl
from bcrl.api import Transitions
from bcrl.common.seeding import stream
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.rollout import rollout, starts_and_draws
from bcrl.learning.transitions import LoggedFile, read_transitions
from bcrl.q.functions import ZERO
from bcrl.run import records, runner
from tests.conftest import plan
from tests.offline import needs
from tests.run.runs import SHORT, about, results, run

BC = (*SHORT, "variant=BC")
#: Minari's about an author and so on.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.fixture
def collected(tmp_path):
    """What seed 0 collects by itself in the three tasks, at scale=smoke."""
    found = []
    for stage in plan(*BC).stages:
        rngs = [stream(0, "data", stage.number)]
        start, u = starts_and_draws(rngs, stage.env, stage.learner.episodes)
        found.append(Transitions.of_episodes(rollout(stage.env, ZERO, start, u, 1.0)))
        found[-1].save(tmp_path / f"{stage.task}.npz")
    return found


def listed(folder, *names):
    """The override that names a file per slot."""
    return f"algorithm.dataset=[{','.join(str(folder / name) for name in names)}]"


FILES = ("1.npz", "2.npz", "3.npz")


def test_a_run_from_files_is_byte_identical_to_one_that_collects(collected, tmp_path):
    own = run(tmp_path / "own", *BC)
    logged = run(tmp_path / "logged", *BC, listed(tmp_path, *FILES))
    assert results(logged, 0) == results(own, 0)
    assert results(logged, 1) != results(logged, 0)  # another seed's trees
    kept = yaml.safe_load((logged.directory / "config.yaml").read_text())["algorithm"]
    assert len({*kept["dataset_sha256"]}) == 3 and "dataset" not in kept
    assert about(logged, 0)["config"]["algorithm"]["dataset"][0].endswith("1.npz")
    usual = yaml.safe_load((own.directory / "config.yaml").read_text())["algorithm"]
    assert usual["dataset"] == "own" and "dataset_sha256" not in usual


def test_runs_with_logged_data_start_from_each_other(collected, tmp_path):
    one = "algorithm.iterations=2", "env.tasks.mass=[0.8]"
    data, elsewhere = tmp_path / "1.npz", tmp_path / "elsewhere.npz"
    first = run(tmp_path / "first", *SHORT, *one, f"algorithm.dataset={data}")
    data.rename(elsewhere)  # neither its agents nor what starts from them need it
    assert bcrl.load(first.directory).learned.residuals
    two = "algorithm.iterations=2", "env.tasks.mass=[1.0,1.2]", "variant=BC"
    words = (*SHORT, *two, f"start.from={first.directory}")
    expected = run(tmp_path / "two", *words, listed(tmp_path, "2.npz", "3.npz"))
    every = [*collected[1:], collected[0]]  # tasks 1 and 2 are this run's own
    parts = [
        replace(part, episode=None, task=np.full(len(part.reward), number))
        for number, part in enumerate(every, start=1)
    ]
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name, value in vars(parts[0]).items()
        if value is not None
    }
    whole = Transitions(**arrays).save(tmp_path / "whole.npz")
    made = run(tmp_path / "one", *words, f"algorithm.dataset={whole}")
    assert results(made, 1) == results(expected, 1)


def test_a_run_with_moved_data_is_extended(collected, tmp_path):
    data, words = tmp_path / "3.npz", (*SHORT, "seeds.count=1", "env.tasks.mass=[1.2]")
    words = (*words, "scale.max_iterations=9")
    short, long = "algorithm.iterations=2", "algorithm.iterations=4"
    first = run(
        tmp_path / "a", *words, short, f"algorithm.dataset={data}", "keep=state"
    )
    moved = data.rename(tmp_path / "moved.npz")
    words = (*words, long, f"algorithm.dataset={moved}")
    calm = run(tmp_path / "calm", *words)
    longer = run(tmp_path / "b", *words, f"extend={first.directory}")
    assert results(calm, 0) == results(longer, 0)


def test_moved_files_are_the_same_run_and_changed_ones_another(collected, tmp_path):
    untagged = [word for word in BC if not word.startswith("tag=")]
    first = plan(*untagged, listed(tmp_path, *FILES), f"runs_dir={tmp_path}/r")
    tagged = run(tmp_path / "r", *BC, "seeds.count=1", listed(tmp_path, *FILES))
    (there := tmp_path / "there").mkdir()
    for name in FILES:
        shutil.move(tmp_path / name, there)
    moved = plan(*untagged, listed(there, *FILES), f"runs_dir={tmp_path}/r")
    assert moved.directory == first.directory and "@" in moved.directory.name
    again = plan(*BC, "seeds.count=1", listed(there, *FILES), f"runs_dir={tmp_path}/r")
    assert not records.pending(again)  # complete: it is the same run
    collected[1].save(there / "1.npz")
    changed = plan(*untagged, listed(there, *FILES), f"runs_dir={tmp_path}/r")
    assert changed.directory != first.directory
    with pytest.raises(BcrlError, match=r"dataset_sha256.*there"):
        runner.run(plan(*BC, listed(there, *FILES), f"runs_dir={tmp_path}/r"))
    # The file changed between the check and the work.
    assert records.state(tagged.directory, 0)[0] == "complete"
    with pytest.raises(ConfigError, match="changed"):
        read_transitions(LoggedFile(str(there / "1.npz"), "0" * 64))


def test_an_override_that_cannot_be_is_rejected_before_work(collected, tmp_path):
    for words, message in (
        ("algorithm.dataset=sharde", "sharde"),
        (listed(tmp_path, *FILES[:2]), "2 entries"),
        (f"algorithm.dataset={tmp_path}/1.npz", "task"),
        ("algorithm.dataset=minari:none/such-v0", "minari"),
    ):
        with pytest.raises(ConfigError, match=message) as rejection:
            plan(*BC, words)
        assert rejection.value.key == "algorithm.dataset"
    mixed = plan(*BC, f"algorithm.dataset=[shared,own,{tmp_path}/3.npz]")
    assert [s.learner.dataset is None for s in mixed.stages] == [True, True, False]
    # Plain FQI: the target in every slot.
    assert plan(*SHORT, f"algorithm.dataset={tmp_path}/3.npz").variant == "FQI"


@pytest.fixture
def minari(tmp_path, monkeypatch):
    """A function that makes a Minari dataset of transitions, and gives its folder."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    from gymnasium.spaces import Box, Discrete
    from minari import create_dataset_from_buffers
    from minari.data_collector import EpisodeBuffer

    def make(name, data, act=None, see=None, start=0, data_format="hdf5"):
        buffers = []
        for number in np.unique(data.episode):
            own = data.episode == number
            ends = data.absorbing[own]
            states = [*data.observation[own], data.next_observation[own][-1]]
            buffers.append(
                EpisodeBuffer(
                    id=None,
                    observations=np.array(states),
                    actions=data.action[own] + start,
                    rewards=data.reward[own],
                    terminations=ends,
                    truncations=~ends & (np.arange(len(ends)) == len(ends) - 1),
                )
            )
        width = data.observation.shape[1:]
        create_dataset_from_buffers(
            name,
            buffers,
            observation_space=see or Box(-np.inf, np.inf, width, np.float64),
            action_space=act or Discrete(2, start=start),
            data_format=data_format,
        )
        return tmp_path / "minari" / name

    return make


@needs("minari")
def test_a_minari_dataset_is_learned_like_the_same_data(minari, collected, tmp_path):
    for task, data in enumerate(collected, 1):
        kind = "arrow" if task == 2 else "hdf5"
        minari(f"hill/m{task}-v0", data, start=task, data_format=kind)
        found = read_transitions(f"minari:hill/m{task}-v0")
        for name in ("observation", "action", "reward", "absorbing", "episode"):
            assert np.array_equal(getattr(found, name), getattr(data, name))
    names = "minari:hill/m1-v0", tmp_path / "minari/hill/m2-v0", tmp_path / "3.npz"
    given = f"algorithm.dataset=[{','.join(map(str, names))}]"
    own = run(tmp_path / "own", *BC, "seeds.count=1")
    assert results(run(tmp_path / "r", *BC, "seeds.count=1", given), 0) == results(
        own, 0
    )


@needs("minari")
def test_other_minari_datasets_are_rejected(minari, collected, tmp_path):
    from gymnasium.spaces import Box

    data = collected[0]
    minari("other/box-v0", data, act=Box(0.0, 1.0, ()))
    folder = minari("other/cut-v0", data) / "data"
    main = folder / "main_data.hdf5"
    main.write_bytes(main.read_bytes()[:-5000])
    bare = minari("other/bare-v0", data) / "data" / "metadata.json"
    text = bare.read_text().replace('"observation_space"', '"an_observation_space"')
    bare.write_text(text.replace("{", '{"env_spec": "{}",', 1))
    for name, message in (
        ("minari:other/box-v0", "Discrete"),
        (f"{folder}", "can't be read"),
        ("minari:other/bare-v0", "observation_space"),
        ("minari:other/none-v0", "none-v0"),
    ):
        with pytest.raises(ConfigError, match=message):
            read_transitions(name)
    assert os.listdir(tmp_path / "minari" / "other")


@needs("minari")
def test_reading_arrow_stops_where_it_takes_far_more_memory_than_disk(minari):
    from pyarrow import Table, ipc

    zeros, whole = np.zeros((10, 1000)), np.zeros(10, int)
    data = Transitions(zeros, whole, zeros[:, 0], zeros, whole > 0, whole)
    folder = minari("large/zeros-v0", data, data_format="arrow")
    (path,) = folder.rglob("*.arrow")
    with ipc.open_file(path) as file:
        batch = file.read_all().take([0] * 10_000).combine_chunks()  # 80 MB
    packed = ipc.IpcWriteOptions(compression="zstd")
    with ipc.new_file(path, batch.schema, options=packed) as file:
        file.write_table(Table.from_batches(batch.to_batches()))
    with pytest.raises(ConfigError, match="times its size"):
        read_transitions(folder)
