"""Learning curves of a data frame, as `bcrl.api.run` and `read` make it."""

import io
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bcrl.errors import BcrlError, did_you_mean
from bcrl.report.figures import layout, style
from bcrl.report.figures.curves import BAND, draw_metrics
from bcrl.report.variants import Methods, Variant
from bcrl.results.layout import INDEX, SETTING

_WIDTH = 4.5  # inches


def figure_frame(frame: pd.DataFrame, metric: str) -> Figure:
    """A metric's mean over seeds and its interval, for each method and its settings."""
    with style.sheet():
        methods = _methods(frame, metric)
        figure, _, _ = draw_metrics(methods, [metric], _WIDTH)
        layout.legend(figure, style.lines_of(methods).items(), BAND)

    def png() -> bytes:
        figure.savefig(data := io.BytesIO(), format="png")
        return data.getvalue()

    figure._repr_png_ = png  # type: ignore[attr-defined] # notebooks show it
    return figure


def _methods(frame: pd.DataFrame, metric: str) -> Methods:
    """A frame's runs by their labels; BcrlError for what can't be drawn together."""
    counters = [c for _, _, c in INDEX.values() if c in frame]
    if len(counters) != 1 or not {"seed", "stage", "task"} <= {*frame}:
        why = "must have the columns seed, stage, task and either iteration or step"
        raise BcrlError(f"frame: {why}, as a frame of bcrl.api.run or read")
    family = next(name for name, index in INDEX.items() if index[2] == counters[0])
    settings = [str(column) for column in frame if str(column).startswith(SETTING)]
    known = {*map(str, frame)} - {"method", "seed", *INDEX[family], *settings}
    if metric not in known:
        raise BcrlError(f"metric={metric}: {did_you_mean(metric, known)}")
    if not len(frame):
        raise BcrlError("frame: has no rows")
    named = frame if "method" in frame else frame.assign(method="run")
    found: dict[str, Variant] = {}
    for method, own in named.groupby("method", sort=False):
        try:
            varied = [x for x in settings if own[x].nunique(dropna=False) > 1]
        except TypeError as error:
            why = f"must have one number or text per cell in {', '.join(settings)}"
            raise BcrlError(f"frame: {why}") from error
        groups = own.groupby(varied, sort=False, dropna=False) if varied else ()
        for values, rows in groups or [((), own)]:
            given = ((k, v) for k, v in zip(varied, values, strict=True) if v == v)
            told = (f"{k.removeprefix(SETTING)}={_text(v)}" for k, v in given)
            label = f"{method} {', '.join(told)}".strip()
            found[label] = _variant_of(rows, metric, family, label)
    return found


def _text(value: object) -> str:
    """A setting's value; in a column with defaults, whole numbers are floats."""
    return str(value).removesuffix(".0" if isinstance(value, float) else "")


def _variant_of(rows: pd.DataFrame, metric: str, family: str, label: str) -> Variant:
    """The rows of one run as the report has them."""
    index = list(INDEX[family])
    if rows.duplicated([*index, "seed"]).any():
        why = "has two rows per seed and evaluation; name two runs apart in `method`"
        raise BcrlError(f"frame: {label} {why}")
    table = rows.pivot(index=index, columns="seed", values=metric)
    try:
        values = table.to_numpy(float, copy=True).T
    except (TypeError, ValueError) as error:
        raise BcrlError(f"metric={metric}: must be a column of numbers") from error
    values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    stage, task, count = (table.index.get_level_values(x).to_numpy() for x in index)
    about = {"stage": stage, "task": task, "index": count, "metrics": {metric: values}}
    seeds, sidecar = tuple(table.columns), {"config": {}}
    return Variant(Path("frame/run"), family, seeds, **about, sidecars=(sidecar,))
