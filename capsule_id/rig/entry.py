"""One ``[[experiment]]`` during its check: its table, and the places for error lines."""

from dataclasses import dataclass
from typing import Any, Generic

from capsule_id.errors import InputError
from capsule_id.rig.choices import place_of
from capsule_id.rig.model import S, Table
from capsule_id.rig.schema import SHORTEST_RECORD
from capsule_id.rig.tables import TableFile
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.views import counted


@dataclass(frozen=True)
class Entry(Generic[S]):
    """The argument of a kind's rules.

    Attributes
    ----------
    table : columns and settings, SI
    document, path : ``rig.toml``, and the key path of the entry
    file : the table as written
    """

    table: Table[S]
    document: TomlDocument
    path: KeyPath
    file: TableFile

    def error(self, key: str, rule: str, value: str, remedy: str, of_key: bool = False) -> InputError:
        """The error about a setting, at its value or key; ``key`` "" means the whole entry."""
        path = (*self.path, key) if key else self.path
        return self.document.error(path, rule, value, remedy, of_key)

    def refuse_ground(self, key: str, rule: str) -> None:
        """Refuse a slope or N0 that this experiment cannot have, its own or that of [rig].

        Raises
        ------
        InputError
            Where ``key``, "slope" or "N0", is stated.
        """
        settings: Any = self.table.settings
        if stated := settings.ground.get(key):
            unit = "deg" if key == "slope" else "N"
            remedy = f'state {key} = {{ value = 0, unit = "{unit}" }} in this experiment, if that is true of it'
            value = f"{stated.value:.3g}{f' ± {stated.sd:.3g}' if stated.sd else ''} in SI units"
            raise self.document.error(place_of(self.document, self.path, key), rule, value, remedy)

    def check_spring_with_gap(self) -> None:
        """Require a gap where a spring is within reach.

        Raises
        ------
        InputError
            At the one of spring and gap that stands alone.
        """
        settings: Any = self.table.settings
        if (settings.spring is None) != (settings.gap is None):
            one, other = ("spring", "gap") if settings.gap is None else ("gap", "spring")
            remedy = f"add {other}, or remove {one} where the support spring is out of reach"
            raise self.error(one, "spring and gap must stand together", f"{one} alone", remedy, of_key=True)

    def check_length(self) -> None:
        """Refuse a record that is too short to fit.

        Raises
        ------
        InputError
            At the last sample.
        """
        samples = len(self.table.rows)
        if samples < SHORTEST_RECORD:
            rule = f"a record must have at least {SHORTEST_RECORD} samples"
            remedy = f"record {self.table.kind} for longer or faster"
            raise self.file.error(samples - 1, "time", rule, counted(samples, "sample"), remedy)
