"""How long one waits for a command's help, and for a node to be ready once compiled."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from biped_mfpt_ros.bench.measure import BenchError, Section, row
from biped_mfpt_ros.bench.nodes import Nodes, cpu_seconds


def helped(repetitions: int) -> np.ndarray:
    """Seconds of ``biped-mfpt --help``, from the start of the interpreter to its end."""
    out = np.empty(repetitions)
    for i in range(repetitions):
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "biped_mfpt_ros.cli", "--help"], capture_output=True, text=True
        )
        out[i] = time.perf_counter() - start
        if done.returncode or "usage" not in done.stdout.lower():
            raise BenchError(f"biped-mfpt --help ended with {done.returncode}: {done.stderr}")
    return out


def ready(repetitions: int) -> tuple[np.ndarray, np.ndarray]:
    """Seconds from the start of a simulator to its service on the graph, and its CPU time."""
    out, cpu = np.empty(repetitions), np.empty(repetitions)
    with Nodes() as nodes:
        for i in range(repetitions):
            start = time.perf_counter()
            process = nodes.start("simulator", f"simulator_{i}")
            name = f"{nodes.namespace}/simulator_{i}/simulate_steps"

            def there(name: str = name) -> bool:
                return name in nodes.simulators()

            nodes.spin(there, 300.0, "a simulator")
            out[i], cpu[i] = time.perf_counter() - start, cpu_seconds(process)
    return out, cpu


def run(short: bool) -> Section:
    """Start things. The first simulator may compile, and does not count."""
    repetitions = 2 if short else 5
    seconds, cpu = ready(1 + repetitions)
    return Section(
        rows=[
            row("biped-mfpt --help", helped(repetitions), 1, "s"),
            row("a simulator is ready after", seconds[1:], 1, "s"),
            row("a simulator is ready after, CPU", cpu[1:], 1, "s"),
        ]
    )
