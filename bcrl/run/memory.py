"""How much memory jobs need, how much there is, and the rejection of what can't fit."""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from bcrl.envs import is_finite
from bcrl.errors import ConfigError
from bcrl.learning.transfer import ALWAYS, NEVER
from bcrl.run.schedule import Job

GIB = 2**30
_NODE = 16  # bytes of a tree per row: half a leaf, with its share of inner nodes
_FOREST = "algorithm.regressor.trees"
_CGROUPS = Path("/sys/fs/cgroup")


def needed(job: Job) -> dict[str, int]:
    """Bytes that a job needs, by the config key that decides most of them.

    Forests are estimated from above (episodes of full length); the rest is allocated.
    """
    found, plan = dict[str, int](), job.plan
    boosting = plan.config["boosting"]
    boosts, fold = boosting["name"] != "off", boosting.get("fold", NEVER)
    for stage in plan.stages:
        env, learner = stage.env, vars(stage.learner)
        d, finite = env.state_dim, is_finite(env)
        # States as float64 and draws; a copy has only the steps that episodes had.
        episode = 8 * (env.horizon + 1) * (d + 4 + env.step_noise)
        row = 4 * (2 * d + env.n_actions + 4) + 1  # of learning/replay.py
        episodes, held = learner.get("episodes", 0), learner.get("replay_size", 0)
        trees = 0 if finite else getattr(learner.get("regressor"), "trees", 0)
        n = len(plan.stages)
        forests = (
            min(n, {NEVER: n, ALWAYS: 2}.get(fold, fold)) if boosts else 1
        )  # that are kept
        evaluated = 2 * episode * learner.get("evaluation_episodes", 0)
        sizes = {"episodes": episode * episodes, "evaluation_episodes": evaluated}
        sizes["replay_size"] = row * min(held, stage.learner.length)
        sizes["regressor.trees"] = forests * trees * _NODE * episodes * env.horizon
        for key, size in sizes.items():
            found[f"algorithm.{key}"] = max(found.get(f"algorithm.{key}", 0), size)
    return {key: len(job.seeds) * size for key, size in found.items() if size}


def expected_bytes(job: Job) -> float:
    """Bytes of a process that does a job."""
    return _base(job) + sum(needed(job).values())


def _base(job: Job) -> float:
    """Bytes of a process before it has data: with the libraries of its family."""
    return (0.2 if job.plan.family == "FQI" else 0.35) * GIB


def available() -> float:
    """Bytes that this machine, or the cgroup of this process, allows."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text("utf-8").splitlines():
            _, kind, path = line.split(":", 2)
            name = "memory.max" if not kind else "memory.limit_in_bytes"
            inner = _CGROUPS / kind / path.lstrip("/")
            for folder in (inner, *inner.parents) if kind in ("", "memory") else ():
                with suppress(OSError, ValueError):  # there is none, or it says "max"
                    limits.append(int((folder / name).read_text("utf-8")))
    return min(limits)


def check_fits(jobs: Sequence[Job]) -> None:
    """Raise ConfigError if the data of the largest jobs that run at once can't fit."""
    workers, there = jobs[0].plan.config["workers"], available()
    largest = sorted(jobs, key=_certain_bytes, reverse=True)[:workers]
    total, first = sum(map(_certain_bytes, largest)), largest[0]
    sizes = _certain(first)
    if total <= there or not sizes:
        return
    key = max(sizes, key=sizes.__getitem__)
    value = first.plan.config["algorithm"].get(key.rpartition(".")[2])
    what = f"{first.plan.env} {first.plan.name} and what runs with it"
    why = f"{what} (workers={workers}) need {total / GIB:.1f} GiB of memory, but there "
    why += f"are {there / GIB:.1f}; lower {key}, workers, or seeds.lockstep "
    raise ConfigError(key, value, why + f"(now {len(first.seeds)})")


def _certain(job: Job) -> dict[str, int]:
    """What a job needs but for its forests, whose estimate is from above."""
    return {key: size for key, size in needed(job).items() if key != _FOREST}


def _certain_bytes(job: Job) -> float:
    return _base(job) + sum(_certain(job).values())
