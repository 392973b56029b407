"""Logged transitions, from which fitted Q-iteration learns without its own episodes."""

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import Env, is_finite
from bcrl.errors import ConfigError
from bcrl.learning import logged_files
from bcrl.learning.logged_files import NEEDED, SCHEME, TERMINATED, unusable
from bcrl.learning.rollout import Episodes


@dataclass(frozen=True, eq=False)
class Transitions:
    """N logged transitions in any order, from any policy.

    `absorbing` is true where the next state ends the task, so that its value is 0. It
    is false where a time limit cut the episode: next_observation is then the last one
    observed, and its value is learned. Raises ConfigError for arrays that do not fit.
    """

    observation: NDArray  # (N, d)
    action: NDArray  # (N,) integers from 0
    reward: NDArray  # (N,)
    next_observation: NDArray  # (N, d)
    absorbing: NDArray  # (N,) booleans
    episode: NDArray | None = None  # (N,) integers; for readers, FQI ignores it
    task: NDArray | None = None  # (N,) integers from 1, the easiest task first

    def __post_init__(self) -> None:
        n = np.shape(self.observation)[:1]
        for name, values in self._arrays().items():
            kinds, noun, axes = SCHEME[name]
            dtype, shape = getattr(values, "dtype", None), np.shape(values)
            if dtype is None or dtype.kind not in kinds:
                raise ConfigError(name, dtype, f"must be an array of {noun}")
            if len(shape) != axes or shape[:1] != n or 0 in shape:
                what = "(N, d)" if axes == 2 else f"({', '.join(map(str, n)) or 'N'},)"
                why = f"must have the shape {what}, with at least one transition"
                raise ConfigError(name, shape, why)
            with np.errstate(over="ignore"):  # regressors see states as float32
                seen = values.astype(np.float32) if axes == 2 else values
            if bad := np.count_nonzero(~np.isfinite(seen)):
                why = "are not finite" + " in float32" * (axes == 2)
                raise ConfigError(name, f"{bad} numbers", why)
        if self.observation.shape != self.next_observation.shape:
            why = f"must have the shape of observation, {self.observation.shape}"
            raise ConfigError("next_observation", self.next_observation.shape, why)

    @classmethod
    def of_episodes(cls, episodes: Episodes, seed: int = 0) -> "Transitions":
        """All steps of the episodes of the seed with index `seed`, in their order."""
        length = episodes.length[seed]  # (E,)
        seen = np.arange(episodes.reward.shape[-1]) < length[:, None]
        state, numbers = episodes.state[seed], np.arange(len(length))
        outcome = episodes.reward[seed][seen], state[:, 1:][seen]
        ends = episodes.absorbing[seed][seen], np.repeat(numbers, length)
        return cls(state[:, :-1][seen], episodes.action[seed][seen], *outcome, *ends)

    def save(self, path: str | PathLike) -> Path:
        """Write a file that `dataset=` reads, *.npz or *.parquet."""
        return logged_files.save_arrays(Path(path), self._arrays())

    def of_task(self, number: int) -> "Transitions":
        """The transitions of a task, numbered from 1; all without an array `task`."""
        if self.task is None:
            return self
        own = self.task == number
        if not own.any():
            known = np.unique(self.task)[:20].tolist()
            why = f"has no transition of task {number}; its array `task` has {known}"
            raise unusable(self, why)
        return replace(self, **{k: v[own] for k, v in self._arrays().items()})

    def check(self, env: Env) -> None:
        """Raise ConfigError if these are no transitions of `env`."""
        d, why = self.observation.shape[1], ""
        least, most = self.action.min(), self.action.max()
        if d != env.state_dim:
            why = f"observation has {d} numbers per row, but a state of {env.name} has "
            why += f"{env.state_dim}"
        elif least < 0 or most >= env.n_actions:
            why = f"action has numbers from {least} to {most}, but {env.name} has the "
            why += f"actions 0 to {env.n_actions - 1}"
        elif is_finite(env):
            listed = env.states().astype(np.float32)
            for name in ("observation", "next_observation"):
                states = getattr(self, name)
                rows = np.clip(env.index(states), 0, len(listed) - 1)
                if bad := (listed[rows] != states.astype(np.float32)).any(-1).sum():
                    why = f"{name} has {bad} rows that are no states of {env.name}"
        if why:
            raise unusable(self, why)

    def _arrays(self) -> dict[str, NDArray]:
        every = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: values for name, values in every.items() if values is not None}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.reward)} transitions)"


@dataclass(frozen=True)
class LoggedFile:
    """A file or Minari dataset with transitions, which must have the SHA-256."""

    name: str  # a path, or minari:ID
    sha256: str = ""  # "": any

    @property
    def is_named(self) -> bool:
        """Whether its place is known; otherwise its hash stands for its name."""
        return self.name != self.sha256

    def __str__(self) -> str:
        return self.name


Logged = Transitions | LoggedFile | str | PathLike


def transitions_of(dataset: Logged, task: int, env: Env) -> Transitions:
    """The transitions of a stage's task; ConfigError if they do not suit `env`."""
    try:
        found = read_transitions(dataset).of_task(task)
        found.check(env)
    except ConfigError as error:
        if isinstance(error.value, Transitions):  # name the file, not its content
            raise unusable(dataset, error.allowed) from error
        raise
    return found


def read_transitions(dataset: Logged) -> Transitions:
    """The transitions of a file, a folder of Minari's or `minari:ID`; as they are."""
    if isinstance(dataset, Transitions):
        return dataset
    if not isinstance(dataset, LoggedFile | str | PathLike):
        raise unusable(dataset, "must be Transitions, a path or minari:ID")
    file = dataset if isinstance(dataset, LoggedFile) else LoggedFile(str(dataset))
    path = logged_files.locate(file.name)
    content = logged_files.content_sha256(path)
    if file.sha256 not in ("", content):
        why = f"has the SHA-256 {content}, not {file.sha256}: it was changed"
        raise unusable(file, f"{why}; run the command again")
    return _read(path, content)


@lru_cache(maxsize=4)  # stages and jobs often share a file
def _read(path: Path, _content: str) -> Transitions:
    arrays = logged_files.load_arrays(path)
    if TERMINATED in arrays:
        if "absorbing" in arrays:
            raise unusable(path, "has absorbing and terminated; keep one")
        arrays["absorbing"] = arrays.pop(TERMINATED)
    if lacking := [name for name in NEEDED if name not in arrays]:
        why = f"lacks {', '.join(lacking)}; it needs {', '.join(NEEDED)}"
        raise unusable(path, why)
    try:
        return Transitions(**arrays)
    except ConfigError as error:  # name the file, too
        raise unusable(path, str(error)) from error
