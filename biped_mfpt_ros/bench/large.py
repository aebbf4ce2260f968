"""A mesh of 1e5 states through all nodes: time, memory, and what each part takes."""

from __future__ import annotations

import dataclasses
import os
import time

import numpy as np

from biped_mfpt_ros.bench.measure import BenchError, Section, row
from biped_mfpt_ros.bench.nodes import Nodes, cpu_seconds, peak_bytes
from biped_mfpt_ros.bench.pipeline import grow_here, settings_of


def run(short: bool) -> Section:
    """Grow it with as many simulators as there are cores, an analysis and a recorder."""
    settings = dataclasses.replace(
        settings_of("hzd/mfpt", 0.02 if short else 1.6e-4), max_states=1_000_000
    )
    mesh, step_map, beside = grow_here(settings)
    n = len(mesh.states)
    with Nodes() as nodes:
        cores = len(os.sched_getaffinity(0))
        processes = {
            "recorder": nodes.start("recorder", "recorder", bag=nodes.directory / "bag"),
            "analysis": nodes.start("analysis", "analysis"),
            "mesher": nodes.start("mesher", "mesher"),
        }
        for i in range(1, cores + 1):
            processes[f"simulator {i}"] = nodes.start("simulator", f"simulator_{i}")
        nodes.wait(cores)
        nodes.spin(lambda: {"recorder", "analysis"} <= {*nodes.names()}, 60.0, "the nodes")
        time.sleep(1.0)
        before = {name: (cpu_seconds(p), peak_bytes(p)) for name, p in processes.items()}
        (result,) = nodes.grow(settings)
        if result.states != n:
            raise BenchError(f"{result.states} states where {n} were due")
        grown = {name: cpu_seconds(p) - before[name][0] for name, p in processes.items()}
        nodes.spin_once(0.0)
        deadline = time.monotonic() + 120.0
        used = 0.0
        # The analysis and the recorder have caught up when they have nothing more to do.
        while time.monotonic() < deadline:
            time.sleep(1.0)
            now = cpu_seconds(processes["analysis"]) + cpu_seconds(processes["recorder"])
            if now - used < 0.02:
                break
            used = now
        section = Section(
            rows=[
                row(f"mesh of {n} states, {cores} simulators", np.array([result.seconds]), 1, "s")
            ]
        )
        facts = section.facts
        facts[f"mesh of {n}: s of CPU, step map, here"] = round(step_map, 2)
        facts[f"mesh of {n}: s of CPU, tests and targets, here"] = round(beside, 2)
        for name, process in processes.items():
            start, end = before[name][1], peak_bytes(process)
            facts[f"mesh of {n}: s of CPU, {name}"] = round(grown[name], 2)
            facts[f"mesh of {n}: MB at most, {name}"] = round(end / 1e6)
            facts[f"mesh of {n}: bytes a state above the start, {name}"] = round((end - start) / n)
    return section
