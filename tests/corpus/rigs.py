"""The rigs of the corpus: folders made from a seed, and real or foreign ones where they lie beside the checkout.

A generated rig needs nothing but this checkout. The others lie in ``../shared/corpus``; a rig that is not at hand is
left out of a run, and ``compare`` says so. QUICK is the part that every step of a change runs.
"""

import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from capsule_id.synthetic import synthesize
from tests.cli_tools import ROOT
from tests.remedies_list import CLEAN, FAULTS, folder_of

SHARED = ROOT.parent / "shared" / "corpus"
#: Planted faults that can be fitted as they are, by seed.
FITTED = (8, 9, 26, 42, 44, 45, 47, 49, 52, 54, 56, 57, 60)
#: Foreign rigs: benches with faulty instruments, inputs of laboratories, questions asked in public.
FOREIGN = (
    "bench_acc_gain__push_held__motor_sat__spring_nl_0",
    "bench_clean_0",
    "bench_clean__ageing__clean__spring_nl_0",
    "bench_clock_one_0",
    "bench_cross_axis__push_held__motor_offset__spring_compliance_0",
    "bench_hum__push_speed_gain__motor_hyst__spring_hyst_0",
    "bench_k_across__fric_pos__clean__spring_compliance_0",
    "bench_lvdt_cubic__slope_hidden__clean__spring_hyst_0",
    "bench_m1_5pct__clean__motor_sat__spring_hyst_0",
    "bench_noise_mult__push_stick__clean__spring_preload_0",
    "bench_quant8__clean__motor_offset__spring_nl_0",
    "bench_relax__tilt_late__motor_sat__spring_preload_0",
    "lab_abs_peaks",
    "lab_critical",
    "lab_long_light",
    "lab_one_pull_per_load_4",
    "lab_phantom_dry",
    "lab_short_hold_z030_stated",
    "lab_short_hold_zeta061",
    "lab_signed_friction",
    "newuser_decay_table",
    "newuser_kgwrong",
    "release_s2_fast_wob0.2",
    "reported_02_undamped",
    "reported_06_coulomb_viscous_stick",
    "reported_08_stribeck_unidentifiable",
    "reported_08b_stribeck_viscous",
    "reported_12_units",
    "reported_13_motor_deadband",
    "reported_21_phyphox",
    "reported_24_freq_drift",
    "reported_strong_damping_060",
    "single_ageing_1",
    "single_clean_1",
    "single_clean_3",
    "single_lvdt_cubic_1",
    "single_slope_hidden_1",
    "single_spring_compliance_1",
)


def _clean(kind: int, place: Path) -> None:
    make, seed = CLEAN[kind]
    make(np.random.default_rng(seed)).write(place)


def _fault(seed: int, place: Path) -> None:
    folder_of(next(fault for fault in FAULTS if fault.seed == seed)).write(place)


def _bench(seed: int, place: Path) -> None:
    synthesize(place, seed=seed)


def _run(number: int, place: Path) -> None:
    """The shipped bench with one of its runs."""
    shipped(place)
    text = (place / "rig.toml").read_text(encoding="utf-8")
    head, *entries = text.split("[[experiment]]")
    runs = [entry for entry in entries if 'kind = "forced_run"' in entry]
    kept = [entry for entry in entries if entry not in runs or entry == runs[number]]
    springs = re.findall(r'spring = "(\w+)"', "".join(kept))
    lines = head.split("\n")
    head = "\n".join(line for line in lines if not line.startswith('"k2[') or line[4 : line.index("]")] in springs)
    (place / "rig.toml").write_text("[[experiment]]".join([head, *kept]), encoding="utf-8")


def shipped(place: Path) -> None:
    """The shipped rig, bench and runs."""
    shutil.copytree(ROOT / "data", place)


def _foreign(name: str, place: Path) -> None:
    shutil.copytree(SHARED / name, place)


#: Name -> what writes its folder.
GENERATED: dict[str, Callable[[Path], None]] = {
    **{f"clean_{kind}": partial(_clean, kind) for kind in range(0, len(CLEAN), 2)},
    **{f"fault_{seed}": partial(_fault, seed) for seed in FITTED},
    **{f"twin_{seed}": partial(_bench, seed) for seed in (1, 2, 3)},
    "shipped": shipped,
    "one_run": partial(_run, 0),
}
RIGS = {**GENERATED, **{name: partial(_foreign, name) for name in FOREIGN}}
#: Twenty rigs of all kinds of folders, for the steps of a change.
QUICK = (
    *("clean_0", "clean_6", "clean_12", "clean_18", "fault_8", "fault_42", "fault_47", "fault_54", "twin_1", "shipped"),
    *("bench_clean_0", "bench_lvdt_cubic__slope_hidden__clean__spring_hyst_0", "lab_critical", "lab_phantom_dry"),
    *("reported_06_coulomb_viscous_stick", "reported_08b_stribeck_viscous", "reported_13_motor_deadband"),
    *("reported_strong_damping_060", "single_clean_1", "single_slope_hidden_1"),
)
