"""What checkpoints cost: the share of a run's time that goes into writing them.

Whole groups at the paper's budgets, with the default interval (a checkpoint at each
stage's end and every 60 s of work), on the disk that holds the temporary folder.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time

from bcrl.config import flags, jobs
from bcrl.results.layout import seed_path
from bcrl.run import checkpoints, runner

CHOICES = {
    "maze FQI": ["env=maze", "seeds.count=4"],
    "maze BC-FQI": ["env=maze", "variant=BC", "seeds.count=4"],
    "hill C-FQI": ["env=car_on_hill", "variant=C", "seeds.count=4"],
    "hill BC-FQI": ["env=car_on_hill", "variant=BC", "seeds.count=4"],
    "DQN": ["env=linear_system", "algorithm=dqn", "seeds.count=20"],
    "BC-DQN": ["env=linear_system", "algorithm=dqn", "variant=BC", "seeds.count=20"],
}


class Timed:
    """A function, and the seconds and calls that went into it."""

    def __init__(self, function) -> None:
        self.function, self.seconds, self.calls, self.bytes = function, 0.0, 0, 0

    def __call__(self, plan, *arguments) -> None:
        began = time.perf_counter()
        self.function(plan, *arguments)
        self.seconds += time.perf_counter() - began
        self.calls += 1
        found = plan.directory.glob("checkpoint_*.npz")
        self.bytes = max([self.bytes, *(path.stat().st_size for path in found)])


def main(every: str = "60") -> None:
    print(f"{'':14}{'run, s':>8}{'written':>9}{'MiB':>8}{'ms each':>9}{'share':>8}")
    for name, choice in CHOICES.items():
        with tempfile.TemporaryDirectory() as folder:
            more = [f"runs_dir={folder}", "progress=none", f"checkpoint_every={every}"]
            sys.argv = ["bcrl", *choice, *more]
            (plan,) = jobs.plans(flags.arguments())
            timed = Timed(checkpoints.save_checkpoint)
            checkpoints.save_checkpoint = timed
            runner.run(plan)
            checkpoints.save_checkpoint = timed.function
            facts = seed_path(plan.directory, 0, "json").read_text()
            run = json.loads(facts)["wall_seconds"]
        each = 1e3 * timed.seconds / max(1, timed.calls)
        print(
            f"{name:14}{run:8.1f}{timed.calls:9}{timed.bytes / 2**20:8.1f}"
            f"{each:9.1f}{timed.seconds / run:8.2%}",
            flush=True,
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
