"""Kills runs at random moments and lets them go on; a program, for it forks.

Its process imports and composes, all else is done in children: threads don't outlive a
fork. `python -m tests.killing FOLDER SEED KILLS NAME…` prints a JSON object a name.
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
from bcrl.run import locks, runner
from tests.conftest import plan

FQI = ("scale=smoke", "seeds.count=2")
DQN = ("env=linear_system", "algorithm=dqn", "seeds.count=2", "scale=smoke")
DQN += ("scale.max_steps=640", "algorithm.evaluation_episodes=3")
DQN += ("algorithm.target_update=7", "tag=x")
METHODS = ("plain", "C", "B", "BC", "SC", "SBC", "RPL", "PPR")
METHODS += ("BC_released", "SC_released", "SBC_released")
RUNS = {
    f"{env} {name}": (f"env={env}", f"variant={name}", *FQI)
    for env in ("maze", "car_on_hill")
    for name in ("plain", "C", "B", "BC", "SC")
}
RUNS |= {f"dqn {name}": (*DQN, f"variant={name}") for name in METHODS}
RUNS["dqn RPL"] += ("transfer.offset=510",)
RUNS["dqn in the maze"] = (*DQN[1:], "env=maze", "variant=SBC", "scale.max_steps=100")
RUNS["fqi on the system"] = ("env=linear_system", "variant=BC", *FQI)
RUNS["sklearn's forest"] = ("env=car_on_hill", "variant=BC", *FQI)
RUNS["sklearn's forest"] += ("algorithm/regressor=sklearn_forest", "tag=x")
RUNS["sklearn's forest"] += ("algorithm.regressor.trees=3",)
RUNS["sklearn by name"] = ("env=car_on_hill", "variant=C", *FQI, "tag=x")
RUNS["sklearn by name"] += ("algorithm/regressor=sklearn",)
RUNS["fqi in gymnasium"] = ("env=acrobot", "variant=BC", *FQI, "env.horizon=15")
RUNS["dqn in gymnasium"] = (*DQN[1:], "env=cart_pole", "variant=SBC", "env.horizon=90")
RUNS["dqn in gymnasium"] += ("scale.max_steps=150", "algorithm.learning_starts=60")
RUNS["the same data"] = ("env=car_on_hill", "variant=B", "algorithm.dataset=shared")
RUNS["the same data"] += (*FQI, "algorithm.new_data=task", "tag=x")
LIMIT = 120.0  # seconds for one run, however often it is killed


def planned(name: str, folder: Path, *more: str) -> Plan:
    options = ("progress=none", "threads=1", f"runs_dir={folder}")
    return plan(*RUNS[name], *options, *more)


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


def whole(p: Plan) -> tuple[float, int]:
    """Seconds and written bytes of a run that nobody disturbs."""
    reader, writer = os.pipe()

    def work() -> None:
        count = Counter(None)
        files.open = count.open
        runner.run(p)
        os.write(writer, str(count.written).encode())

    began = time.monotonic()
    child = forked(work)
    assert os.waitpid(child, 0)[1] == 0, p.name
    return time.monotonic() - began, int(os.read(reader, 99))


class Counter:
    """Counts what is written, and kills its process in the middle of byte `fatal`."""

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


def torment(name: str, folder: Path, rng: random.Random, kills: int) -> dict:
    """A run killed until it was so `kills` times; whether it ends as if it were not."""
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

            def work(p=p, count=count) -> None:
                files.open = count.open
                runner.run(p)

            child = forked(work)
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


def compared(calm: Plan, p: Plan) -> str | None:
    """How a folder differs from an undisturbed run's, JSON's values aside."""
    names = {file.name for file in calm.directory.iterdir()}
    found = {file.name for file in p.directory.iterdir()}
    if names != found:
        return f"files: {sorted(names ^ found)}"
    for name in sorted(names):
        here, there = calm.directory / name, p.directory / name
        if name.endswith("json"):
            document = json.loads(there.read_text())
            if document["status"] != "complete" or not files.is_intact(document):
                return f"{name}: {document['status']}"
        elif here.read_bytes() != there.read_bytes():
            return f"{name} differs"
    return None


def race(folder: Path, rng: random.Random, processes: int) -> dict:
    """Several processes at the same seeds, one of them killed; who computed what."""
    name = "maze BC"
    more = ("seeds.count=6", "seeds.lockstep=1", "algorithm.regressor.trees=30")
    whole(planned(name, folder / "compiling", *more, "tag=x"))
    calm = planned(name, folder / "calm", *more, "tag=x")
    seconds, _ = whole(calm)
    p = planned(name, folder / "raced", *more, "tag=x", "checkpoint_every=0.05")
    computed = folder / "computed"
    computed.mkdir()

    def work() -> None:
        write = runner.records.write_seed

        def noted(plan: Plan, seed: int, *rest) -> None:
            (computed / f"{seed}_{os.getpid()}").touch()
            write(plan, seed, *rest)

        runner.records.write_seed = noted
        runner.run(p)

    children = [forked(work) for _ in range(processes)]
    time.sleep(rng.uniform(0.2, 0.6) * seconds)
    os.kill(children[0], signal.SIGKILL)
    left = [os.waitpid(child, 0)[1] for child in children][1:]
    made = sorted(int(file.name.split("_")[0]) for file in computed.iterdir())
    return {
        "problem": compared(calm, p) or (f"statuses {left}" if any(left) else None),
        "computed": made,
        "processes": len({file.name.split("_")[1] for file in computed.iterdir()}),
    }


def stale(folder: Path) -> dict:
    """A lock file that nobody holds any more."""
    p = planned("maze plain", folder)
    p.directory.mkdir(parents=True)
    lock = locks.seed_lock(p.directory, 0)
    lock.path.write_text("process 1 on elsewhere")
    seconds, _ = whole(p)
    return {"problem": "left" if lock.path.exists() else None, "seconds": seconds}


def main(folder: str, seed: str, kills: str, *names: str) -> None:
    for name in names or RUNS:
        rng = random.Random(f"{seed} {name}")
        place = Path(folder, name.replace(" ", "_").replace("'", ""))
        place.mkdir()
        if name.startswith("race of"):
            found = race(place, rng, int(name.split()[-1]))
        elif name == "stale lock":
            found = stale(place)
        else:
            found = torment(name, place, rng, int(kills))
        print(json.dumps({"name": name, **found}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
