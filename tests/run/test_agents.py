"""Agents that runs leave: their Q and actions after loading, files that are refused."""

import subprocess
import sys

import numpy as np
import pytest

import bcrl
from bcrl.common import files, seed_axis, serialization
from bcrl.common.seeding import stream
from bcrl.envs import is_finite
from bcrl.errors import BcrlError
from bcrl.learning.rollout import CHOICES, play, starts_and_draws
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


@pytest.mark.parametrize("kind", ALL)
def test_a_loaded_agent_has_the_runs_q_and_actions(kind, tmp_path, results):
    made = run(tmp_path, *KINDS[kind])
    for seed, (result, s, n_seeds) in results.items():
        agent = bcrl.load(made.directory, seed)
        npz = np.load(seed_path(made.directory, seed, "npz"))
        states, low, high = npz["states"], npz["states"].min(0), npz["states"].max(0)
        if not is_finite(made.target):
            rng = np.random.default_rng(seed)
            states = rng.uniform(low - 0.1, high + 0.1, (10_000, len(low)))
        every = np.broadcast_to(states, (n_seeds, *states.shape))
        expected = np.asarray(result.q(every, made.target.n_actions))[s]
        assert agent.values(agent.learned.result.q, states).tobytes() == (
            expected.tobytes()
        )
        played = again(made, agent, rows(made, seed)[-1])
        length = played.length[0, 0]
        assert (npz["trajectory"] == played.state[0, 0, : length + 1]).all()
        assert (npz["trajectory_actions"] == played.action[0, 0, :length]).all()


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


def test_an_agent_acts_in_a_fresh_process_in_gymnasiums_loop(tmp_path):
    words = KINDS["dqn in gymnasium"]
    made = run(tmp_path, *words)
    program = """if True:
        import sys, bcrl, numpy as np
        agent = bcrl.load(sys.argv[1], seed=1)
        env, done = agent.make(), False
        seen, actions = [env.reset(seed=5)[0]], []
        while not done:
            actions.append(agent.act(seen[-1]))
            new, _, ended, cut, _ = env.step(actions[-1])
            seen.append(new)
            done = ended or cut
        assert actions == agent.act(np.array(seen[:-1])).tolist()
        print(agent.q(np.array(seen)).tobytes().hex(), *actions)
    """
    command = [sys.executable, "-c", program, str(made.directory)]
    values, *actions = subprocess.check_output(command, text=True).split()
    agent = bcrl.load(made.directory, seed=1)
    env, seen = agent.make(), []
    seen.append(env.reset(seed=5)[0])
    for action in actions:
        seen.append(env.step(int(action))[0])
    assert agent.q(np.array(seen)).tobytes().hex() == values


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


def test_files_that_are_not_what_a_run_wrote_are_refused(tmp_path):
    made = run(tmp_path, *MAZE)
    path = seed_path(made.directory, 0, "agent")
    whole, json_path = path.read_bytes(), seed_path(made.directory, 0, "json")
    for broken in (whole[:-100], whole.replace(b"about", b"abouT"), b""):
        path.write_bytes(broken)
        with pytest.raises(BcrlError, match=r"seed_0000\.agent"):
            bcrl.load(made.directory)
    other = serialization.relabelled(seed_path(made.directory, 1, "agent"), {})
    for wrong in (b"PK\x03\x04", other, whole[:-100]):
        path.write_bytes(wrong)
        hashes = about(made, 0)["sha256"] | {"agent": files.sha256(wrong)}
        resealed(json_path, sha256=hashes)
        with pytest.raises(BcrlError, match=r"seed_0000\.agent"):
            bcrl.load(made.directory)
    path.unlink()
    for seed, why in ((0, "missing"), (7, "seeds 0–1")):
        with pytest.raises(BcrlError, match=why):
            bcrl.load(made.directory, seed)
    with pytest.raises(BcrlError, match="is no folder"):
        bcrl.load(tmp_path / "nothing")


def test_an_agent_of_another_seed_is_not_taken_for_this_one(tmp_path):
    made = run(tmp_path, *MAZE)
    other = seed_path(made.directory, 1, "agent").read_bytes()
    seed_path(made.directory, 0, "agent").write_bytes(other)
    hashes = about(made, 0)["sha256"] | {"agent": files.sha256(other)}
    resealed(seed_path(made.directory, 0, "json"), sha256=hashes)
    with pytest.raises(BcrlError, match="holds no agent of seed 0"):
        bcrl.load(made.directory)


def test_a_config_that_names_code_needs_trust(tmp_path):
    made = run(tmp_path, *MAZE)
    document = about(made, 0)
    env = document["config"]["env"] | {"name": "a_strangers.module"}
    path = seed_path(made.directory, 0, "json")
    resealed(path, config=document["config"] | {"env": env})
    with pytest.raises(BcrlError, match="trust='a_strangers'"):
        bcrl.load(made.directory)


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


def test_episodes_are_evaluated_in_a_task_of_choice(tmp_path, capsys):
    made = run(tmp_path, *KINDS["car_on_hill BC"])
    words = [str(made.directory), "--episodes", "7"]
    assert evaluate.main(words) == 0
    path = made.directory / "evaluation.csv"
    first = path.read_text()
    lines = first.splitlines()
    assert len(lines) == 1 + 2 * 7 and lines[0].startswith("seed,episode,return")
    out = ["--out", str(tmp_path / "other.csv")]
    assert evaluate.main([*words, "--task", "3", *out]) == 0
    assert (tmp_path / "other.csv").read_text() == first  # the target
    assert evaluate.main([*words, "env.mass=0.8", *out]) == 0
    assert evaluate.main([*words, "--task", "1", "--out", str(path)]) == 0
    assert (tmp_path / "other.csv").read_text() == path.read_text() != first
    for wrong in (["env.mas=1"], ["mass=1"], ["--task", "4"], ["--episodes", "0"]):
        assert evaluate.main([str(made.directory), *wrong]) == 2
    assert evaluate.main([str(tmp_path)]) == 2
