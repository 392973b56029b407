"""A longer run continues a shorter one from its kept states (`keep=state`).

A state is a checkpoint of a complete run. It becomes a checkpoint of the longer run,
which then resumes as after an interruption.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bcrl.common import serialization
from bcrl.common.files import write_bytes
from bcrl.common.identity import identity
from bcrl.config.plan import Plan, recorded, unusable_config
from bcrl.errors import ConfigError
from bcrl.learning.stage import CurriculumRun
from bcrl.results.layout import STATE, recorded_seeds, spelled
from bcrl.results.read import read_document
from bcrl.run import checkpoints, records

#: Learner → the setting that makes it learn longer.
_LENGTHS = {"fqi": "iterations", "dqn": "steps"}


def keep(plan: Plan, run: CurriculumRun, content: dict[str, Any]) -> None:
    """Write the state from which a longer run can go on; `content`: a checkpoint's."""
    learner: Any = plan.stages[-1].learner
    if learner.name not in _LENGTHS:
        return
    rows = json.loads(content["rows"])
    if getattr(learner, _LENGTHS[learner.name]) % learner.evaluate_every:
        rows = [own[:-1] for own in rows]  # a longer run does not evaluate there
    content |= {"rows": json.dumps(rows), "kept": content["kept"][:-1]}
    content |= {"residuals": content["residuals"][:-1]}
    checkpoints.save_checkpoint(plan, run.batch.seeds, content, run.given, STATE)


def adopt(longer: Plan) -> None:
    """Make the kept states of the run `extend` names the plan's own checkpoints.

    Raises BcrlError if that run can't be extended to the plan, or kept no states.
    """
    if (named := longer.config["extend"]) is None:
        return
    begun = [seed for batch in checkpoints.batches(longer) for seed in batch]
    pending = set(records.pending(longer)) - set(begun)
    if not pending:
        return
    folder = Path(named).absolute()
    shorter = _plan(folder, longer)
    _check(longer, shorter, named)
    found = checkpoints.stored(folder, STATE)
    about = checkpoints.about_of(replace(shorter, device=longer.device))
    usable = dict[tuple[int, ...], Path]()
    groups = list[tuple[int, ...]]()  # of pending seeds that this run can't continue
    for path, own in found.items():
        seeds = tuple(own.pop("seeds", ()))
        if own != about or not pending & set(seeds):
            continue
        if not set(longer.asked).issuperset(seeds):
            groups.append(seeds)
        else:
            usable[seeds] = path
            pending -= set(seeds)
    if pending:
        for own in found.values():
            if "error" in own:
                raise own["error"]
        _refuse(folder, sorted(pending), groups, bool(found))
    for seeds, path in usable.items():
        label = checkpoints.about_of(longer) | {"seeds": list(seeds)}
        data = serialization.relabelled(path, label)
        records.make_run_directory(longer)
        write_bytes(checkpoints.checkpoint_path(longer, seeds), data)


def _plan(folder: Path, longer: Plan) -> Plan:
    """The plan of the run in a folder; its logged data are where `longer` has them."""
    seeds = recorded_seeds(folder, "json")
    if not seeds:
        why = "holds no run; name one such as runs/quick/maze/BC-FQI"
        raise ConfigError("extend", str(folder), why)
    document = read_document(folder, seeds[0])
    try:
        named = document["env"], document["tag"], longer.config["algorithm"]
        return recorded(document["config"], *named)
    except ConfigError as error:
        raise ConfigError("extend", str(folder), unusable_config(error)) from error


def _check(longer: Plan, shorter: Plan, named: str) -> None:
    """Raise ConfigError unless one is the other with a longer last stage."""
    old, new = (_parts(each) for each in (shorter, longer))
    learner: Any = longer.stages[-1].learner
    length, why = _LENGTHS.get(learner.name), ""
    if length is None:
        why = f"ends with {learner.name}; only FQI and DQN go on from a state"
    elif old[0] != new[0]:
        why = "starts from other agents, or has other tasks, metrics or stages; "
        why += "only the last stage may be longer"
    elif other := [k for k in new[1] if new[1][k] != old[1].get(k) and k != length]:
        key, value = other[0], old[1].get(other[0])
        why = f"has {key}={value}, this run {new[1][key]}; only {length} may differ"
        why += f" (add algorithm.{key}={value})"
    elif new[1][length] <= old[1][length]:
        why = f"has {old[1][length]} {length}, this run {new[1][length]}: ask for more"
    if why:
        raise ConfigError("extend", named, why)


def _parts(plan: Plan) -> tuple[tuple, dict[str, Any]]:
    """What must be equal, and the settings of the last stage's learner."""
    last = plan.stages[-1]
    start = identity(plan.config).get("start")
    whole = start, plan.tasks, plan.metrics, plan.stages[:-1], type(last.learner)
    return (*whole, last.task, last.env, last.transfers, last.before), vars(
        last.learner
    )


def _refuse(
    folder: Path, seeds: Sequence[int], groups: Sequence[Sequence[int]], found: bool
) -> None:
    """Raise ConfigError: no state of these seeds, or of `groups` that have others, too;
    what to do, and what it costs."""
    spent = [
        records.read_facts(folder, seed).get("cpu_seconds", 0.0)
        for seed in recorded_seeds(folder, "json")
    ]
    why = f"keeps no state of seeds {spelled(seeds)} "
    if groups:
        why += f"alone: seeds {', and '.join(map(spelled, groups))} were trained "
        why += "together; name all of a group (seeds=)"
    else:
        why += "of this version and device" if found else "(its run had no keep=state)"
        why += "; train them there again with keep=state: choose another tag, or "
        why += "remove their files first"
    cost = max(spent, default=0.0) / 60
    why += f" (that run took {cost:.1f} core-minutes per seed); without extend= "
    raise ConfigError("extend", str(folder), f"{why}this run trains from the start")
