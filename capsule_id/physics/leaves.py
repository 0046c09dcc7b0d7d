"""The quantities of the capsule and its drive by name: unit and meaning. Free of JAX, for the commands' options."""

from typing import NamedTuple


class Leaf(NamedTuple):
    """unit : SI; meaning : a phrase; drive : a leaf of ``Excitation`` instead of ``CapsuleParameters``."""

    unit: str
    meaning: str
    drive: bool = False


LEAVES: dict[str, Leaf] = {
    "m1": Leaf("kg", "mass of the rod"),
    "m2": Leaf("kg", "mass of the capsule"),
    "k1": Leaf("N/m", "stiffness of the rod's spring"),
    "k2": Leaf("N/m", "stiffness of the support spring"),
    "c": Leaf("N s/m", "damping of the rod"),
    "mu": Leaf("1", "static friction coefficient"),
    "v_s": Leaf("m/s", "Stribeck velocity"),
    "G": Leaf("m", "gap to the support spring"),
    "g": Leaf("m/s^2", "gravity"),
    "P_d": Leaf("N", "amplitude of the drive", drive=True),
    "Omega": Leaf("rad/s", "angular frequency of the drive", drive=True),
    "phase": Leaf("rad", "phase of the drive", drive=True),
}
# What may be swept: every leaf, and the drive's frequency in Hz.
SWEPT: dict[str, Leaf] = LEAVES | {"f": Leaf("Hz", "frequency of the drive", drive=True)}
