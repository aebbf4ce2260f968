"""What can be wrong with a bag."""

from __future__ import annotations

from os import PathLike

from biped_mfpt_ros.errors import InputError


class BagError(InputError):
    """A bag cannot be read, or is not what it has to be.

    Parameters
    ----------
    path : path-like
        The bag, or the file in it.
    problem : str
        What is wrong with it.
    allowed : str, optional
        What would have been allowed.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        problem: str,
        allowed: str = "a whole rosbag2 bag in MCAP files",
    ) -> None:
        super().__init__("bag", str(path), allowed)
        self.problem = problem
        self.args = (f"bag {path}: {problem}; allowed: {allowed}",)


class BagWriteError(OSError):
    """The operating system did not take what was to be written: the disk is full, mostly.

    What was flushed before stays readable (see `biped_mfpt_ros.bag.salvage`).
    """

    def __str__(self) -> str:
        return f"bag {self.filename}: {self.strerror}"
