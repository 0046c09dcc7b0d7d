"""Base of experiments whose rows are trials at settings of the drive: a setting can be left out, and new ones predicted."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
from jaxtyping import Float

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.families.capsule_experiment import CapsuleForward
from capsule_id.rig.model import Column
from capsule_id.views import Comparison


class TrialsExperiment(CapsuleForward):
    """Trials of one table.

    Attributes
    ----------
    distance : (n,) displacement of the capsule, m
    settings : (settings, p) numbers of the drive, in an order of the kind's own
    setting : (n, settings) 1 where a row belongs to a setting
    time : (settings,) duration of a trial, s
    """

    distance: np.ndarray
    settings: np.ndarray
    setting: np.ndarray
    time: np.ndarray

    @abstractmethod
    def settings_of(
        self, columns: Mapping[str, Column]
    ) -> tuple[Float[np.ndarray, "rows p"], Float[np.ndarray, " rows"]]:
        """Settings in the rows of a table, and the durations of their trials, s."""

    @abstractmethod
    def setting_names(self) -> list[str]:
        """A short name for every setting, with units."""

    @abstractmethod
    def new_trials(
        self, draws: Sequence[ValuesBySymbol], settings: Float[np.ndarray, "rows p"], rng: np.random.Generator
    ) -> Float[np.ndarray, "draws rows"]:
        """Displacement, m, of a new trial in a new session at each draw of the parameters and each of ``settings``."""

    @abstractmethod
    def speed_panels(
        self,
        settings: Float[np.ndarray, "rows p"],
        centre: Float[np.ndarray, " rows"],
        limits: tuple[Float[np.ndarray, " rows"] | None, Float[np.ndarray, " rows"] | None],
        label: str,
    ) -> tuple[Comparison, ...]:
        """Panels of mean velocities: ``centre`` and ``limits`` of its band, mm/s, at ``settings``, and the trials."""

    @abstractmethod
    def densities_of_settings(self, draws: Sequence[ValuesBySymbol]) -> Float[np.ndarray, "draws settings"]:
        """Log-density of the readings of each setting given the parameters and all others; not finite where none."""

    @abstractmethod
    def motions_of_draws(self, draws: Sequence[ValuesBySymbol]) -> Float[np.ndarray, "draws k"]:
        """The numbers of every draw for which the likelihood runs the capsule; not finite where a run fails."""

    @abstractmethod
    def with_emulator(self, draws: Sequence[ValuesBySymbol], motions: Float[np.ndarray, "draws k"]) -> Self:
        """Return the same trials with an emulator of the motions, fitted to ``motions_of_draws`` of ``draws``."""

    @abstractmethod
    def without(self, setting: int) -> Self:
        """Return the experiment without the trials of one setting."""

    @abstractmethod
    def motions_without(self, motions: Float[np.ndarray, "draws k"], setting: int) -> Float[np.ndarray, "draws m"]:
        """Those of ``motions_of_draws`` that the experiment without one setting has."""
