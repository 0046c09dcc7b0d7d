"""Texts of findings on the readings of a rig, by code."""

from collections.abc import Mapping

from capsule_id.views import Message

DATA_MESSAGES: Mapping[str, Message] = {
    "masses.exact": Message(
        "masses", warn="{name}: no sd stated, so its value counts as exact. State the weighing error."
    ),
    "readings.few": Message(
        "number of readings",
        warn="{rows} rows are too few to estimate the scatter; {wanted} are wanted. Measure more rows.",
    ),
    "readings.errors": Message(
        "reading errors", warn="no reading error is stated for {names}. Add {first}_sd to the experiment."
    ),
    "readings.repeated": Message(
        "repeated readings",
        fail="its file has the same content as that of {first}, so each reading counts twice. Remove one of the two.",
    ),
}
