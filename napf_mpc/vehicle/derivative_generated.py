"""State derivative of the quadrotor as scalar code. Generated: do not edit.

Written by ``python -m napf_mpc.vehicle.codegen`` from :func:`napf_mpc.vehicle.quadrotor.derivative_function`.
"""

from __future__ import annotations

from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare


@compiled_bare
def derivative(
    x: NDArray[np.float64], u: NDArray[np.float64], p: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write the rate of the state x (12,) under input u (4,) and parameters p (4,) into out (12,)."""
    w0 = x[1]
    out[0] = w0
    w2 = u[0]
    w3 = p[0]
    w4 = w2 / w3
    w5 = x[6]
    w6 = cos(w5)
    w7 = x[8]
    w8 = sin(w7)
    w9 = w6 * w8
    w10 = x[10]
    w11 = cos(w10)
    w12 = w9 * w11
    w13 = sin(w5)
    w14 = sin(w10)
    w15 = w13 * w14
    w16 = w12 + w15
    w17 = w4 * w16
    out[1] = w17
    w19 = x[3]
    out[2] = w19
    w21 = w9 * w14
    w22 = w13 * w11
    w23 = w21 - w22
    w24 = w4 * w23
    out[3] = w24
    w26 = x[5]
    out[4] = w26
    w28 = w4 * w6
    w29 = cos(w7)
    w30 = w28 * w29
    w31 = 9.81
    w32 = w30 - w31
    out[5] = w32
    w34 = x[7]
    out[6] = w34
    w36 = p[2]
    w37 = p[3]
    w38 = w36 - w37
    w39 = x[9]
    w40 = w38 * w39
    w41 = x[11]
    w42 = w40 * w41
    w43 = u[1]
    w44 = w42 + w43
    w45 = p[1]
    w46 = w44 / w45
    out[7] = w46
    out[8] = w39
    w49 = w37 - w45
    w50 = w49 * w34
    w51 = w50 * w41
    w52 = u[2]
    w53 = w51 + w52
    w54 = w53 / w36
    out[9] = w54
    out[10] = w41
    w57 = w45 - w36
    w58 = w57 * w34
    w59 = w58 * w39
    w60 = u[3]
    w61 = w59 + w60
    w62 = w61 / w37
    out[11] = w62
