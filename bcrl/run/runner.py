"""The one runner: the seeds of plans become jobs, done by processes, and records."""

import time
from collections.abc import Sequence
from dataclasses import replace

from bcrl.common import compiling
from bcrl.common.signals import Interrupted, Stop
from bcrl.common.terminal import say
from bcrl.config.plan import KEEP, Plan
from bcrl.errors import BcrlError
from bcrl.evaluation import oracle
from bcrl.evaluation.metrics import needs_reference
from bcrl.results.layout import COMPLETE, seed_name
from bcrl.run import agent_files, checkpoints, extension, job, locks, memory, records
from bcrl.run.origin import run_origin
from bcrl.run.progress import Progress
from bcrl.run.schedule import Failures, Job, merged, ordered
from bcrl.run.summary import summary
from bcrl.run.workers import cores, do_jobs


class SeedsFailed(BcrlError):
    """Some seeds failed, all others are complete: which, why, and how to rerun them."""

    exit_code = 1


def run(*plans: Plan) -> None:
    """Compute and record every seed of the plans that is not complete yet.

    All plans share one pool of processes: jobs of a few seeds, the longest first. It
    waits for seeds that another process computes. Raises SeedsFailed at the end if
    seeds failed, Interrupted after a signal, both with everything else kept.
    """
    compiling.check()
    began, quiet = time.monotonic(), plans[0].config["progress"] == "none"
    plans, stop, failed = tuple(merged(plans)), Stop(), Failures()
    with stop.on_signals():
        for plan in plans:
            _prepare(plan, quiet)
            agent_files.check_start(plan, records.pending(plan))
            extension.adopt(plan)
        while (jobs := ordered(plans, failed)) and not stop.requested:
            if free := [each for each in jobs if _is_free(each)]:
                _train(free, failed, stop)
            else:
                _wait(jobs, quiet, stop)
    if jobs:
        raise Interrupted
    _end(plans, failed, time.monotonic() - began)


def check_complete(plans: Sequence[Plan], seconds: float) -> None:
    """End as `run` after other processes did the work in so many seconds."""
    plans, failed = merged(plans), Failures()
    for plan in plans:
        found = {seed: records.state(plan.directory, seed) for seed in plan.seeds}
        lost = {s: why or x for s, (x, why) in found.items() if x != COMPLETE}
        failed[plan.directory] = lost
    _end(plans, failed, seconds)


def _end(plans: Sequence[Plan], failed: Failures, seconds: float) -> None:
    """Show what the runs achieved; raise SeedsFailed if seeds failed, with the commands
    that run them again."""
    if plans[0].config["progress"] != "none":
        say(summary(plans, seconds))
    number, lines, commands = sum(map(len, failed.values())), list[str](), list[str]()
    for plan in plans:
        reasons = dict(sorted(failed.get(plan.directory, {}).items()))
        lines += records.by_reason(f"  {plan.env} {plan.name}", reasons)
        commands += [f"  {line}" for line in plan.command.splitlines() if reasons]
    if number:
        first = f"{number} seed{'s' * (number > 1)} failed, all others are complete:"
        text = [first, *lines, "to run just this again:", *commands]
        raise SeedsFailed("\n".join(text))


def _prepare(plan: Plan, quiet: bool) -> None:
    """Check a plan's folder, remove leftovers of dead processes, say what is done."""
    records.check_directory(plan)
    locks.tidy(plan.directory)
    checkpoints.remove_done(plan)
    name = f"{plan.env} {plan.name}"
    states = {seed: records.state(plan.directory, seed) for seed in plan.seeds}
    for line in records.problems(f"bcrl: {name}", states):
        say(f"{line}; it is computed again")
    done = [seed for seed, (state, _) in states.items() if state == COMPLETE]
    if done and not quiet:
        say(f"{name}: {len(done)} of {len(plan.seeds)} seeds complete")
    _say_kept(plan, done)


def _say_kept(plan: Plan, done: Sequence[int]) -> None:
    """Name the complete seeds that keep less than the plan's `keep` asks for."""
    reasons, asked = dict[int, str](), plan.config["keep"]
    if asked == "stages" and plan.config["boosting"]["name"] != "off":
        asked = "final"  # which then holds all stages
    for seed in done:
        kept = records.read_facts(plan.directory, seed)["config"].get("keep", "final")
        if KEEP.index(kept) < KEEP.index(asked):
            why = f"complete with keep={kept}, so keep={asked} has no effect on them; "
            why += f"remove their files in {plan.directory}, or choose another tag"
            reasons[seed] = why
    for line in records.by_reason(f"{plan.env} {plan.name}", reasons):
        say(line)


def _train(jobs: Sequence[Job], failed: Failures, stop: Stop) -> None:
    """Do the jobs, as far as no other process has their seeds; note failed seeds."""
    for plan in (each.plan for each in jobs):
        if plan.family == "FQI" and needs_reference(plan.metrics):
            for task in (plan.target, *(stage.env for stage in plan.stages)):
                oracle.reference(task)  # without Q*, the command ends before any work
    memory.check_fits(jobs)
    options = jobs[0].plan.config
    workers = min(options["workers"], len(jobs))
    threads = options["threads"] or max(1, cores() // workers)
    origin = run_origin()  # of the code that starts: its files may change meanwhile
    jobs = [replace(each, threads=threads, origin=origin) for each in jobs]
    shown = Progress(jobs, workers, options["progress"])
    outcomes = do_jobs(job.train, jobs, workers, shown.tick, stop)
    try:
        for number, lost in outcomes:
            plan = jobs[number].plan
            if isinstance(lost, str):  # why the process died
                left = records.pending(plan, jobs[number].seeds)
                lost = {} if stop.requested else dict.fromkeys(left, lost)
            if lost:
                failed.setdefault(plan.directory, {}).update(lost)
    finally:
        shown.close()


def _is_free(work: Job) -> bool:
    """Whether this process can train something of a job; of a checkpoint's, all."""
    held = (locks.is_held(work.plan.directory, seed) for seed in work.seeds)
    return not (any(held) if work.resumes else all(held))


def _wait(jobs: Sequence[Job], quiet: bool, stop: Stop) -> None:
    """Wait until one of the jobs that other processes do is free."""
    if not quiet:
        lock = locks.Lock(jobs[0].plan.directory, seed_name(jobs[0].seeds[0]))
        say(f"waiting for {len(jobs)} jobs: {lock.path} is held by {lock.holder()}")
    pause = 0.1
    while not (stop.requested or any(map(_is_free, jobs))):
        time.sleep(pause)
        pause = min(2.0, 1.5 * pause)
