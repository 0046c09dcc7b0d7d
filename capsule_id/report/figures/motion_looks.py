"""How a motion's label looks on areas: blue forward, orange backward, grey standing, black aperiodic."""

from collections.abc import Sequence

import numpy as np

from capsule_id.report.figures.style import BLACK

# Shades of a direction, dark to light; what does not fit goes into "other".
_SHADES = {
    "F": ("#08306B", "#0072B2", "#56B4E9", "#A6D3EE", "#DCEEF9"),
    "B": ("#7F2704", "#D55E00", "#F0944D", "#F8C496", "#FDE6D2"),
    "S": ("#6E6E6E", "#8F8F8F", "#ADADAD", "#C8C8C8"),
}
_OTHER, _APERIODIC, _FAILED = "#E8D9A0", BLACK, "#FFFFFF"


def shown(names: list[str], heights: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Labels that have a look of their own, by direction, and "other"; heights (labels, ...) go with them."""
    kept: dict[str, list[int]] = {}
    rest: list[int] = []
    for i in np.argsort(-heights.reshape(len(names), -1).sum(axis=1), kind="stable"):
        direction = _direction_of(names[i])
        family = kept.setdefault(direction, [])
        (family if len(family) < len(_SHADES.get(direction, " ")) else rest).append(int(i))
    order = [
        i
        for direction in ("F", "S", "B", "aperiodic", "not settled", "failed")
        for i in sorted(kept.get(direction, []), key=lambda i: names[i])
    ]
    own = heights[order]
    if rest:
        return [*(names[i] for i in order), "other"], np.concatenate([own, heights[rest].sum(axis=0)[None]])
    return [names[i] for i in order], own


def _direction_of(name: str) -> str:
    return name.split("-")[2] if name.startswith("P-") else name


def label_looks(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Colour and hatch of each label."""
    used: dict[str, int] = {}
    colours: list[str] = []
    hatches: list[str] = []
    for name in names:
        direction = _direction_of(name)
        if direction in _SHADES:
            shade = used.get(direction, 0)
            used[direction] = shade + 1
            colours.append(_SHADES[direction][shade])
        else:
            colours.append({"other": _OTHER, "aperiodic": _APERIODIC}.get(name, _FAILED))
        hatches.append({"failed": "xx", "not settled": "//"}.get(name, ""))
    return colours, hatches


def label_classes(label: np.ndarray) -> tuple[list[str], list[str], np.ndarray]:
    """(names, colours, classes) of an array of labels: classes has its shape and holds indices into names."""
    found = [str(name) for name in np.unique(label)]
    share = np.stack([label == name for name in found]).astype(float)
    names, _ = shown(found, share)
    index = {name: i for i, name in enumerate(names)}
    classes = np.vectorize(lambda name: index.get(str(name), index.get("other", 0)), otypes=[int])(label)
    return names, label_looks(names)[0], classes
