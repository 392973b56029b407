"""Kills runs at random moments and lets them resume; a program, because it forks.

This process imports and composes, children do the rest: threads don't survive a fork.
`python -m tests.run.killing FOLDER SEED KILLS NAME…` prints one JSON object per name.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from bcrl.common import files
from bcrl.config.plan import Plan
from bcrl.run import records, runner
from tests.conftest import plan
from tests.run.runs import DQN, FQI, METHODS, RELEASED, compared, dqn

SMALL = tuple(word for word in DQN if word != "env=linear_system")
RUNS = {
    f"{env} {name}": (f"env={env}", f"variant={name}", *FQI)
    for env in ("maze", "car_on_hill")
    for name in ("plain", "C", "B", "BC", "SC")
}
RUNS |= {f"dqn {name}": dqn(name) for name in METHODS + RELEASED}
HILL = ("env=car_on_hill", *FQI, "tag=x")
FOREST = ("algorithm/regressor=sklearn_forest", "algorithm.regressor.trees=3")
CART = ("env.horizon=90", "scale.max_steps=150", "algorithm.learning_starts=60")
DATA = ("algorithm.dataset=shared", "algorithm.new_data=task")
RUNS |= {
    "dqn in the maze": ("env=maze", *SMALL, "variant=SBC", "scale.max_steps=100"),
    "fqi on the system": ("env=linear_system", "variant=BC", *FQI),
    "sklearn's forest": (*HILL, "variant=BC", *FOREST),
    "sklearn by name": (*HILL, "variant=C", "algorithm/regressor=sklearn"),
    "fqi in gymnasium": ("env=acrobot", "variant=BC", *FQI, "env.horizon=15"),
    "dqn in gymnasium": ("env=cart_pole", *SMALL, "variant=SBC", *CART),
    "the same data": (*HILL, "variant=B", *DATA),
}
LIMIT = 120.0  # seconds for one run, however often it is killed


def planned(name: str, folder: Path, *more: str) -> Plan:
    return plan(*RUNS[name], "threads=1", f"runs_dir={folder}", *more)


def forked(work: Callable[[], None]) -> int:
    """The process that does `work` and then leaves; 9 if it raised."""
    child = os.fork()
    if child:
        return child
    try:
        import torch

        torch.set_num_threads(1)
        work()
        os._exit(0)
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(9)


class Counter:
    """Counts written bytes, and kills its process in the middle of byte `fatal`."""

    def __init__(self, fatal: int | None) -> None:
        self.fatal, self.written = fatal, 0

    def open(self, *arguments):
        self.file = open(*arguments)  # noqa: SIM115
        return self

    def write(self, data) -> int:
        data = bytes(data)
        self.written += len(data)
        if self.fatal is not None and self.written > self.fatal:
            self.file.write(data[: len(data) - (self.written - self.fatal)])
            self.file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.file.write(data)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()

    def __getattr__(self, name: str):
        return getattr(self.file, name)


def counted(p: Plan, count: Counter) -> None:
    """Run a plan whose written bytes are counted."""
    files.open = count.open
    runner.run(p)


def whole(p: Plan) -> tuple[float, int]:
    """Seconds and written bytes of an undisturbed run."""
    reader, writer = os.pipe()

    def work() -> None:
        counted(p, count := Counter(None))
        os.write(writer, str(count.written).encode())

    began = time.monotonic()
    assert os.waitpid(forked(work), 0)[1] == 0, p.name
    return time.monotonic() - began, int(os.read(reader, 99))


def torment(name: str, folder: Path, rng: random.Random, kills: int) -> dict:
    """A run killed `kills` times; whether it ends as if it were not."""
    whole(planned(name, folder / "compiling"))
    calm = planned(name, folder / "calm")
    seconds, size = whole(calm)
    done = rounds = inside = 0
    began = time.monotonic()
    while done < kills and time.monotonic() < began + LIMIT:
        rounds += 1
        p = planned(name, folder / f"{rounds}", "checkpoint_every=0.01")
        while True:
            within = rng.random() < 0.3  # in the middle of a write
            count = Counter(rng.randrange(size) if within else None)
            child = forked(lambda p=p, count=count: counted(p, count))
            if not within:
                time.sleep(rng.uniform(0.1, 1.2) * seconds)
                os.kill(child, signal.SIGKILL)
            status = os.waitpid(child, 0)[1]
            if not os.WIFSIGNALED(status):
                break
            done, inside = done + 1, inside + within
        problem = compared(calm, p)
        if status or problem:
            return {"kills": done, "problem": problem or f"status {status}"}
    return {"kills": done, "inside": inside, "runs": rounds, "problem": None}


def race(folder: Path, rng: random.Random, processes: int) -> dict:
    """Several processes at the same seeds, one of them killed; who computed what."""
    more = ("seeds.count=6", "seeds.lockstep=1", "algorithm.regressor.trees=30")
    whole(planned("maze BC", folder / "compiling", *more, "tag=x"))
    calm = planned("maze BC", folder / "calm", *more, "tag=x")
    seconds, _ = whole(calm)
    p = planned("maze BC", folder / "raced", *more, "tag=x", "checkpoint_every=0.05")
    computed = folder / "computed"
    computed.mkdir()

    def work() -> None:
        write = records.write_seed

        def noted(plan: Plan, seed: int, *rest) -> None:
            (computed / f"{seed}_{os.getpid()}").touch()
            write(plan, seed, *rest)

        records.write_seed = noted
        runner.run(p)

    children = [forked(work) for _ in range(processes)]
    time.sleep(rng.uniform(0.2, 0.6) * seconds)
    os.kill(children[0], signal.SIGKILL)
    left = [os.waitpid(child, 0)[1] for child in children][1:]
    made = sorted(int(file.name.split("_")[0]) for file in computed.iterdir())
    problem = compared(calm, p) or (f"statuses {left}" if any(left) else None)
    return {"problem": problem, "computed": made}


def main(folder: str, seed: str, kills: str, *names: str) -> None:
    for name in names or RUNS:
        rng = random.Random(f"{seed} {name}")
        place = Path(folder, name.replace(" ", "_").replace("'", ""))
        place.mkdir()
        if name.startswith("race of"):
            found = race(place, rng, int(name.split()[-1]))
        else:
            found = torment(name, place, rng, int(kills))
        print(json.dumps({"name": name, **found}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
