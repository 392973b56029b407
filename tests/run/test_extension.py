"""A longer run goes on from the end of a shorter one, as if it had never stopped."""

import signal
from functools import partial

import pytest

from bcrl.common.signals import Interrupted
from bcrl.errors import ConfigError
from tests.run.runs import DQN, HILL, MAZE, at_row, compared, rows, run

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
    ):
        place = getattr(folder, "directory", folder)
        with pytest.raises(ConfigError, match=why):
            run(tmp_path / why[:3], *words, *MORE, *more, f"extend={place}")
