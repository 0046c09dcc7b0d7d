"""Proposes a column map for a file whose headers are not those of the kind."""

import json
import re

from capsule_id.rig.formats.export import Export
from capsule_id.rig.schema import KindRule
from capsule_id.rig.units import UnitError, factor_to_si

_LONGEST_HEADER = 40  # characters; a column with a longer header is proposed by its number
_UNIT = re.compile(r"(.*?)\s*[\[(]([^\])]*)[\])]")


def proposal(kind: KindRule, export: Export | None) -> str:
    """The line ``columns = { ... }`` that reads ``export`` as a table of ``kind``.

    A column of the kind takes the unused header of its name or of its dimension, else the next unused column in SI.

    Parameters
    ----------
    kind : its first set of columns is proposed, with its first channel
    export : the file (None: unknown; columns are proposed by number)
    """
    wanted = [*kind.sets[0], *kind.channels[:1]]
    headers = export.headers[0] if export is not None and export.headers else ()
    width = export.width if export is not None else len(wanted)
    found: dict[str, tuple[int, str]] = {}
    for same in (True, False):
        for name in wanted:
            used = {index for index, _ in found.values()}
            for index, header in enumerate(headers):
                if (
                    name not in found
                    and index not in used
                    and (unit := _unit(header, name, kind.columns[name].si, same))
                ):
                    found[name] = index, unit
    free = [index for index in range(width) if index not in {index for index, _ in found.values()}]
    texts = []
    for name in wanted:
        if name not in found and not free:
            texts.append(f'{name} = {{ rate = {{ value = 1000, unit = "Hz" }} }} (the sampling rate)')
            continue
        index, unit = found[name] if name in found else (free.pop(0), kind.columns[name].si)
        header = headers[index] if headers else ""
        unique = header and headers.count(header) == 1 and len(header) <= _LONGEST_HEADER
        source = json.dumps(header, ensure_ascii=False) if unique else index + 1
        texts.append(f'{name} = {{ from = {source}, unit = "{unit}" }}')
    return f"columns = {{ {', '.join(texts)} }}"


def _unit(header: str, name: str, si: str, same: bool) -> str | None:
    """The unit of a header that fits the column ``name``: by its name if ``same``, else by its dimension."""
    match = _UNIT.fullmatch(header)
    stem, unit = match.groups() if match else (header, None)
    if same and stem.lower() != name:
        return None
    if unit is None:
        return si if same else None
    try:
        factor_to_si(unit, si)
    except UnitError:
        return None
    return unit
