"""Variants of the model of a rig: one choice of ``[model]`` at a time takes each of its alternatives."""

from collections.abc import Sequence
from dataclasses import replace

from capsule_id.errors import InputError
from capsule_id.rig.model import ModelChoices, Rig

#: Words of ``--compare``.
WORDS = ("friction", "reaction", "lag", "cubic")
#: Parameters of the friction law that may be free.
FRICTION = ("mu_back", "ratio", "viscous")


def variants_of(rig: Rig, words: Sequence[str]) -> dict[str, ModelChoices]:
    """The choices to compare by name: those of the rig first ("as stated"), equal ones once.

    friction: constant, eq. (1), free ratio, and the law of the rig with a viscous part and with a direction;
    reaction: on the ground, on the capsule; lag: none, free; cubic: a linear spring, k_cubic free.

    Raises
    ------
    InputError
        If a word is not one of ``WORDS``.
    """
    unknown = [word for word in words if word not in WORDS]
    if unknown or not words:
        rule = f"--compare takes some of {','.join(WORDS)}"
        raise InputError(rule, ",".join(words) or "nothing", f"write --compare {WORDS[0]}")
    model = rig.model
    others = tuple(symbol for symbol in model.free if symbol not in FRICTION)
    found = {"as stated": model}
    if "friction" in words:
        found["constant friction"] = replace(model, friction="constant", free=others)
        found["eq. (1)"] = replace(model, friction="stribeck", free=others)
        found["free ratio"] = replace(model, friction="stribeck", free=("ratio", *others))
        found["viscous part"] = _with(model, "viscous")
        found["direction"] = _with(model, "mu_back")
    if "reaction" in words:
        found["reaction on the capsule"] = replace(model, reaction="capsule")
        found["reaction on the ground"] = replace(model, reaction="ground")
    for word, symbol, absent, present in (
        ("lag", "lag", "no lag", "free lag"),
        ("cubic", "k_cubic", "linear spring", "cubic spring"),
    ):
        if word in words:
            found[absent] = replace(model, free=tuple(s for s in model.free if s != symbol))
            found[present] = _with(model, symbol)
    unique: dict[tuple[object, ...], str] = {}
    for name, choices in found.items():
        unique.setdefault((choices.friction, frozenset(choices.free), choices.reaction), name)
    return {name: found[name] for name in unique.values()}


def _with(model: ModelChoices, symbol: str) -> ModelChoices:
    return model if symbol in model.free else replace(model, free=(*model.free, symbol))
