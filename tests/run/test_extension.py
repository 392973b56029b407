"""A longer run continues from the end of a shorter one, as if it had never stopped."""

import signal
from dataclasses import replace
from functools import partial

import pytest

import bcrl
from bcrl.common.signals import Interrupted
from bcrl.errors import BcrlError, ConfigError
from bcrl.results.layout import seed_path
from bcrl.run import records
from tests.conftest import plan
from tests.run.runs import (
    DQN,
    HILL,
    MAZE,
    TABULAR,
    about,
    at_row,
    compared,
    resealed,
    rows,
    run,
)

#: The words of a run, how long its last stage is, and how long it is to be.
LONGER = {
    "maze BC": (
        MAZE,
        "algorithm.iterations=2",
        "algorithm.iterations=[2,2,2,2,2,2,2,2,2,5]",
    ),
    "hill": (HILL, "algorithm.iterations=[2,2,2]", "algorithm.iterations=[2,2,5]"),
    "hill BC": (
        (*HILL, "variant=BC"),
        "algorithm.iterations=[2,2,2]",
        "algorithm.iterations=[2,2,5]",
    ),
    "dqn": (DQN, "algorithm.steps=37", "algorithm.steps=90"),
    "dqn BC": (
        (*DQN, "variant=BC", "algorithm.learners=dqn"),
        "algorithm.steps=[40,37]",
        "algorithm.steps=[40,90]",
    ),
}
MORE = ("scale.max_iterations=9", "scale.max_steps=700", "tag=x")


@pytest.mark.parametrize("kind", LONGER)
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_longer_run_equals_one_that_was_longer_from_the_start(
    kind, interrupted, tmp_path, monkeypatch
):
    words, short, long = LONGER[kind]
    words = (*words, *MORE)
    if "dqn" in kind:
        words += ("algorithm.evaluate_every=20",)  # which divides no length
    first = run(tmp_path / "short", *words, short, "keep=state")
    calm = run(tmp_path / "calm", *words, long)
    extend = f"extend={first.directory}"
    if interrupted:
        added = len(rows(calm, 0)) - len(rows(first, 0))
        signals = partial(signal.raise_signal, signal.SIGTERM)
        with monkeypatch.context() as patch, pytest.raises(Interrupted):
            at_row(patch, 2 * (len(rows(first, 0)) + added // 2), signals)
            run(tmp_path / "longer", *words, long, extend)
    other = run(tmp_path / "longer", *words, long, extend)
    assert compared(calm, other) is None


def test_only_the_last_stage_may_be_longer(tmp_path):
    words, short, long = LONGER["hill"]
    first = run(tmp_path / "short", *words, *MORE, short)
    kept = run(tmp_path / "kept", *words, *MORE, short, "keep=state")
    for more, folder, why in (
        ((long,), first, "no keep=state"),
        ((long,), first.directory.parent, "holds no run"),
        ((short,), kept, "ask for more"),
        ((long, "algorithm.episodes=7"), kept, "other tasks, metrics or stages"),
        ((long, "seeds.count=3"), kept, "no state of seeds 2"),
        ((long, "seeds=[1]"), kept, "seeds 0–1 were trained together"),
    ):
        place = getattr(folder, "directory", folder)
        with pytest.raises(ConfigError, match=why):
            run(tmp_path / "none", *words, *MORE, *more, f"extend={place}")
        assert not (tmp_path / "none").exists()


SHORT, LONG = (
    (*TABULAR, *MORE, f"algorithm.iterations=[{'1,' * 9}{last}]") for last in (2, 5)
)


def test_lost_seeds_and_parts_go_on_in_their_group(tmp_path):
    first = run(tmp_path / "short", *SHORT, "keep=state")
    calm, extend = run(tmp_path / "calm", *LONG), f"extend={first.directory}"
    longer = run(tmp_path / "longer", *LONG, extend)
    for path in longer.directory.glob("seed_0001*"):
        path.unlink()
    assert compared(calm, run(tmp_path / "longer", *LONG, extend)) is None
    for number in (1, 2):
        other = run(tmp_path / "parts", *LONG, extend, f"seeds.part={number}/2")
        assert records.pending(replace(other, seeds=other.asked)) == []
    assert compared(calm, other) is None


def test_a_state_is_there_before_the_results(tmp_path, monkeypatch):
    words = (*SHORT, "keep=state")
    made = plan(*words, f"runs_dir={tmp_path}")

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(records, "write_seed", killed)
        run(tmp_path, *words)
    (state,) = made.directory.glob("state_*.npz")
    whole = state.read_bytes()
    run(tmp_path, *words)
    assert len(state.read_bytes()) == len(whole)
    state.write_bytes(whole[:-100])
    with pytest.raises(BcrlError, match=state.name):
        run(tmp_path / "longer", *LONG, f"extend={made.directory}")


def test_a_longer_run_starts_from_the_same_agents(tmp_path):
    one, other = (
        run(tmp_path / name, *TABULAR, "tag=x", f"algorithm.epsilon={name}")
        for name in ("0.9", "0.8")
    )
    start = f"start.from={one.directory}"
    kept = run(tmp_path / "short", *SHORT, "keep=state", "boosting=on", start)
    start, extend = f"start.from={other.directory}", f"extend={kept.directory}"
    with pytest.raises(ConfigError, match="starts from other agents"):
        run(tmp_path / "longer", *LONG, "boosting=on", start, extend)


def test_runs_of_older_versions_are_extended(tmp_path):
    first = run(tmp_path / "short", *SHORT, "keep=state")
    for seed in (0, 1):
        config = about(first, seed)["config"]
        older = {
            k: v for k, v in config.items() if k not in ("keep", "start", "extend")
        }
        resealed(seed_path(first.directory, seed, "json"), config=older)
    calm = run(tmp_path / "calm", *LONG)
    longer = run(tmp_path / "longer", *LONG, f"extend={first.directory}")
    assert compared(calm, longer) is None
    resealed(seed_path(first.directory, 0, "json"), config={"env": {}})
    with pytest.raises(BcrlError, match="short"):
        run(tmp_path / "other", *LONG, f"extend={first.directory}")


def test_residuals_that_an_interruption_lost_are_named(tmp_path, monkeypatch, capsys):
    words = (*TABULAR, "variant=C", "algorithm.iterations=1")
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        at_row(patch, 10, partial(signal.raise_signal, signal.SIGTERM))
        run(tmp_path, *words)
    capsys.readouterr()
    made = run(tmp_path, *words, "keep=stages")
    n = 10 - len(bcrl.load(made.directory).residuals)
    assert n > 0 and f"residuals of {n} " in capsys.readouterr().err


def test_complete_seeds_that_keep_less_than_asked_are_named(tmp_path, capsys):
    def said(*words):
        capsys.readouterr()
        run(tmp_path, *TABULAR, *words)
        return "no effect" in capsys.readouterr().err

    assert not said("algorithm.iterations=1")
    assert not said("algorithm.iterations=1", "keep=none")
    assert said("algorithm.iterations=1", "keep=state")
    assert not said("algorithm.iterations=1", "keep=state", "tag=y")
    assert not said("algorithm.iterations=1", "keep=stages", "tag=y")
