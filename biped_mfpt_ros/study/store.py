"""Results on disk: each in a file of its own, named after all that decides it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from biped_mfpt_ros.files import whole_file
from biped_mfpt_ros.study.plan import Job


class Store:
    """Results of jobs in a directory, so that a study that was stopped goes on where it was.

    A result is written beside its place and then moved there: whatever ends the process, a file
    is there as a whole or not at all. A result belongs to all inputs of its job, the step map's
    identity included; one of other inputs is another file.

    Parameters
    ----------
    directory : pathlib.Path
        Made if missing.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        directory.mkdir(parents=True, exist_ok=True)

    def path(self, job: Job) -> Path:
        """Where the result of a job is kept."""
        return self._directory / f"{job.name}.json"

    def get(self, job: Job) -> dict[str, Any] | None:
        """The result of a job, or None if there is none that can be read."""
        try:
            kept = json.loads(self.path(job).read_text())
        except (FileNotFoundError, ValueError, RecursionError):
            return None
        if not isinstance(kept, dict) or kept.get("inputs") != job.inputs:
            return None
        result = kept.get("result")
        return result if isinstance(result, dict) else None

    def put(self, job: Job, result: dict[str, Any]) -> None:
        """Keep the result of a job, of JSON's types (infinities as the strings of `plain`)."""
        path = self.path(job)
        text = json.dumps({"inputs": job.inputs, "result": result}, indent=1, allow_nan=False)
        with whole_file(path) as file:
            file.write(f"{text}\n".encode())
