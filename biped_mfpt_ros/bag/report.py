"""What a bag says: the same MFPT as was published, from the bag alone."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from biped_mfpt_ros.bag.error import BagError
from biped_mfpt_ros.bag.meshes import RecordedMesh, recorded_meshes
from biped_mfpt_ros.bag.metadata import STARTED_LATE
from biped_mfpt_ros.bag.reader import Bag
from biped_mfpt_ros.bag.sequences import SequenceCheck, leading_sequence
from biped_mfpt_ros.chain.markov import ChainError, metastability
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.models import model_values
from biped_mfpt_ros.walker.outcome import Outcome

_PACKAGE = "biped_mfpt_msgs/msg/"
_ESTIMATE = f"{_PACKAGE}MfptEstimate"
_VOLATILE = f"{_PACKAGE}MeshProgress"


@dataclass(frozen=True)
class TopicReport:
    """A topic of a bag.

    Parameters
    ----------
    name, type_name : str
    messages : int
        Messages in the bag.
    missing, repeated : int
        Messages that were published, going by their sequence numbers, and are not there, or are
        there again. Both 0 where messages have no sequence number.
    """

    name: str
    type_name: str
    messages: int
    missing: int
    repeated: int


@dataclass(frozen=True)
class PublishedEstimate:
    """An MFPT that the analysis published; see `EstimateReport`."""

    mfpt: float
    failure_probability: float
    lambda_2: float
    failure_shares: dict[str, float]


@dataclass(frozen=True)
class EstimateReport:
    """An MFPT computed from a recorded mesh.

    Parameters
    ----------
    mu_s, sigma_s : float
        rad, mean and standard deviation of the slope.
    correlation : float
        Of each slope with the one before.
    mfpt : float
        Steps, eq. (35).
    failure_probability, lambda_2 : float
        Of the chain; see `biped_mfpt_ros.chain.markov.Metastability`.
    failure_shares : dict of str to float
        Share of each outcome in the falls.
    published : PublishedEstimate or None
        What the analysis published for the same distribution, None if nothing.
    identical : bool or None
        Whether that is the same, bit for bit; None if nothing was published.
    """

    mu_s: float
    sigma_s: float
    correlation: float
    mfpt: float
    failure_probability: float
    lambda_2: float
    failure_shares: dict[str, float]
    published: PublishedEstimate | None
    identical: bool | None


@dataclass(frozen=True)
class MeshReport:
    """A mesh of a bag.

    Parameters
    ----------
    mesh_id : str
    status : str
        ``complete``, ``growing``, ``failed``, ``cancelled`` or ``unknown``, as published last.
    problem : str
        Why the mesh cannot be rebuilt; empty if it was.
    controller, scheme : str
        What walks; empty if the bag does not say.
    model : dict of str to float or str
        What it walks with.
    slopes : int
        Size of the slope set.
    threshold : float
        d_thr.
    clustered : bool
        Whether the nearest state was sought among those of the same preceding slope.
    scale_refresh : str
        When the scales of eq. (25) were computed anew, ``generation`` or ``addition``.
    step_map : str
        Identity of the step map that simulated it.
    seconds : float
        s, wall time that it took to grow.
    states, generations : int
        Size of the mesh, the failure state counted; 0 if it could not be rebuilt.
    outcomes : dict of str to int
        How many of its transitions, (states - 1) x slopes, end in each way.
    estimates : list of EstimateReport
    """

    mesh_id: str
    status: str
    problem: str
    controller: str
    scheme: str
    model: dict[str, Any]
    slopes: int
    threshold: float
    clustered: bool
    scale_refresh: str
    step_map: str
    seconds: float
    states: int
    generations: int
    outcomes: dict[str, int]
    estimates: list[EstimateReport]


@dataclass(frozen=True)
class BagReport:
    """What a bag holds, and what follows from it.

    Parameters
    ----------
    path : str
    bytes : int
        Size of its files.
    start : float
        s since the epoch, when the first message was received; 0 without one.
    duration : float
        s, from the first message to the last.
    messages : int
    topics : list of TopicReport
    meshes : list of MeshReport
    trials : int
        Trials of optimisers.
    problems : list of str
        All that is not as it should be, in sentences.
    """

    path: str
    bytes: int
    start: float
    duration: float
    messages: int
    topics: list[TopicReport]
    meshes: list[MeshReport]
    trials: int
    problems: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether every MFPT that was published came out again, bit for bit."""
        return all(
            estimate.identical is not False for mesh in self.meshes for estimate in mesh.estimates
        )

    def to_dict(self) -> dict[str, Any]:
        """All of it as dicts, lists, strings and numbers (among them inf)."""
        return asdict(self) | {"identical": self.identical}


def inspect_bag(
    path: str | os.PathLike[str],
    sigmas: Sequence[float] | None = None,
    mu: float | None = None,
    correlation: float | None = None,
) -> BagReport:
    """Rebuild the meshes of a bag and compute their MFPT, from the bag alone.

    Parameters
    ----------
    path : path-like
        Directory of the bag, or an MCAP file. It has to be whole: see
        `biped_mfpt_ros.bag.salvage` for one that is not.
    sigmas : sequence of float, optional
        rad, standard deviations of the slope; those that were published with the mesh by default.
    mu : float, optional
        rad, mean slope to go with `sigmas`; 0 by default.
    correlation : float, optional
        Of each slope with the one before, to go with `sigmas`; 0 by default.

    Returns
    -------
    BagReport

    Raises
    ------
    BagError
        The bag is missing, cut off, damaged, of another format, or holds no mesh.
    InputError
        `sigmas`, `mu` or `correlation` are not allowed.
    """
    wanted = None
    if sigmas is not None or mu is not None or correlation is not None:
        wanted = [(float(mu or 0.0), float(s), float(correlation or 0.0)) for s in sigmas or ()]
    bag = Bag(path)
    checks, published, first, last, problems = _survey(bag)
    topics = [
        TopicReport(
            topic.name,
            topic.type_name,
            topic.count,
            checks[topic.name].missing if topic.name in checks else 0,
            checks[topic.name].repeated if topic.name in checks else 0,
        )
        for topic in bag.topics.values()
    ]
    types = {topic.type_name for topic in topics}
    if f"{_PACKAGE}MeshInfo" not in types:
        raise BagError(
            bag.path,
            f"holds no mesh, only {', '.join(sorted(types)) or 'nothing'}",
            f"a bag with messages of type {_PACKAGE}MeshInfo",
        )
    meshes = []
    for recorded in recorded_meshes(bag):
        estimates = published.get(recorded.mesh_id, {})
        meshes.append(_mesh_report(recorded, estimates, wanted, problems))
        if recorded.problem and recorded.status not in ("failed", "cancelled"):
            problems.append(f"mesh {recorded.mesh_id}: {recorded.problem}")
    return BagReport(
        path=str(bag.path),
        bytes=bag.size,
        start=first / 1e9,
        duration=(last - first) / 1e9,
        messages=sum(topic.messages for topic in topics),
        topics=topics,
        meshes=meshes,
        trials=sum(t.messages for t in topics if t.type_name == f"{_PACKAGE}OptimisationTrial"),
        problems=problems,
    )


_Ground = tuple[float, float, float]
"""mu_s, sigma_s and correlation."""

_Estimates = dict[_Ground, PublishedEstimate]


def _survey(
    bag: Bag,
) -> tuple[dict[str, SequenceCheck], dict[str, _Estimates], int, int, list[str]]:
    """Read the bag once for what is small: counters, estimates, and times."""
    checks: dict[str, SequenceCheck] = {}
    published: dict[str, _Estimates] = {}
    first = last = 0
    problems: list[str] = []
    started_late = bag.metadata is not None and STARTED_LATE in bag.metadata.custom
    for raw in bag.raw_messages():
        first = min(first, raw.log_time) if first else raw.log_time
        last = max(last, raw.log_time)
        if not raw.type_name.startswith(_PACKAGE):
            continue
        complete = raw.type_name != _VOLATILE and not started_late
        check = checks.setdefault(raw.topic, SequenceCheck(complete=complete))
        try:
            problem = check.add(leading_sequence(raw.data))
        except ValueError as error:
            problem = str(error)
        if problem:
            problems.append(f"{raw.topic}: {problem}")
        if raw.type_name == _ESTIMATE:
            message = bag.decode(raw)
            shares = zip(message.failure_codes, message.failure_shares, strict=False)
            # Where estimates have no such field, they are of independent slopes.
            ground = message.mu_s, message.sigma_s, getattr(message, "correlation", 0.0)
            published.setdefault(message.mesh_id, {})[ground] = PublishedEstimate(
                message.mfpt,
                message.failure_probability,
                message.lambda_2,
                {_label(code): float(share) for code, share in shares},
            )
    return checks, published, first, last, problems


def _mesh_report(
    recorded: RecordedMesh,
    published: _Estimates,
    wanted: list[_Ground] | None,
    problems: list[str],
) -> MeshReport:
    mesh, settings = recorded.mesh, recorded.settings
    outcomes: dict[str, int] = {}
    estimates = []
    if mesh is not None:
        codes, counts = np.unique(mesh.outcomes[1:], return_counts=True)
        outcomes = {_label(code): int(n) for code, n in zip(codes, counts, strict=True)}
        for ground in published if wanted is None else wanted:
            mu_s, sigma_s, correlation = ground
            try:
                found = metastability(mesh, mu_s, sigma_s, correlation)
            except (ChainError, InputError) as error:
                if wanted is not None and isinstance(error, InputError):
                    raise
                problems.append(f"mesh {recorded.mesh_id}, sigma_s {sigma_s:g} rad: {error}")
                continue
            was = published.get(ground)
            shares = {_label(code): share for code, share in found.failure_shares.items()}
            now = PublishedEstimate(found.mfpt, found.failure_probability, found.lambda_2, shares)
            same = None if was is None else was == now
            estimates.append(EstimateReport(*ground, **vars(now), published=was, identical=same))
            if was is not None and was != now:
                problems.append(
                    f"mesh {recorded.mesh_id}, sigma_s {sigma_s:g} rad: an MFPT of {was.mfpt!r} "
                    f"was published, and {now.mfpt!r} comes out now"
                )
    return MeshReport(
        mesh_id=recorded.mesh_id,
        status=recorded.status,
        problem=recorded.problem,
        controller=settings.controller.name if settings else "",
        scheme=settings.controller.scheme if settings else "",
        model=model_values(settings.model) if settings else {},
        slopes=len(settings.slopes) if settings else 0,
        threshold=settings.threshold if settings else 0.0,
        clustered=bool(settings and settings.clustered),
        scale_refresh=settings.scale_refresh if settings else "",
        step_map=recorded.step_map,
        seconds=recorded.seconds,
        states=len(mesh.states) if mesh else 0,
        generations=int(mesh.generation.max()) + 1 if mesh else 0,
        outcomes=outcomes,
        estimates=estimates,
    )


def _label(code: int) -> str:
    try:
        return Outcome(code).name.lower()
    except ValueError:
        return f"outcome {code}"
