"""How a step can end."""

from __future__ import annotations

import enum


class Outcome(enum.IntEnum):
    """Outcome of one step: success, or the first validity condition that it broke.

    The conditions are those of section 2.1 of the paper. The values are part of the messages and
    of recorded bags, so they never change.
    """

    STEP = 0
    """The step succeeded."""
    STANCE_LIFTS = 1
    """The stance foot left the ground during the swing (F_n <= 0)."""
    STANCE_SLIPS = 2
    """The stance foot slipped during the swing (|F_t| >= mu_s F_n)."""
    SWING_SCUFFS = 3
    """The swing foot touched the ground behind, or passed the stance foot below ground."""
    FOOT_BEHIND = 4
    """The swing foot came down behind the stance foot after it had passed it."""
    IMPACT_PULLS = 5
    """The ground would have to pull at the swing foot at impact."""
    IMPACT_SLIPS = 6
    """The swing foot slips at impact."""
    NO_LIFT_OFF = 7
    """The old stance foot does not lift after the impact."""
    BODY_TOUCHES = 8
    """A knee, the hip or the head touches the ground."""
    TIME_LIMIT = 9
    """No impact within the time limit."""
    NOT_FINITE = 10
    """The state is no longer finite, or was not at the start."""

    @property
    def label(self) -> str:
        """The name as prose, such as ``"stance slips"``."""
        return self.name.lower().replace("_", " ")
