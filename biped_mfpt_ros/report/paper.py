"""What the paper says about a controller: ``data/paper.json``, Tables 2, 4 and 5, section 6."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def _data() -> dict[str, Any]:
    text = files("biped_mfpt_ros").joinpath("data/paper.json").read_text()
    data: dict[str, Any] = json.loads(text)
    return data


def _table(scheme: str) -> tuple[float, dict[str, dict[str, float]]]:
    """Standard deviation (degrees) and table with Monte Carlo of a scheme."""
    tables = {"hzd": (2.0, "table2_hzd_sigma2"), "smc": (5.0, "table4_smc_sigma5")}
    sigma_deg, key = tables[scheme]
    return sigma_deg, _data()[key]


def _known(name: str) -> bool:
    scheme, _, label = name.partition("/")
    return label in _data()["table5_sigma1"].get(scheme, {})


def mfpt(name: str, mean_deg: float, sigma_deg: float, correlation: float = 0.0) -> float | None:
    """The paper's mean first-passage time from its mesh, steps; None where it gives none."""
    if not _known(name) or mean_deg != 0.0 or correlation != 0.0:
        return None
    scheme, _, label = name.partition("/")
    at, rows = _table(scheme)
    if sigma_deg == 1.0:
        return float(_data()["table5_sigma1"][scheme][label])
    return float(rows["estimate_eq34"][label]) if sigma_deg == at else None


def monte_carlo(
    name: str, mean_deg: float, sigma_deg: float, correlation: float = 0.0
) -> float | None:
    """The paper's mean of 10000 Monte Carlo walks, steps; None where it gives none."""
    if not _known(name) or mean_deg != 0.0 or correlation != 0.0:
        return None
    scheme, _, label = name.partition("/")
    at, rows = _table(scheme)
    return float(rows["monte_carlo"][label]) if sigma_deg == at else None


def monte_carlo_sigma_deg(name: str) -> float | None:
    """Standard deviation at which the paper has Monte Carlo walks of a controller, degrees."""
    return _table(name.partition("/")[0])[0] if _known(name) else None


def speed(name: str, slope_deg: float = 0.0) -> float | None:
    """The paper's speed on flat ground, m/s; None where it gives none."""
    value = _data()["flat_ground"]["hzd_base_speed_m_s"]
    return float(value) if name == "hzd/base" and slope_deg == 0.0 else None


def cost_of_transport(name: str, slope_deg: float = 0.0) -> float | None:
    """The paper's cost of transport on flat ground; None where it gives none."""
    value = _data()["flat_ground"]["cost_of_transport"].get(name.replace("/", "_"))
    return float(value) if value is not None and slope_deg == 0.0 else None


def figures(name: str) -> dict[str, Any]:
    """All that the paper says about a controller, for a list."""
    at = monte_carlo_sigma_deg(name)
    return {
        "controller": name,
        "speed": speed(name),
        "cost_of_transport": cost_of_transport(name),
        "mfpt": mfpt(name, 0.0, 1.0),
        "mfpt_sigma_deg": 1.0,
        "mean_steps": None if at is None else monte_carlo(name, 0.0, at),
        "mean_steps_sigma_deg": at,
    }
