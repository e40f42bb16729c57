"""Flights whose fixes err as asked for."""

import math
from dataclasses import replace

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult

CENTRE = LocalFrame(48.0, -4.5)
COV = np.array([[25.0, 12.0], [12.0, 16.0]])
FIX = Fix(0.0, 0.0, COV, 0.95, 35.0, 90.0, 100.0)


def flown(
    errors_en_m,
    states=None,
    *,
    places_en_m=None,
    times_s=None,
    names=None,
    unknown=(),
    local=CENTRE,
    evidence=(),
    **known,
):
    """Truth and results of views 10 m and 1 s apart to the east, off by `errors_en_m`, None for no
    fix; `unknown` have no truth. `known`: values of fields of the fixes, or lists of values."""
    n = len(errors_en_m)
    states = [states] * n if isinstance(states, str | None) else states
    if places_en_m is None:
        places_en_m = np.stack([10.0 * np.arange(n), np.zeros(n)], axis=1)
    truth, results = {}, []
    for i, (error, at) in enumerate(zip(errors_en_m, places_en_m, strict=True)):
        name = names[i] if names else f"{i:04d}.jpg"
        if i not in unknown:
            truth[name] = tuple(map(float, local.latlon_from_en(at)))
        stated = evidence[i] if len(evidence) > i else {}
        outcome = NoFix("blank", "", {"lowe_ratio": 9.0, **stated})
        if error is not None:
            lat, lon = map(float, local.latlon_from_en(np.add(at, error)))
            own = {key: each[i] if isinstance(each, list) else each for key, each in known.items()}
            outcome = replace(FIX, lat_deg=lat, lon_deg=lon, evidence=stated, **own)
        time_ns = 10**9 * (i if times_s is None else times_s[i])
        results.append(ViewResult(name, time_ns, outcome, 10.0, states[i]))
    return truth, results


def drawn(n=200, seed=0, alike=0.0):
    """(n, 2) errors of covariance `COV`, each `alike` times the one before."""
    random = np.random.default_rng(seed)
    white = random.normal(size=(n, 2))
    for i in range(1, n):
        white[i] = alike * white[i - 1] + math.sqrt(1 - alike**2) * white[i]
    return white @ np.linalg.cholesky(COV).T
