"""Settings of an experiment by attribute: None where one is not stated. Typed settings of each kind replace this."""

from collections.abc import Mapping
from typing import Any

from capsule_id.rig.schema import KINDS, ChoiceRule


class LooseSettings(dict[str, Any]):
    """A mapping whose keys are attributes too."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self.get(name)


def loose(kind: str, stated: Mapping[str, Any]) -> LooseSettings:
    """``stated``, with the defaults of ``kind``."""
    defaults = {
        key: rule.choices[0]
        for key, rule in KINDS[kind].settings.items()
        if isinstance(rule, ChoiceRule) and rule.has_default
    }
    return LooseSettings({**defaults, **stated})
