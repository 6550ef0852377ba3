#!/usr/bin/env bash
# scipy 1.17.1: the modified Fresnel integrals are wrong for negative arguments.
#
# Good guess: modfresnelp(x)[0] and modfresnelm(x)[0] are the integrals of exp(+i t^2) and exp(-i t^2) from x on, for any
#             real x, as their documentation has it; together with that of -x they make the integral over all t.
# Behaviour:  for x > 0 they are; for x < 0 the real part is right and the imaginary part is not: that of modfresnelp(-x)
#             comes out as the REAL part of modfresnelp(x), that of modfresnelm(-x) off by as much.
# Seen:       modfresnelm(-2)[0] 1.0881-2.3414j, by quadrature and by symmetry 1.0881-1.4314j; modfresnelp(-2)[0]
#             1.0881+0.1652j instead of 1.0881+1.4314j.
# These are the functions of diffraction at an edge (Sommerfeld), where the argument is negative on the lit side. rfpose does
# not use them; its tests of diffraction rest on scipy.special.fresnel, which is right on both.
# Exits 0 while this holds, 1 when it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check scipy==1.17.1 2>/dev/null
"$folder/venv/bin/python" - <<'PY'
import sys

import numpy as np
import scipy
from scipy.integrate import quad
from scipy.special import fresnel, modfresnelm, modfresnelp


def from_x_on(x, sign):
    """Integral of exp(sign i t^2) from x on: half the whole one, less that from 0 to x."""
    part = quad(lambda t: np.cos(t * t), 0.0, x)[0] + sign * 1j * quad(lambda t: np.sin(t * t), 0.0, x)[0]
    return np.sqrt(np.pi) / 2 * np.exp(sign * 0.25j * np.pi) - part


def by_fresnel(x, sign):
    sine, cosine = fresnel(x * np.sqrt(2 / np.pi))
    return np.sqrt(np.pi / 2) * ((0.5 - cosine) + sign * 1j * (0.5 - sine))


print("scipy", scipy.__version__)
print("   x   sign   modfresnel            quadrature            fresnel")
right, wrong = [], []
for x in (0.5, 1.0, 2.0, 3.0, -0.5, -1.0, -2.0, -3.0):
    for sign, function in ((1, modfresnelp), (-1, modfresnelm)):
        theirs, truth, other = complex(function(x)[0]), complex(from_x_on(x, sign)), complex(by_fresnel(x, sign))
        print(f"{x:5.1f}  {sign:+d}     " + "   ".join(f"{z:18.4f}" for z in (theirs, truth, other)))
        assert abs(truth - other) < 1e-9
        (right if x > 0 else wrong).append(abs(theirs - truth))
print(f"off by at most {max(right):.1e} for x > 0, by at least {min(wrong):.2f} for x < 0")
sys.exit(0 if max(right) < 1e-9 and min(wrong) > 0.1 else 1)
PY
