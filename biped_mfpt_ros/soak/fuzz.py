"""Bad input by the thousand, against our own parsers and message handlers.

Each target is given inputs that are mostly right, with something wrong in them: that comes further
than noise. It may take an input, or refuse it with an `InputError` that names field, value and what
is allowed. Anything else is a failure, and so is to take too long over it, or memory that grows.
"""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable
from random import Random

import numpy as np

from biped_mfpt_ros.bench.nodes import held
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes import analysis, mesher
from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.soak import live, targets
from biped_mfpt_ros.soak.result import PromiseBroken, Row

INPUTS = 110_000
"""Of a whole run, over all targets."""

SHORT_INPUTS = 3000

MOST_SECONDS = 5.0
"""s of processor time that an input may take. The dearest request takes 0.5 s (see
`SimulatorParameters.max_evaluations`, which is set to a fraction of its default here)."""

MOST_GROWTH = 32e6
"""Bytes that the process may grow by, after the first third of a target's inputs. A leak of 1 kB
an input shows; what the allocator keeps for reuse does not."""

MOST_HANDLES = 4
"""Open files and threads that a node may have more in the end: threads of a pool start with what
they do first."""

_EXAMPLES = 5

Target = Callable[[Random], object]
"""Makes an input from a random generator, and gives it to what is tested."""


def warm_up() -> None:
    """Compile all kernels: that is not what is timed."""
    mesher.warm_up()
    analysis.warm_up()


def run(short: bool, seed: int, progress: Progress) -> list[Row]:
    """Fuzz every target."""
    warm_up()
    most = SHORT_INPUTS if short else INPUTS
    total = sum(target.share for target in targets.TARGETS)
    rows = [
        run_target(target, max(1, round(most * target.share / total)), seed, progress)
        for target in targets.TARGETS
    ]
    return rows + run_live(live.SHORT_INPUTS if short else live.INPUTS, seed, progress)


def run_target(target: targets.TargetEntry, inputs: int, seed: int, progress: Progress) -> Row:
    """Fuzz one target; see `fuzz`."""
    # What numpy would only warn of is something that nobody thought of, too.
    with target.make() as give, np.errstate(all="raise", under="ignore"):
        return fuzz(target.name, give, inputs, seed, progress)


def run_live(inputs: int, seed: int, progress: Progress) -> list[Row]:
    """Fuzz every target of nodes that run, then look whether these are well, and end them."""
    total = sum(share for _, share, _ in live.TARGETS)
    rows = []
    with live.live() as nodes:
        before = nodes.held()
        for name, share, make in live.TARGETS:
            with make(nodes) as give:
                most = max(1, round(inputs * share / total))
                rows.append(fuzz(name, give, most, seed, progress, nodes.memory))
        start = time.monotonic()
        problems = []
        try:
            nodes.check_well()
            for name, now in nodes.held().items():
                problems += [
                    f"{name}: {before[name][what]} {what} became {now[what]}"
                    for what in ("files", "threads")
                    if now[what] > before[name][what] + MOST_HANDLES
                ]
            nodes.end()
        except PromiseBroken as error:
            problems.append(str(error))
    seconds = time.monotonic() - start
    return [*rows, Row("fuzz", "the nodes after it", 1, len(problems), seconds, {}, problems)]


def fuzz(
    name: str,
    give: Target,
    inputs: int,
    seed: int,
    progress: Progress,
    memory: Callable[[], dict[str, float]] | None = None,
) -> Row:
    """Give one target many inputs.

    Parameters
    ----------
    name : str
        Of the target.
    give : callable
        See `Target`.
    inputs : int
        How many.
    seed : int
        Input ``i`` is made from the seed ``"NAME SEED i"``, so that any one can be made again.
    progress : Progress
        Told how far it is.
    memory : callable, optional
        Tells the bytes that whatever must not grow has now, by its name; this process by default.

    Returns
    -------
    Row
    """
    failures: list[str] = []
    refused = 0
    slowest, slowest_input = 0.0, 0
    memory = memory or _memory
    kept: dict[str, float] = {}
    start = time.monotonic()
    for i in range(inputs):
        if i == inputs // 3:
            kept = memory()
        progress.count(f"fuzz: {name}", i, inputs, "inputs")
        before = time.process_time()
        try:
            give(Random(f"{name} {seed} {i}"))
        except InputError as error:
            refused += 1
            problem = unclear(error)
            if problem:
                failures.append(f"input {i}: {problem}")
        except Exception:
            failures.append(f"input {i}: {traceback.format_exc(limit=-4)}")
        seconds = time.process_time() - before
        if seconds > slowest:
            slowest, slowest_input = seconds, i
        if seconds > MOST_SECONDS:
            failures.append(f"input {i}: took {seconds:.1f} s")
    growths = {who: now - kept[who] for who, now in memory().items()}
    failures += [
        f"{who} grew by {growth / 1e6:.0f} MB after the first third"
        for who, growth in growths.items()
        if growth > MOST_GROWTH
    ]
    return Row(
        "fuzz",
        name,
        inputs,
        len(failures),
        time.monotonic() - start,
        {
            "refused": refused,
            "slowest_seconds": round(slowest, 3),
            "slowest_input": slowest_input,
            "growth_megabytes": round(max(growths.values()) / 1e6, 1),
        },
        failures[:_EXAMPLES],
    )


def unclear(error: InputError) -> str:
    """Why a refusal is of no use to who gets it; empty if it names field, value and what may be."""
    shown = str(error)
    if not (error.field and error.allowed):
        return f"a refusal without field or without what is allowed: {shown!r}"
    if error.allowed not in shown or len(shown) > 20_000:
        return f"a refusal that does not say what is allowed: {shown[:1000]!r}"
    return ""


def _memory() -> dict[str, float]:
    """Bytes that this process has now."""
    return {"the process": 1e3 * held(os.getpid())["kilobytes"]}
