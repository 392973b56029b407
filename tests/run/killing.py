"""Kills runs at random moments and lets them resume; a program, because it forks.

This process imports and composes, children do the rest: threads don't survive a fork.
`python -m tests.run.killing FOLDER SEED KILLS NAME` prints a JSON object.
"""

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import torch

from bcrl.config.plan import Plan
from bcrl.run import runner
from tests.conftest import plan
from tests.run.runs import KINDS, compared

RACE = (*KINDS["maze BC"], "seeds.count=6", "seeds.lockstep=1", "tag=x")
RACE += ("algorithm.regressor.trees=30", "threads=1")
LIMIT = 120.0  # seconds for one run, however often it is killed


def forked(work: Callable[[], object]) -> int:
    """The process that does `work` and then leaves; 9 if it raised."""
    child = os.fork()
    if child:
        return child
    try:
        work()
        os._exit(0)
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(9)


def undisturbed(folder: Path, words: tuple[str, ...]) -> tuple[Plan, float]:
    """A whole run and its seconds, after one that compiles."""
    for place in ("compiling", "calm"):
        p, began = plan(*words, f"runs_dir={folder / place}"), time.monotonic()
        assert os.waitpid(forked(partial(runner.run, p)), 0)[1] == 0
    return p, time.monotonic() - began


def run_until_write(p: Plan, fatal: int) -> None:
    """A run that is killed in its n-th write, when half of the file is there."""
    fsync, calls = os.fsync, []

    def deadly(file: int) -> None:
        calls.append(file)
        if len(calls) == fatal:
            with suppress(OSError):  # a folder has no half
                os.ftruncate(file, os.fstat(file).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        fsync(file)

    os.fsync = deadly
    runner.run(p)


def torment(words: tuple[str, ...], folder: Path, rng: random.Random, kills: int):
    """A run killed `kills` times; whether it ends as if it were not."""
    calm, seconds = undisturbed(folder, words)
    writes = 2 * len(list(calm.directory.iterdir()))
    done = rounds = inside = 0
    began = time.monotonic()
    while done < kills and time.monotonic() < began + LIMIT:
        rounds += 1
        p = plan(*words, f"runs_dir={folder / str(rounds)}", "checkpoint_every=0.1")
        while True:
            if done == kills:
                child = forked(partial(runner.run, p))
            elif within := rng.random() < 0.3:  # in the middle of a write
                child = forked(partial(run_until_write, p, rng.randint(1, writes)))
            else:
                child = forked(partial(runner.run, p))
                time.sleep(rng.uniform(0.1, 1.2) * seconds)
                os.kill(child, signal.SIGKILL)
            status = os.waitpid(child, 0)[1]
            if not os.WIFSIGNALED(status):
                break
            done, inside = done + 1, inside + within
        if problem := compared(calm, p) or status:
            return {"kills": done, "problem": problem}
    return {"kills": done, "inside": inside, "runs": rounds, "problem": None}


def race(folder: Path, rng: random.Random, processes: int) -> dict:
    """Several processes at the same seeds, one of them killed; who computed what."""
    calm, seconds = undisturbed(folder, RACE)
    p = plan(*RACE, f"runs_dir={folder / 'raced'}", "checkpoint_every=0.05")
    computed = folder / "computed"
    computed.mkdir()

    def work() -> None:
        replace = os.replace

        def noted(source, target) -> None:
            if Path(target).match("seed_*.npz"):
                (computed / f"{Path(target).stem}_{os.getpid()}").touch()
            replace(source, target)

        os.replace = noted
        runner.run(p)

    children = [forked(work) for _ in range(processes)]
    time.sleep(rng.uniform(0.2, 0.6) * seconds)
    os.kill(children[0], signal.SIGKILL)
    left = [os.waitpid(child, 0)[1] for child in children][1:]
    made = sorted(int(file.name.split("_")[1]) for file in computed.iterdir())
    problem = compared(calm, p) or (f"statuses {left}" if any(left) else None)
    return {"problem": problem, "computed": made}


if __name__ == "__main__":
    torch.set_num_threads(1)
    place, seed, kills, name = sys.argv[1:]
    rng = random.Random(f"{seed} {name}")
    if name.startswith("race of"):
        found = race(Path(place), rng, int(name.split()[-1]))
    else:
        words = (*KINDS[name], "threads=1")
        found = torment(words, Path(place), rng, int(kills))
    print(json.dumps(found))
