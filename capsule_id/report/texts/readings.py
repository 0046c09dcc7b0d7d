"""Texts of findings on the readings of a rig, by code."""

from collections.abc import Mapping

from capsule_id.views import Facts, Message, counted


def _unusual(facts: Facts) -> str:
    """The number, the usual interval, the unit that was probably meant, and the line that confirms the number."""
    of, unit = "times are" if "period" in facts["name"] else "number is", "" if facts["unit"] == "1" else facts["unit"]
    meant = f" If the {of} in {facts['meant']}, write that unit." if facts["meant"] else ""
    scales = " and ".join(facts.get("scales", [facts["name"]]))
    line = f" If it is right, write this line in [rig] of rig.toml: {facts['line']}" if "line" in facts else ""
    return (
        f"{facts['name']} is {facts['value']:.4g} {unit}; {facts['low']:.3g} to {facts['high']:.3g} {unit} is usual. Check "
        f"the unit of {scales}.{meant} What it scales is not judged.{line}"
    )


def _repeated(facts: Facts) -> str:
    """The rows that stand twice."""
    line, last, first, end = (facts[key] for key in ("line", "last", "first_line", "first_last"))
    later, earlier = f"lines {line} to {last} repeat lines", f"{first} to {end}"
    if line == last:
        later, earlier = f"line {line} repeats line", f"{first}"
    if (facts["file"], line, last) == (facts["first"], first, end):
        return (
            f"{facts['file']}:{line}: each reading must stand once; two experiments use {later.partition(' repeat')[0]}. Let "
            "their where select different rows (both ends of a range count), or remove one experiment."
        )
    return (
        f"{facts['file']}:{line}: each reading must stand once; {later} {earlier} of {facts['first']}. "
        f"Delete the repeated {'row' if line == last else 'rows'}."
    )


def _spikes(facts: Facts) -> str:
    """The samples that stand off, and what drops them."""
    number, place = len(facts["rows"]), f"{facts['file']}:{facts['line']}: {facts['column']} must be smooth;"
    if number == 1:
        size = f"at {facts['time']:.5g} s stands off by {facts['size']:.2g} of the amplitude"
        return f"{place} one sample {size}. Delete its row."
    return (
        f"{place} {counted(number, 'single sample')} stand off (lines {facts['lines']}). Add this line to the experiment in "
        f"rig.toml, which drops them: reject = {facts['rule']}"
    )


DATA_MESSAGES: Mapping[str, Message] = {
    "masses.exact": Message(
        "masses", warn="{name}: no sd stated, so its value counts as exact. State the weighing error."
    ),
    "readings.few": Message(
        "number of readings",
        warn="too few rows to estimate the scatter: {rows} instead of {wanted}. Measure more rows.",
    ),
    "readings.encoding": Message(
        "encoding", ok="{file} is read as {encoding}, because it is no UTF-8. Check letters such as µ in its headers."
    ),
    "readings.missing": Message(
        "missing readings",
        warn=(
            "{file}: the fit drops {rows:# row} with a missing reading and uses {used}. Check that the losses do not depend on "
            "the reading."
        ),
    ),
    "readings.rejected": Message(
        "outliers",
        warn=(
            "{file}: the rule reject drops {rows:# row} as outliers, the fit uses {used}. Check with --figures that no impact "
            "or step is among them."
        ),
    ),
    "readings.errors": Message(
        "reading errors", warn="no reading error is stated for {names}. Add {first}_sd to the experiment."
    ),
    "readings.repeated_file": Message(
        "repeated readings",
        fail=(
            "{file} has the same content as the file of {first}, so each reading counts more than once. Remove one of "
            "the two experiments."
        ),
    ),
    "readings.repeated": Message(
        "repeated readings",
        fail=_repeated,
    ),
    "readings.magnitude": Message("magnitudes", warn=_unusual, on_console=True),
    "decays.magnitude": Message("magnitudes", warn=_unusual, on_console=True),
    "settings.sd": Message(
        "stated sd",
        warn="{name} is {value:.4g} ± {sd:.4g} in SI units: its prior reaches below 0. State the sd of a measurement.",
    ),
    "readings.gaps": Message(
        "gaps in a record",
        warn=(
            "{file}:{line}: the times must be evenly spaced; found {lost:# missing sample} of {step:.4g} s, the first after "
            "{time:.6g} s. The fit uses the times as recorded. Record without gaps."
        ),
    ),
    "readings.rounded_times": Message(
        "rounded times",
        warn="{file}: the times are rounded to {step:g} s, a large part of a sampling step. Export more digits.",
    ),
    "readings.clipped": Message(
        "clipped samples",
        fail=(
            "{file}:{line}: {column} is clipped at its {side} limit {level:.5g} {unit}: {samples:# sample} "
            "({share:.2g} of the record), the last at {time:.5g} s. Use the record after the clipped part only, or "
            "repeat with a wider range of the sensor. {cut}"
        ),
    ),
    "readings.dropouts": Message(
        "drop-outs",
        fail=(
            "{file}:{line}: {column} drops out: {samples:# sample} far from both neighbours, the first "
            "{value:.6g} {unit} at {time:.5g} s. Delete these rows: lines {lines}."
        ),
    ),
    "readings.frozen": Message(
        "frozen channel",
        fail=(
            "{file}:{line}: {column} freezes: {samples:# sample} with the value before, the first {value:.6g} {unit} at "
            "{time:.5g} s. Delete these rows: lines {lines}."
        ),
    ),
    "readings.jump": Message(
        "lost samples",
        fail=(
            "{file}:{line}: {column} must be smooth; it jumps at {time:.5g} s by {size:.2g} of its amplitude, and the times "
            "are even. Samples may be lost, or the rig was struck or moved. Use the record on one side of the jump only, "
            "or repeat it. {cut}"
        ),
    ),
    "readings.burst": Message(
        "bursts of noise",
        fail=(
            "{file}:{line}: {column} must have the same noise throughout; from {begin:.5g} to {end:.5g} s it has more than "
            "three times the usual noise. {cut}"
        ),
    ),
    "readings.spike": Message(
        "spikes",
        fail=_spikes,
    ),
}
