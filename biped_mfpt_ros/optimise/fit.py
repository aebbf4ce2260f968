"""A controller of another scheme, turned into one with B-spline references: where to search from.

Along the references of hybrid zero dynamics everything is a function of the phase. So the outputs
of the spline scheme are, too, and its coefficients follow from them by linear least squares.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BPoly

from biped_mfpt_ros.control import hzd, spline
from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.walker.robot import Robot

BEFORE, AFTER = 0.3, 0.1
"""Of a step on flat ground: how far the fitted references reach beyond its start and its end. On
rough ground swings begin before the one and end after the other."""

_SAMPLES = 400
_WEIGHT_BEYOND = 0.3  # of a sample out of the step, where the polynomials run away


def as_spline(control: Controller, robot: Robot) -> Controller:
    """Fit B-spline references to those of a controller of hybrid zero dynamics.

    Parameters
    ----------
    control : Controller
        Of the scheme ``hzd``.
    robot : Robot
        The links.

    Returns
    -------
    Controller
        Of the scheme ``spline``, with the gains of the other for every output. Eight coefficients
        do not follow a polynomial of degree six exactly, so the gait is a little different.

    Raises
    ------
    InputError
        If the controller is of another scheme.
    """
    if control.scheme != "hzd":
        raise InputError("scheme", control.scheme, "hzd, whose references are turned into splines")
    bezier = control.parameters[2:30].reshape(4, 7)
    start, end = hzd.phase_range(bezier, robot)
    tau = np.linspace(-BEFORE, 1.0 + AFTER, _SAMPLES)
    theta = start + tau * (end - start)
    q1, q2, q3, q4 = BPoly(bezier.T[:, None], [0.0, 1.0])(tau).T
    q5 = -theta - q1 - 0.5 * q3  # the phase is -(q1 + q5) - q3 / 2
    wanted = np.stack([q2 + q5, q3, q4, q5])

    parameters = np.zeros(len(spline.PARAMETERS))
    parameters[:4], parameters[4:8] = control.parameters[0], control.parameters[1]
    parameters[8:10] = theta[0], theta[-1]
    # References are linear in the coefficients: what each alone gives is its column.
    columns = []
    for k in range(spline.COEFFICIENTS):
        alone = parameters.copy()
        alone[10 + k] = 1.0
        columns.append(spline.references(alone, theta)[0, 0])
    weight = np.where((tau >= 0.0) & (tau <= 1.0), 1.0, _WEIGHT_BEYOND)
    fitted, *_ = np.linalg.lstsq(
        np.stack(columns, axis=1) * weight[:, None], (wanted * weight).T, rcond=None
    )
    parameters[10:] = fitted.T.ravel()
    name = control.name.replace("hzd/", "", 1)
    return Controller(f"spline/from-{name}", "spline", parameters)
