"""Benchmarks: `make bench`. One file to a subject, each with ``run(short) -> Section``."""
