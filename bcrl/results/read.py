"""One seed's three files, each read only if it is what the run recorded."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import is_intact, sha256
from bcrl.errors import BcrlError
from bcrl.results import layout

BROKEN, INCOMPLETE = "broken", "incomplete"  # kinds of findings
AGAIN = "run the same command again"

Document = dict[str, Any]  # a seed's JSON


@dataclass(eq=False)
class Finding(BcrlError):
    """A file or folder that is not as a finished run leaves it, and what to do; by
    default that is to make the seed anew. Raised where such a file is read."""

    path: Path
    what: str
    remedy: str = ""
    kind: str = BROKEN

    def __str__(self) -> str:
        name, seed = str(self.path), self.path.with_suffix("")
        shown = name if name.isprintable() else ascii(name)
        anew = f"delete {seed}.* and {AGAIN} (it makes missing seeds only)"
        return f"{shown} {self.what}: {self.remedy or anew}"


def read_document(folder: Path, seed: int) -> Document:
    """A seed's JSON; Finding unless it is whole, unchanged and in its place."""
    path = layout.seed_path(folder, seed, "json")
    try:
        intact = is_intact(document := json.loads(_bytes(path)))
    except (ValueError, RecursionError, AttributeError) as error:
        raise Finding(path, "is not a readable JSON object") from error
    if (schema := document.get("schema")) != layout.SCHEMA:
        raise Finding(path, f"has schema {schema!r}, not {layout.SCHEMA}")
    if not intact:
        raise Finding(path, "was changed after it was written (see its digest)")
    if not {"status", "asked", "config"} <= document.keys():
        raise Finding(path, f"lacks entries of schema {layout.SCHEMA}")
    for key, value in layout.belongs_to(folder, seed).items():
        if document.get(key) != value:
            what = f"belongs to {key} {document.get(key)!r}, not {value!r}"
            back = f"move it back, or delete {path.with_suffix('')}.* and {AGAIN}"
            raise Finding(path, what, back)
    return document


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise Finding(path, "is missing") from error
    except OSError as error:
        what = f"can't be read ({error.strerror})"
        raise Finding(path, what, "make it a readable file") from error


def read_recorded(path: Path, document: Document) -> bytes:
    """A CSV's or NPZ's bytes; Finding unless the seed's JSON has their hash."""
    data = _bytes(path)
    if sha256(data) != document.get("sha256", {}).get(path.suffix[1:]):
        raise Finding(path, f"is not what {path.stem}.json has the SHA-256 of")
    return data


def read_arrays(path: Path, *names: str) -> list[NDArray[Any]]:
    """The named arrays of an NPZ, of numbers; Finding if it does not hold them."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            # Runs do not compress: the arrays take no more memory than the file.
            if any(member.compress_type for member in stored.zip.infolist()):
                raise ValueError("it is compressed")
            arrays = [stored[name] for name in names]
        if any(array.dtype.kind not in "biuf" for array in arrays):
            raise ValueError("it has texts")
        return arrays
    except KeyError as error:
        raise Finding(path, f"lacks what is needed ({error.args[0]})") from error
    except Exception as error:  # whatever NumPy's readers raise
        raise Finding(path, "is not a readable NPZ") from error
