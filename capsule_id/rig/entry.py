"""One ``[[experiment]]`` during its check: its table, and the places for error lines."""

from dataclasses import dataclass
from typing import Generic

from capsule_id.errors import InputError
from capsule_id.rig.model import S, Table
from capsule_id.rig.schema import SHORTEST_RECORD
from capsule_id.rig.tables import TableFile
from capsule_id.rig.toml_document import KeyPath, TomlDocument


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
            raise self.file.error(samples - 1, "time", rule, f"{samples} samples", remedy)
