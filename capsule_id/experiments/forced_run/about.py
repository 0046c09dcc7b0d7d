"""What a forced run was made of, beside the numbers that its likelihood reads."""

from dataclasses import dataclass, field

from capsule_id.experiments.base import About
from capsule_id.experiments.forced_run.start import RunStart


@dataclass(frozen=True)
class AboutRun(About):
    """What a run was made of.

    Attributes
    ----------
    record : label of the record that the run is, or is a part of
    leads : the run is a whole record, or the first part of one
    start : the kind of initial state
    start_is_open : no kind of initial state was stated
    rough : state and drive at the first sample, read off the record (the speed by the model, where that found one)
    """

    record: str = field(compare=False)
    leads: bool = field(compare=False)
    start: str = field(compare=False)
    start_is_open: bool = field(compare=False)
    rough: RunStart = field(compare=False)
