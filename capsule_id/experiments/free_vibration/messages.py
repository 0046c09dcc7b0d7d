"""What the checks of free decays say, and captions of their tables."""

from capsule_id.experiments.free_vibration.kinematics import MESSAGES as KINEMATICS_MESSAGES
from capsule_id.experiments.free_vibration.lint import MESSAGES as LINT_MESSAGES
from capsule_id.experiments.free_vibration.lint import line_of
from capsule_id.experiments.free_vibration.settings import DAMPING, EFFECTS
from capsule_id.parameters import parameter
from capsule_id.views import Facts, Message, filled_in


def _second_fit(facts: Facts) -> str:
    """The records that contradict the stated model, the quoted model and the lines that state it."""
    return (
        f"{', '.join(facts['labels'])}: the record contradicts the first model ({facts['first']}). The quoted values are those "
        f"of a second fit: {facts['second']}.{facts['drift']} To state it, add these lines to its entry: "
        f"{facts['lines']}. To keep the first model, state its words."
    )


def _halves(facts: Facts) -> str:
    """The parameter whose halves disagree most, the effect that this indicates, and remedies."""
    damping = facts["name"] in ("c", *DAMPING.values())
    key = "damping" if damping else "stiffness"
    leave = f"Remove {key} from its entry, or state" if key in facts["stated"] else "State"
    values = f"the first half gives {facts['first']:.4g}, the second {facts['second']:.4g} {facts['unit']}"
    cause = (
        f"The {key} depends on the amplitude or on the time in a way that the fitted model lacks ({facts['model']}). {leave} "
        "start and stop for the amplitudes of interest."
    )
    if facts["name"] == "k1" and "cubic" in facts["model"]:
        cause = (
            f"The stiffness changes with the time: the fitted model ({facts['model']}) holds a dependence on the amplitude "
            "already. Find what warms up, works loose or moves during the record, and record again."
        )
    return (
        f"{facts['label']}: expected the same {facts['name']} in both halves of the record; {values} ({facts['z']:.1f} joint "
        f"sd apart). {cause}"
    )


def _forces(facts: Facts) -> str:
    """The force that explains the turning points better, and the line that states it."""
    unit = "" if facts["unit"] == "1" else f" {facts['unit']}"
    side = (
        " Amplitudes must be counted from the rest position: subtract it, or give both sides."
        if facts["one_side"]
        else ""
    )
    return (
        f"{facts['label']}: expected turning points that the fitted model explains ({facts['model']}); {facts['name']} = "
        f"{facts['value']:.3g}{unit} explains them better ({facts['z']:.1f} sd from 0). Write {facts['line']} in its entry."
        f"{side}"
    )


def _smaller(facts: Facts) -> str:
    """How to leave out the large amplitudes of a record."""
    if facts["start"] is None:
        return "record again from smaller deflections"
    line = filled_in(line_of("start"), facts)
    return f"leave out the larger half of the amplitudes: add {line} to the experiment in rig.toml"


def _position(facts: Facts) -> str:
    seen = (
        "{label}: the residuals must not depend on the position of the rod, but they do ({p:p}), most from {low:.4g} to "
        "{high:.4g} {unit}. The sensor has an error there, or the model lacks a force. Calibrate the sensor, or "
    )
    return filled_in(seen, facts) + f"{_smaller(facts)}."


def _residuals(facts: Facts) -> str:
    seen = (
        "{label}: the residuals must not be larger where the motion is larger, but they are, {ratio:.1f} times ({p:p}). "
        "What was fitted as noise is an error of the model there, such as a stiffness or a damping that depends on the "
        "amplitude, or an error of the sensor in proportion to the motion. To find the cause, "
    )
    return filled_in(seen, facts) + f"{_smaller(facts)}, and compare the results."


def _drift(facts: Facts) -> str:
    if facts["larger"]:
        seen = "{label}: the fitted drift of the zero is larger than the motion, so the motion may be part of it. "
        return filled_in(seen, facts) + "State the start and stop of the free decay."
    seen = (
        "{label}: a drift of the zero must be slower than the motion, but the fitted one has {share:.1%} of the motion at its "
        "frequency. It hides an error of the model. Where dry friction ends the motion, state an earlier stop; else "
    )
    return filled_in(seen, facts) + f"{_smaller(facts)}."


def _hidden(facts: Facts) -> str:
    """The forces that the records allow, the limits of the parameter beside them, and remedies."""
    name, unit, words = facts["name"], facts["unit"], [word for word, own in DAMPING.items() if own in facts["symbols"]]
    effects = " or ".join(EFFECTS[symbol] for symbol in facts["symbols"])
    allowed = ", ".join(
        f"{symbol} up to {size:.2g} {parameter(symbol).unit}"
        for symbol, size in zip(facts["symbols"], facts["largest"], strict=True)
    )
    found = (
        f"With {allowed} they fit as well, and {name} lies between {facts['low']:.3g} and {facts['high']:.3g} {unit}"
    )
    all_words = ", ".join(f'"{word}"' for word in ("viscous", *words))
    lines = [(f"damping = [{all_words}]", 'damping = ["viscous"]')] if words else []
    lines += [('stiffness = "cubic"', 'stiffness = "linear"')] if "k_cubic" in facts["symbols"] else []
    free, known = ([line[i] for line in lines] for i in (0, 1))
    remedies = ["Record more periods with less noise"] if facts["swings"] else ["Release from smaller deflections"]
    if "k_cubic" in facts["symbols"] and not facts["offers_cubic"]:
        free.remove('stiffness = "cubic"')
        remedies.append("release from smaller deflections")
    if free:
        remedies.append(f"write {' and '.join(free)} in the experiment for an interval that includes this")
    return (
        f"{', '.join(facts['labels'])}: expected records that exclude {effects}; they do not. {found} (the fit without: "
        f"{facts['value']:.3g}). {', or '.join(remedies)}. If another measurement excludes {effects}, write "
        f"{' and '.join(known)}."
    )


MESSAGES = {
    **LINT_MESSAGES,
    **KINEMATICS_MESSAGES,
    "decays.hidden": Message(
        "further forces of a decay",
        ok="{labels}: no further force that the records allow changes c or k1 by much",
        warn=_hidden,
        fail=_hidden,
    ),
    "decays.stiffness": Message(
        "stiffness against amplitude",
        ok="k1 is the same in all {records} records ({p:p})",
        fail=(
            "expected one k1 for all releases (linear near the working point); the {records} records give {low:.5g} to "
            "{high:.5g} N/m (chi-square {chi_square:.1f}, {p:p}). Release from smaller deflections, or use k1 at this "
            "amplitude only."
        ),
    ),
    "decays.slip": Message(
        "free decay",
        fail=(
            "expected a free capsule at rest, |f| <= F_b = {F_b:.3g} N; the record reaches {force:.3g} N, so the capsule "
            "slips and this is no free decay. Hold the capsule, or release from a smaller deflection."
        ),
    ),
    "decays.contact": Message(
        "free decay",
        fail=(
            "x_rel reaches {reach:.3g} m and the support spring stands at {gap:.3g} m, so the rod hits it and this is no "
            "free decay. Move the spring away, or start the window later."
        ),
    ),
    "decays.records": Message(
        "Free vibration, record by record",
        caption=(
            "Each record alone, by least squares on the whole raw record, beside the paper's protocol. The paper's k1 is low "
            "by ζ², because it takes the damped frequency for the natural one. Its c depends on how peaks are read out of "
            "noise."
        ),
    ),
    "decays.forces": Message(
        "forces of a decay",
        ok="{labels}: no further force explains the turning points better",
        warn=_forces,
        fail=_forces,
    ),
    "decays.step": Message(
        "noise of turning points",
        warn=(
            "{label}: the noise of {column} is below the rounding error of its digits (step {step:g} {unit}), so the sd of "
            "{name} follows from that step. State {column}_resolution or {column}_sd."
        ),
    ),
    "decays.position": Message(
        "position of a decay",
        ok="{labels}: the residuals do not depend on position and direction ({p:p})",
        fail=_position,
    ),
    "decays.residuals": Message(
        "residuals and amplitude of a decay",
        ok="{labels}: the residuals do not grow with the amplitude ({p:p})",
        fail=_residuals,
    ),
    "decays.drift": Message(
        "drift of a decay",
        ok="{label}: the fitted drift of the zero is slower than the motion ({share:.1%} of it at its frequency)",
        fail=_drift,
    ),
    "decays.found": Message(
        "further forces of a decay",
        warn=(
            "{label}: the second fit contains {effect}, but {name} is only {z:.1f} sd from 0, so this number is not judged. "
            "Record more periods with less noise, or state the damping and the stiffness in its entry."
        ),
    ),
    "decays.zero": Message(
        "zero of a decay",
        ok="{labels}: no jump of the sensor's zero stands out where the rod turns",
        fail=(
            "{label}: the zero of the sensor must stay the same, but it jumps where the rod turns; the rms change from a half "
            "swing to the next is {jump:.2g} {unit}. With one zero per half swing ({half_swings}), the squared residuals are "
            "{ratio:.0%} of those with a zero that changes slowly. A loose sensor can cause this, or an encoder that loses "
            "counts. No fit corrects it. Fasten the sensor or replace it, and record again."
        ),
    ),
    "decays.halves": Message(
        "halves of a decay",
        ok="{labels}: the estimates of both halves of each record agree within 3 joint sd",
        warn=_halves,
        fail=_halves,
    ),
    "decays.damping": Message(
        "Damping parameters",
        caption=(
            "Correlations of the damping parameters. Near -1 or 1 the record determines a combination of two parameters better "
            "than each of them. A record over a wider range of amplitudes separates them."
        ),
    ),
    "decays.first_fit": Message(
        "second fit of free decays",
        warn=(
            "{record}: no second fit, because the record is not one free decay. The fit uses means of {thin} samples. "
            "Add the line that the finding on the readings states."
        ),
    ),
    "decays.second_fit": Message(
        "second fit of free decays",
        on_console=True,
        warn=_second_fit,
        caption=(
            "Free decays alone, under the stated model and under the model of the quoted values, both by maximum likelihood on "
            "the readings of the latter; records weighted by their errors. BIC is relative to the lower one. Lines of rig.toml "
            "that state the quoted model: {lines}."
        ),
    ),
}
