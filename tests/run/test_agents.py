"""Agents that runs leave: their Q and actions after loading, files that are refused."""

import io
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import bcrl
from bcrl.common import files, seed_axis, serialization
from bcrl.common.seeding import stream
from bcrl.envs import is_finite
from bcrl.errors import BcrlError
from bcrl.learning.learned import Learned, given
from bcrl.learning.rollout import CHOICES, play, starts_and_draws
from bcrl.learning.transfer import StageResult
from bcrl.q.functions import Sum
from bcrl.q.regressors.base import Fitted
from bcrl.results.layout import seed_path
from bcrl.run import agent_files, evaluate, job
from tests.run.runs import KINDS, MAZE, SMALL, TABULAR, about, resealed, rows, run

FAST = ("maze BC", "maze C", "car_on_hill BC", "dqn SBC_released", "dqn RPL")
FAST += ("dqn in gymnasium", "fqi in gymnasium")
ALL = [
    name if name in FAST else pytest.param(name, marks=pytest.mark.slow)
    for name in KINDS
]


@pytest.fixture
def results(monkeypatch):
    """The results of the latest run's last stage, by seed."""
    found, write = {}, job.packed

    def noted(stages, batch, result, residuals, s):
        found[batch.seeds[s]] = result, s, len(batch.seeds)
        return write(stages, batch, result, residuals, s)

    monkeypatch.setattr(job, "packed", noted)
    return found


@pytest.fixture(scope="module")
def fresh():
    """Calls a function in a process that has trained nothing."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield lambda function, *given: pool.submit(function, *given).result()


@pytest.mark.parametrize("kind", ALL)
def test_a_loaded_agent_has_the_runs_q_and_actions(kind, tmp_path, results, fresh):
    made = run(tmp_path, *KINDS[kind])
    for seed, (result, s, n_seeds) in results.items():
        npz = np.load(seed_path(made.directory, seed, "npz"))
        states, low, high = npz["states"], npz["states"].min(0), npz["states"].max(0)
        if not is_finite(made.target):
            rng = np.random.default_rng(seed)
            states = rng.uniform(low - 0.1, high + 0.1, (10_000, len(low)))
        values, visited, actions = fresh(loaded, made, seed, states)
        every = np.broadcast_to(states, (n_seeds, *states.shape))
        expected = np.asarray(result.q(every, made.target.n_actions))[s]
        assert values.tobytes() == expected.tobytes()
        if kind == "lspi":  # it acts with any force, an agent with the listed ones
            continue
        assert visited.tobytes() == npz["trajectory"].tobytes()
        assert actions.tolist() == npz["trajectory_actions"].tolist()


def loaded(made, seed, states):
    """A loaded agent's values (n, A), and the states and actions of its episode."""
    agent = bcrl.load(made.directory, seed)
    played = again(made, agent, rows(made, seed)[-1])
    n = played.length[0, 0]
    return agent.q(states), played.state[0, 0, : n + 1], played.action[0, 0, :n]


@pytest.mark.parametrize(
    "words",
    [
        ("env.id=FrozenLake-v1",),
        ("env.id=CartPole-v1", "env.observation=tests.toys.doubled"),
    ],
)
def test_agents_of_mapped_and_flattened_observations_are_loaded(words, tmp_path):
    dqn = "algorithm=dqn", *SMALL, "env.horizon=20", "scale.max_steps=60"
    more = "algorithm.learning_starts=40", "env.verify=false"
    made = run(tmp_path, "env=gymnasium", *words, *dqn, *more)
    agent = bcrl.load(made.directory, 1, trust="tests")
    npz = np.load(seed_path(made.directory, 1, "npz"))
    env = agent.make()
    first, _ = env.reset(seed=3)
    (state,) = agent.states([first])
    assert agent.act(first) == agent.q([first]).argmax()
    if "env.observation" in words[-1]:
        assert (state == 2.0 * first).all()
    else:
        (row,) = np.flatnonzero((npz["states"] == state).all(-1))
        assert (agent.q([first])[0].astype(np.float32) == npz["q"][row]).all()


def again(made, agent, last):
    """The greedy episode that a run recorded at its end, played by an agent."""
    env, stage = made.target, made.stages[-1]
    if made.family == "FQI":
        rngs = [stream(agent.seed, "evaluation", int(last["iteration"]))]
        return play(env, agent.choose, *starts_and_draws(rngs, env, 1))
    step = int(last["step"]) - stage.before
    rngs = [stream(agent.seed, "evaluation", stage.number, step)]
    n = stage.learner.evaluation_episodes
    start, u = starts_and_draws(rngs, env, n, CHOICES)
    return play(env, agent.choose, start[:, :1], u[:, :, :1])


def test_an_agent_acts_in_gymnasiums_loop(tmp_path, fresh):
    made = run(tmp_path, *KINDS["dqn in gymnasium"])
    values, actions = fresh(looped, made.directory)
    agent = bcrl.load(made.directory, seed=1)
    env = agent.make()
    seen = [env.reset(seed=5)[0], *(env.step(action)[0] for action in actions)]
    assert agent.q(np.array(seen)).tobytes() == values.tobytes()
    assert agent.act(np.array(seen[:-1])).tolist() == actions


def looped(directory):
    """The values at the states of an episode in Gymnasium's loop, and its actions."""
    agent = bcrl.load(directory, seed=1)
    env, done, actions = agent.make(), False, []
    seen = [env.reset(seed=5)[0]]
    while not done:
        actions.append(agent.act(seen[-1]))
        new, _, ended, cut, _ = env.step(actions[-1])
        seen.append(new)
        done = ended or cut
    return agent.q(np.array(seen)), actions


def test_residuals_are_kept_by_stage(tmp_path):
    final = run(tmp_path, *KINDS["maze C"])
    every = run(tmp_path / "every", *KINDS["maze C"], "keep=stages")
    boosted = run(tmp_path, *KINDS["maze BC"])
    states = final.target.states()
    kept = [bcrl.load(p.directory, 0).residuals for p in (final, every, boosted)]
    assert [len(residuals) for residuals in kept] == [1, 10, 10]
    assert (kept[0][-1].q(states) == kept[1][-1].q(states)).all()
    recorded = np.load(seed_path(boosted.directory, 0, "npz"))["residuals"]
    assert all(
        (own.q(states) == x).all() for own, x in zip(kept[2], recorded, strict=True)
    )


def test_nothing_is_kept_if_nothing_is_asked_for(tmp_path):
    made = run(tmp_path, *MAZE, "keep=none")
    assert not list(made.directory.glob("*.agent"))
    with pytest.raises(BcrlError, match="keep=none"):
        bcrl.load(made.directory)


def replaced(made, seed, suffix, data: bytes) -> None:
    """Put other bytes in the place of a seed's file, with their hash in its JSON."""
    seed_path(made.directory, seed, suffix).write_bytes(data)
    hashes = about(made, seed)["sha256"] | {suffix: files.sha256(data)}
    resealed(seed_path(made.directory, seed, "json"), sha256=hashes)


def test_files_that_are_not_what_a_run_wrote_are_refused(tmp_path):
    made = run(tmp_path, *MAZE)
    path = seed_path(made.directory, 0, "agent")
    whole = path.read_bytes()
    for broken in (whole[:-100], whole.replace(b"about", b"abouT"), b""):
        path.write_bytes(broken)
        with pytest.raises(BcrlError, match=r"seed_0000\.agent"):
            bcrl.load(made.directory)
    other = serialization.relabelled(seed_path(made.directory, 1, "agent"), {})
    for wrong in (b"PK\x03\x04", other, whole[:-100]):
        replaced(made, 0, "agent", wrong)
        with pytest.raises(BcrlError, match=r"seed_0000\.agent"):
            bcrl.load(made.directory)
    path.unlink()
    for seed, why in ((0, "missing"), (7, "seeds 0–1")):
        with pytest.raises(BcrlError, match=why):
            bcrl.load(made.directory, seed)
    with pytest.raises(BcrlError, match="is no folder"):
        bcrl.load(tmp_path / "nothing")


def test_compressed_arrays_are_refused_because_they_can_be_of_any_size(tmp_path):
    made = run(tmp_path, *MAZE)
    with np.load(seed_path(made.directory, 0, "npz")) as stored:
        np.savez_compressed(packed := io.BytesIO(), **stored)
    replaced(made, 0, "npz", packed.getvalue())
    with pytest.raises(BcrlError, match=r"seed_0000\.npz"):
        bcrl.load(made.directory)


def test_models_that_would_not_fit_are_refused_before_they_are_made(
    tmp_path, monkeypatch
):
    made = run(tmp_path, *KINDS["car_on_hill plain"])
    path, regressor = (
        seed_path(made.directory, 0, "agent"),
        made.stages[-1].learner.regressor,
    )
    limit = 10 * (size := path.stat().st_size) * regressor.trees
    monkeypatch.setattr(agent_files, "available", lambda: limit)
    q = replace(bcrl.load(made.directory).learned.result.q, regressor=regressor)
    (row,) = q.models
    copies = [replace(q, models=[[Fitted(row[0].problem)] * 2]) for _ in range(200)]
    wider = replace(q, models=[[*row, *row]])
    for forged, why in ((Sum(tuple(copies)), "of memory"), (wider, "per action")):
        content = Learned(StageResult(forged, forged), ())
        about, same = serialization.read_about(path), given(made.stages, q.team)
        replaced(made, 0, "agent", serialization.written(about, content, same))
        assert path.stat().st_size < 2 * size
        with pytest.raises(BcrlError, match=why):
            bcrl.load(made.directory)


def test_a_run_is_found_by_any_path_to_it(tmp_path):
    made = run(tmp_path, *MAZE)
    (linked := tmp_path / "link" / "smoke" / "maze").mkdir(parents=True)
    (linked / "BC-FQI").symlink_to(made.directory)
    for path in (made.directory / ".." / "BC-FQI", linked / "BC-FQI"):
        assert bcrl.load(path, 1).seed == 1


def test_an_agent_of_another_seed_is_not_taken_for_this_one(tmp_path):
    made = run(tmp_path, *MAZE)
    other = seed_path(made.directory, 1, "agent").read_bytes()
    replaced(made, 0, "agent", other)
    with pytest.raises(BcrlError, match="holds no agent of seed 0"):
        bcrl.load(made.directory)


def test_a_config_that_names_code_needs_trust(tmp_path, capsys):
    made = run(tmp_path, *MAZE)
    document = about(made, 0)
    env = document["config"]["env"] | {"name": "a_strangers.module"}
    path = seed_path(made.directory, 0, "json")
    resealed(path, config=document["config"] | {"env": env})
    with pytest.raises(BcrlError, match="trust='a_strangers'"):
        bcrl.load(made.directory)
    assert evaluate.main([str(made.directory)]) == 2
    assert "--trust a_strangers" in capsys.readouterr().err


def test_what_plays_no_part_in_acting_does_not_prevent_loading(tmp_path):
    made = run(tmp_path, *TABULAR)
    path, config = seed_path(made.directory, 0, "json"), about(made, 0)["config"]
    elsewhere = {"device": "cuda", "logger": {"name": "mine.Lines"}, "workers": -1}
    older = {k: v for k, v in config.items() if k not in ("keep", "start", "extend")}
    states = made.target.states()
    expected = bcrl.load(made.directory, 1).q(states).shape
    for other in (config | elsewhere, older):
        resealed(path, config=other)
        agent = bcrl.load(made.directory, 0)
        assert agent.q(states).shape == expected and agent.config == other
    for foreign in ({"env": {}}, {}, [], {**config, "env": {"name": "maze"}}):
        resealed(path, config=foreign)
        with pytest.raises(BcrlError, match=str(made.directory)):
            bcrl.load(made.directory, 0)
    seed_path(made.directory, 1, "agent").unlink()
    hashes = about(made, 1)["sha256"]
    for sha256, why in ((hashes, "was removed"), ({"npz": ""}, "kept none")):
        resealed(seed_path(made.directory, 1, "json"), sha256=sha256)
        with pytest.raises(BcrlError, match=f"missing: .*{why}.*keep=final"):
            bcrl.load(made.directory, 1)


def test_a_q_of_other_seeds_is_not_taken_for_theirs(tmp_path):
    made = run(tmp_path, *TABULAR)
    documents = {seed: agent_files.document_of(made.directory, seed) for seed in (0, 1)}
    own = [bcrl.load(made.directory, seed).learned.result.q for seed in (0, 1)]
    for mixed in ([own[0]] * 2, own[::-1]):
        with pytest.raises(BcrlError, match=r"seed_000\d\.agent: .*seeds_on"):
            q = seed_axis.joined(mixed)
            agent_files.check_recorded(q, made.target, made.directory, documents)
    q = seed_axis.joined(own)
    agent_files.check_recorded(q, made.target, made.directory, documents)
