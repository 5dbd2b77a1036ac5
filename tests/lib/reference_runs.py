"""The reference runs of the site: motions in 54 digits, rounded to the nearest double, with their inputs.

    python tests/lib/reference_runs.py          writes docs/pages/reference_runs/*.json

Every motion has its equations written out here, for Taylor series in fixed-point numbers (`taylor`), and a run of the
package with which `tests/pages/test_reference_runs.py` compares them. All inputs are doubles without rounding.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import taylor
from taylor import Series

FOLDER = Path(__file__).parents[2] / "docs" / "pages" / "reference_runs"
Vector = Sequence[Any]
QUATERNION = (
    "q = (w, x, y, z) is the unit quaternion of the rotation from body to space, R its matrix; vectors in the body "
    "are capital letters; dq/dt = q (0, W)/2 with the angular velocity W in the body"
)


class Motion(NamedTuple):
    """A motion: its text for the file, and its equations.

    Attributes:
        title, equations: what it is, with all symbols.
        inputs: symbol ↦ numbers.
        columns: the names of the unknowns, in their order.
        start: the unknowns at t = 0.
        rate: their derivatives, of power series.
        times: of the file; the first is 0.
        longest: the longest step of the series.
    """

    title: str
    equations: str
    inputs: dict[str, Any]
    columns: list[str]
    start: list[float]
    rate: Callable[[list[Series]], list[Any]]
    times: list[float]
    longest: float


def cross(a: Vector, b: Vector) -> list[Any]:
    """a × b, in any arithmetic."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Vector, b: Vector) -> Any:
    """a · b, in any arithmetic."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def add(*vectors: Vector) -> list[Any]:
    """The sum of vectors, in any arithmetic."""
    return [sum(row[1:], row[0]) for row in zip(*vectors, strict=True)]


def scale(factor: Any, v: Vector) -> list[Any]:
    """A number times a vector, in any arithmetic."""
    return [x * factor for x in v]


def turn(q: Vector, W: Vector) -> list[Any]:
    """dq/dt."""
    w, v = q[0], q[1:]
    return [dot(v, W) / -2, *scale(Fraction(1, 2), add(scale(w, W), cross(v, W)))]


def matrix(q: Vector) -> list[list[Any]]:
    """R of a unit quaternion."""
    w, x, y, z = q
    return [
        [(y * y + z * z) * -2 + 1, (x * y - w * z) * 2, (x * z + w * y) * 2],
        [(x * y + w * z) * 2, (x * x + z * z) * -2 + 1, (y * z - w * x) * 2],
        [(x * z - w * y) * 2, (y * z + w * x) * 2, (x * x + y * y) * -2 + 1],
    ]


def into_body(R: list[list[Any]], v: Vector) -> list[Any]:
    """Rᵀv."""
    return add(*map(scale, v, R))


def euler(J: Vector, W: Vector, torque: Vector | None = None) -> list[Any]:
    """dW/dt of a rigid body, J dW/dt = JW × W + T."""
    gyroscopic = cross([w * j for w, j in zip(W, J, strict=True)], W)
    return [x / j for x, j in zip(gyroscopic if torque is None else add(gyroscopic, torque), J, strict=True)]


def axes(*names: str) -> list[str]:
    """Names of the components of vectors."""
    return [f"{name}_{x}" for name in names for x in "xyz"]


ATTITUDE = ["q_w", *axes("q")]
HALF = [0.5, -0.5, 0.5, 0.5]


def free_body() -> Motion:
    """Euler's equations."""
    J = [1.0, 2.0, 3.0]
    return Motion(
        "A free rigid body",
        f"{QUATERNION}. J dW/dt = JW × W.",
        {"J": J},
        ATTITUDE + axes("W"),
        [*HALF, 0.25, 0.125, 1.0],
        lambda y: [*turn(y[:4], y[4:]), *euler(J, y[4:])],
        [4.0 * k for k in range(11)],
        0.5,
    )


def heavy_top() -> Motion:
    """A top without symmetry."""
    J, weight = [1.0, 2.0, 2.5], [0.5, 0.375, 1.0]

    def rate(y: list[Series]) -> list[Any]:
        q, W = y[:4], y[4:]
        up = matrix(q)[2]  # Rᵀe₃
        return [*turn(q, W), *euler(J, W, cross(up, [up[0] * 0 + w for w in weight]))]

    return Motion(
        "A heavy top",
        f"{QUATERNION}. The fixed point is the origin, J the inertia about it, c = m g times the center of mass in the "
        "body, and gravity points along -e_3: J dW/dt = JW × W + (R^T e_3) × c.",
        {"J": J, "c": weight},
        ATTITUDE + axes("W"),
        [*HALF, 0.25, 0.125, 1.0],
        rate,
        [1.5 * k for k in range(11)],
        0.25,
    )


def satellite() -> Motion:
    """Three laws of torque along an ellipse."""
    J, damping, dipole = [1.0, 2.0, 2.5], 0.03125, [0.25, 0.0, 0.125]

    def rate(y: list[Series]) -> list[Any]:
        q, W, r, v = y[:4], y[4:7], y[7:10], y[10:]
        square = dot(r, r)
        third, fifth = square ** Fraction(-3, 2), square ** Fraction(-5, 2)
        R = matrix(q)
        near = into_body(R, r)
        gradient = scale(fifth * 3, cross(near, [x * j for x, j in zip(near, J, strict=True)]))
        field = scale(fifth * r[2] * 3, r)
        field[2] -= third
        magnetic = cross([W[0] * 0 + m for m in dipole], into_body(R, field))
        torque = add(gradient, magnetic, scale(-damping, W))
        return [*turn(q, W), *euler(J, W, torque), *v, *scale(-third, r)]

    return Motion(
        "A satellite with three laws of torque on an ellipse",
        f"{QUATERNION}. The center r moves with velocity v by d^2r/dt^2 = -r/|r|^3. With N = R^T r, "
        "b = 3 r_z r/|r|^5 - e_3/|r|^3 (the field of a dipole along e_3) and T = 3 N × JN/|r|^5 + m × R^T b - d W: "
        "J dW/dt = JW × W + T.",
        {"J": J, "d": damping, "m": dipole},
        ATTITUDE + axes("W", "r", "v"),
        [*HALF, 0.25, 0.125, 1.0, 0.75, 0.0, 0.0, 0.0, 1.0, 0.75],
        rate,
        [0.75 * k for k in range(11)],
        0.0625,
    )


def binary() -> Motion:
    """Two bodies to second order (MacCullagh)."""
    masses, inertias = [1.0, 0.25], [[0.25, 0.3125, 0.375], [0.015625, 0.0234375, 0.03125]]

    def rate(y: list[Series]) -> list[Any]:
        x, q, v, W = (y[k : k + n] for k, n in ((0, 6), (6, 8), (14, 6), (20, 6)))
        d = [b - a for a, b in zip(x[:3], x[3:], strict=True)]
        square = dot(d, d)
        third, fifth, seventh = (square ** Fraction(-n, 2) for n in (3, 5, 7))
        pull, torques = scale(third * (masses[0] * masses[1]), d), []
        for k, J in enumerate(inertias):
            other, R = masses[1 - k], matrix(q[4 * k : 4 * k + 4])
            D = into_body(R, d)
            JD = [a * j for a, j in zip(D, J, strict=True)]
            in_space = [dot(row, JD) for row in R]
            radial = fifth * (sum(J) * 1.5 * other) - seventh * dot(D, JD) * (7.5 * other)
            pull = add(pull, scale(radial, d), scale(fifth * (3 * other), in_space))
            torques.append(scale(fifth * (3 * other), cross(D, JD)))
        return [
            *v,
            *turn(q[:4], W[:3]),
            *turn(q[4:], W[3:]),
            *scale(1 / masses[0], pull),
            *scale(-1 / masses[1], pull),
            *euler(inertias[0], W[:3], torques[0]),
            *euler(inertias[1], W[3:], torques[1]),
        ]

    return Motion(
        "A binary asteroid: two rigid bodies, gravity to second order",
        f"{QUATERNION}. Body k has mass m_k, inertia J_k, center x_k, velocity v_k. With d = x_2 - x_1, r = |d|, D_k = "
        "R_k^T d and G = 1 the potential is V = -m_1 m_2/r - sum_k m_other [tr J_k/(2 r^3) - 3 D_k·J_k D_k/(2 r^5)]: "
        "m_k d^2x_k/dt^2 = -dV/dx_k, J_k dW_k/dt = J_k W_k × W_k + 3 m_other D_k × J_k D_k/r^5.",
        {"m_1": masses[0], "m_2": masses[1], "J_1": inertias[0], "J_2": inertias[1]},
        [*axes("x_1", "x_2"), *(f"q_{k}_{c}" for k in (1, 2) for c in "wxyz"), *axes("v_1", "v_2", "W_1", "W_2")],
        [-0.5, 0, 0, 2.0, 0, 0, 1, 0, 0, 0, *HALF, 0, -0.125, 0, 0, 0.5, 0, 0.125, 0.0625, 0.5, 0.25, 0.0625, 0.25],
        rate,
        [3.0 * k for k in range(11)],
        0.25,
    )


def elastic() -> Motion:
    """A pseudo-rigid body."""
    E, lam, mu = [1.0, 1.25, 1.5], 2.0, 1.0

    def rate(y: list[Series]) -> list[Any]:
        F = [y[k : k + 3] for k in (0, 3, 6)]
        columns = [[F[i][j] for i in range(3)] for j in range(3)]
        G = [[dot(a, b) - (1 if i == j else 0) for j, b in enumerate(columns)] for i, a in enumerate(columns)]
        pressure = (G[0][0] + G[1][1] + G[2][2]) * (lam / 2)
        S = [[G[i][j] * mu + (pressure if i == j else 0) for j in range(3)] for i in range(3)]
        return [*y[9:], *(dot(row, S[j]) / -E[j] for row in F for j in range(3))]

    return Motion(
        "An elastic body that deforms homogeneously (pseudo-rigid)",
        "The point X of the body is at F X, V = dF/dt. E = diag of the second moments of mass, C = F^T F, "
        "S = lambda/2 tr(C - 1) 1 + mu (C - 1) (Saint Venant-Kirchhoff): dV/dt = -F S E^-1.",
        {"E": E, "lambda": lam, "mu": mu},
        [f"{name}_{i}{j}" for name in "FV" for i in "123" for j in "123"],
        [1.125, 0, 0, 0, 1, 0.0625, 0, 0, 0.875, 0, -1, 0.25, 1, 0, -0.5, 0, 0.5, 0.125],
        rate,
        [1.0 * k for k in range(11)],
        0.0625,
    )


def rod() -> Motion:
    """Two elements of an elastic rod: three sections."""
    masses, inertias = [0.5, 1.0, 0.5], [[0.25, 0.375, 0.625], [0.5, 0.75, 1.25], [0.25, 0.375, 0.625]]
    stretching, bending = [2.0, 3.0, 4.0], [1.0, 1.5, 0.75]
    start = [0.25, 0.125, 0, -0.25, 0, 0.125, 0.25, -0.125, 0, 0.25, 0.5, 0.125, -0.125, 0.25, -0.25, 0.5, -0.25, 0.125]

    def element(ends: Vector, frames: Vector) -> tuple[Vector, list[list[Vector]]]:
        """The force in a unit element, and dV/dd_a of its two sections."""
        d = [list(zip(*R, strict=True)) for R in frames]  # directors, the columns of R
        apart = [b - a for a, b in zip(*ends, strict=True)]
        mean = [scale(Fraction(1, 2), add(a, b)) for a, b in zip(*d, strict=True)]
        n = [(dot(m, apart) - (a == 2)) * stretching[a] for a, m in enumerate(mean)]
        slopes = [[scale(n[a] / 2, apart) for a in range(3)] for _ in d]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            opened = (bending[b] + bending[c] - bending[a]) * Fraction(2, 3)  # 4/3 A_a
            s = (dot(d[1][b], d[0][c]) - dot(d[1][c], d[0][b])) / 2 * (bending[a] * Fraction(-1, 6))  # dV/ds_a / 2
            for k, sign in ((0, 1), (1, -1)):
                other = d[1 - k]
                slopes[k][a] = add(slopes[k][a], scale(-opened, other[a]))
                slopes[k][c] = add(slopes[k][c], scale(s * sign, other[b]))
                slopes[k][b] = add(slopes[k][b], scale(s * -sign, other[c]))
        return add(*map(scale, n, mean)), slopes

    def rate(y: list[Series]) -> list[Any]:
        x, q, v, W = ([y[k + n * i : k + n * i + n] for i in range(3)] for k, n in ((0, 3), (9, 4), (21, 3), (30, 3)))
        frames = [matrix(a) for a in q]
        (N0, slopes0), (N1, slopes1) = (element(x[k : k + 2], frames[k : k + 2]) for k in (0, 1))
        forces = [N0, add(N1, scale(-1, N0)), scale(-1, N1)]
        slopes = [slopes0[0], [add(a, b) for a, b in zip(slopes0[1], slopes1[0], strict=True)], slopes1[1]]
        torques = [
            into_body(R, scale(-1, add(*map(cross, zip(*R, strict=True), of))))
            for R, of in zip(frames, slopes, strict=True)
        ]
        turned, pushed = map(turn, q, W), (scale(1 / m, f) for m, f in zip(masses, forces, strict=True))
        rows = (*v, *turned, *pushed, *map(euler, inertias, W, torques))
        return [number for row in rows for number in row]

    sections = [f"{name}_{k}" for name in "xvW" for k in "123"]
    return Motion(
        "A free elastic rod: three sections, two elements of length 1",
        f"{QUATERNION}. Section k has mass m_k, inertia J_k, center x_k, velocity v_k and axes, the columns of R_k. "
        "With d, e the axes of the sections k, k + 1 of an element, Gamma_a = (d_a + e_a)·(x_k+1 - x_k)/2, "
        "s_a = (e_b·d_c - e_c·d_b)/2 with (a, b, c) cyclic, A_a = (B_1 + B_2 + B_3)/2 - B_a, and "
        "V = sum_a [C_a (Gamma_a - delta_a3)^2/2 + 4/3 A_a (1 - d_a·e_a) - B_a s_a^2/6]: m_k d^2x_k/dt^2 = -dV/dx_k, "
        "J_k dW_k/dt = J_k W_k × W_k - R_k^T sum_a d_a × dV/dd_a, with V summed over both elements.",
        {**{f"m_{k + 1}": m for k, m in enumerate(masses)}, **{f"J_{k + 1}": J for k, J in enumerate(inertias)}}
        | {"C": stretching, "B": bending},
        [*axes(*sections[:3]), *(f"q_{k}_{c}" for k in "123" for c in "wxyz"), *axes(*sections[3:])],
        [0, 0, 0, 0, 0, 1, 0, 0, 2, *[1, 0, 0, 0] * 3, *start],
        rate,
        [0.5 * k for k in range(11)],
        0.0625,
    )


MOTIONS: dict[str, Callable[[], Motion]] = {
    make.__name__: make for make in (free_body, heavy_top, satellite, binary, elastic, rod)
}


def states(motion: Motion, longest: float, order: int) -> list[list[float]]:
    """The doubles nearest to the unknowns, at each of the times."""
    found = taylor.solve(motion.rate, motion.start, motion.times, longest, order)
    return [[float(x) for x in row] for row in found]


def text(motion: Motion) -> str:
    """The file of a motion."""
    head = {
        "motion": motion.title,
        "equations": motion.equations,
        "units": "none: all numbers are without unit",
        "inputs": motion.inputs,
        "accuracy": "every number is the double nearest to the exact solution; see the page Reference runs",
        "columns": ["t", *motion.columns],
    }
    rows = ",\n".join(
        f"  {json.dumps([t, *row])}" for t, row in zip(motion.times, states(motion, motion.longest, 40), strict=True)
    )
    return json.dumps(head, indent=1, ensure_ascii=False)[:-2] + f',\n "states": [\n{rows}\n ]\n}}\n'


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, make in MOTIONS.items():
        (FOLDER / f"{name}.json").write_text(text(make()), encoding="utf-8")


if __name__ == "__main__":
    main()
