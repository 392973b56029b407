"""For the terminal: what a command would run, what is done, what went wrong."""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from bcrl.common.identity import Plain
from bcrl.common.text import aligned
from bcrl.config import jobs, tags
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.results import layout
from bcrl.run import costs, locks, memory, records
from bcrl.run.schedule import Failures, merged, ordered

#: What the words of a command line begin with that chooses no run.
_NO_CHOICE = ("runs_dir=", "logger")


def dry_run(plans: Sequence[Plan]) -> str:
    """The jobs that these plans would be now, and their expected costs."""
    plans, failed, rows = merged(plans), Failures(), {}
    left = ordered(plans, failed)
    sizes = [(job, memory.expected_bytes(job)) for job in left]
    for plan in plans:
        own = [job for job in left if job.plan is plan]
        todo = layout.spelled([seed for job in own for seed in job.seeds])
        done = len(plan.seeds) - len(records.pending(plan))
        minutes = sum(job.seconds for job in own) / 60
        each = max((size for job, size in sizes if job.plan is plan), default=0.0)
        rows[str(plan.directory)] = [done, todo, len(own), minutes, each / memory.GIB]
    hopeless = [why for reasons in failed.values() for why in set(reasons.values())]
    seconds, workers = [job.seconds for job in left], plans[0].config["workers"]
    wall = f"{costs.makespan(seconds, workers) / 60:.1f} min with workers={workers}"
    total = f"{len(left)} jobs, about {sum(seconds) / 60:.1f} core minutes"
    at_once = sum(sorted(size for _, size in sizes)[-workers:]) / memory.GIB
    room = f"about {at_once:.1f} of {memory.available() / memory.GIB:.1f} GiB"
    last = f"{total}, {wall}, {room}; nothing was run or written"
    table = aligned(rows, "complete", "to do", "jobs", "core min", "GiB per job")
    settings = tags.meanings({plan.directory: plan.settings for plan in plans})
    return "\n".join([table, *settings, *hopeless, last])


def asked_folders(arguments: Namespace) -> list[tuple[Plan, Path, Sequence[int]]]:
    """A command line's folders and seeds; without a choice of runs, all in `runs_dir`.

    Each with its plan, or with one that has the command line's output keys only.
    """
    if not all(override.startswith(_NO_CHOICE) for override in arguments.overrides):
        plans = merged(jobs.plans(arguments))
        return [(plan, plan.directory, plan.seeds) for plan in plans]
    any_ = [*arguments.overrides, "env=maze"]  # it is a required choice
    words = Namespace(**vars(arguments) | {"overrides": any_})
    found: list[tuple[Plan, Path, Sequence[int]]] = []
    for plan in jobs.plans(words):
        for path in sorted(plan.root.glob(f"*/*/*/{layout.CONFIG}")):
            begun = layout.recorded_seeds(path.parent, "json")
            documents = [records.read_facts(path.parent, seed) for seed in begun]
            ever = set(begun).union(*(layout.requested(d) for d in documents if d))
            found.append((plan, path.parent, sorted(ever)))
        if not found:
            raise BcrlError(f"runs_dir={plan.root}: holds no runs")
    arguments.folders = words.folders
    return found


def status(arguments: Namespace) -> str:
    """The states of a command line's seeds, or of all in its `runs_dir`, as a table."""
    rows, lines, settings = dict[str, list[int]](), list[str](), dict[Path, Plain]()
    for plan, directory, seeds in asked_folders(arguments):
        there = directory == plan.directory
        known = (
            plan.settings if there else tags.settings_of(directory, arguments.folders)
        )
        settings[directory] = known
        name = " ".join(directory.parts[-3:])
        found = {seed: records.state(directory, seed) for seed in seeds}
        lines += records.problems(name, found)
        found |= {s: (layout.RUNNING, "") for s in seeds if locks.is_held(directory, s)}
        states = [state for state, _ in found.values()]
        rows[name] = [len(seeds), *map(states.count, records.STATES)]
    rows["in all"] = [sum(column) for column in zip(*rows.values(), strict=True)]
    table = aligned(rows, "seeds", *records.STATES)
    return "\n".join([table, *tags.meanings(settings), *lines])
