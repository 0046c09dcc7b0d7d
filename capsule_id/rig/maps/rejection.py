"""Drops outliers of a record by the rule that ``rig.toml`` states: ``reject = { rule = "hampel", ... }``."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from capsule_id.rig.filters import hampel_outliers, median_step
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import read_choice, read_string, read_table, refuse_unknown_keys, shown
from capsule_id.rig.units import UnitError, factor_to_si, scale
from capsule_id.views import counted

_EXAMPLE = '{ rule = "hampel", window = "50 ms", n_sd = 5 }'
_DURATION = re.compile(r"\s*([+-]?[0-9]+\.?[0-9]*(?:[eE][+-]?[0-9]+)?)\s*([^\s0-9]+)\s*")


@dataclass(frozen=True)
class Rejection:
    """Hampel's rule: a sample further than ``n_sd`` robust sds from the median of ``window``, s, around it is dropped."""

    window: float
    n_sd: float


def read_duration(document: TomlDocument, path: KeyPath, value: object) -> float:
    """A duration such as "50 ms", s.

    Raises
    ------
    InputError
        If it is no number with a unit of time, or not positive.
    """
    text = read_string(document, path, value)
    found = _DURATION.fullmatch(text)
    remedy = f'write {path[-1]} = "50 ms"'
    if found is None:
        raise document.error(path, f"{path[-1]} must be a number with a unit of time", shown(text), remedy)
    try:
        duration = scale(float(found[1]), factor_to_si(found[2], "s"))
    except UnitError as error:
        raise document.error(path, error.rule, shown(text), remedy) from None
    if not 0.0 < duration < np.inf:
        raise document.error(path, f"{path[-1]} must be greater than 0", shown(text), remedy)
    return duration


def read_rejection(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> Rejection | None:
    """The rule of the experiment at ``path``, None where it states none.

    Raises
    ------
    InputError
        At the key or value that is wrong.
    """
    if "reject" not in entry:
        return None
    place = (*path, "reject")
    stated = read_table(document, place, entry["reject"], _EXAMPLE)
    refuse_unknown_keys(document, place, stated, ("rule", "window", "n_sd"))
    for key in ("rule", "window", "n_sd"):
        if key not in stated:
            raise document.error(place, f"reject must have a {key}", shown(stated), f"write {_EXAMPLE}")
    read_choice(document, (*place, "rule"), stated["rule"], ("hampel",))
    number = stated["n_sd"]
    if isinstance(number, bool) or not isinstance(number, int | float) or not 1.0 <= number < np.inf:
        raise document.error((*place, "n_sd"), "n_sd must be a number, 1 or more", shown(number), "write n_sd = 5")
    return Rejection(read_duration(document, (*place, "window"), stated["window"]), float(number))


def outlying_rows(
    document: TomlDocument, path: KeyPath, raw: RawTable, time: np.ndarray, rejection: Rejection
) -> np.ndarray:
    """Whether a reading of each row is an outlier, (n,) bool.

    Parameters
    ----------
    path : of the experiment, for the error line
    raw : the table; its column ``time`` is not judged
    time : (n,) s, increasing

    Raises
    ------
    InputError
        If the window holds less than two sampling steps, or does not fit into the record.
    """
    step = median_step(time) if len(time) > 1 else np.inf
    half = rejection.window / step / 2.0
    if not 1.0 - 1e-9 <= half <= len(time) / 2.0:
        rule = "the window must hold two sampling steps or more, and fit into the record"
        value = f"{rejection.window:g} s; the record has {counted(len(time), 'sample')}, a step is {step:.4g} s"
        remedy = "write a window of about 10 steps"
        raise document.error((*path, "reject", "window"), rule, value, remedy)
    samples = 2 * round(half) + 1
    found = np.zeros(len(time), bool)
    for name, values in zip(raw.names, raw.columns, strict=True):
        if name != "time":
            found |= hampel_outliers(values, samples, rejection.n_sd)
    return found
