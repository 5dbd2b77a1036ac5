"""The order of a splitting as a power series: its error in H = (p² + q²)/2 + εV(q), in powers of Δt and of ε.

The flow of (p² + q²)/2 is a rotation and that of εV a kick, so each stage is exact, and so is the whole as far as the
series goes. The potential V is a polynomial of degree 5 with coefficients of no special kind. It depends on q alone and
the rest is quadratic in p: this is all that Runge–Kutta–Nyström splittings suppose. A coefficient that is off by δ
shows as an error of the size of δ in some power at which the method should have none.
"""

import mpmath
import numpy as np

FORCE = [mpmath.mpf(x) for x in ("0.3", "-0.7", "0.4", "0.9", "-0.2")]  # −V′ = Σ cⱼ qʲ
START = mpmath.mpf("0.6"), mpmath.mpf("-0.8")


class Series:
    """Power series in Δt and ε up to given powers, as arrays (powers of Δt, powers of ε) of mpmath's numbers."""

    def __init__(self, of_dt, of_epsilon):
        self.shape = of_dt + 1, of_epsilon + 1

    def constant(self, x):
        out = np.full(self.shape, mpmath.mpf(0), object)
        out[0, 0] = x
        return out

    def shifted(self, a, of_dt, of_epsilon):
        """The series a times these powers of Δt and ε."""
        out = self.constant(mpmath.mpf(0))
        out[of_dt:, of_epsilon:] = a[: self.shape[0] - of_dt, : self.shape[1] - of_epsilon]
        return out

    def times(self, a, b):
        entries = ((k, m) for k, m in np.ndindex(self.shape) if a[k, m])
        return sum((a[k, m] * self.shifted(b, k, m) for k, m in entries), self.constant(mpmath.mpf(0)))

    def force(self, q):
        """−εV′(q)."""
        total = self.constant(FORCE[-1])
        for c in FORCE[-2::-1]:
            total = self.times(total, q) + self.constant(c)
        return self.shifted(total, 0, 1)

    def flow(self):
        """The exact q and p after Δt, by as many Picard iterations as there are powers."""
        q, p = start = [self.constant(x) for x in START]
        over = np.array([mpmath.mpf(k + 1) for k in range(self.shape[0])], object)[:, None]
        for _ in range(self.shape[0]):
            rates = p, self.force(q) - q
            q, p = (x + self.shifted(rate / over, 1, 0) for x, rate in zip(start, rates, strict=True))
        return q, p

    def drifted(self, q, p, a):
        """The rotation by aΔt."""
        c, s = self.constant(mpmath.mpf(0)), self.constant(mpmath.mpf(0))
        for k in range(self.shape[0]):
            (s if k % 2 else c)[k, 0] = (-1) ** (k // 2) * mpmath.mpf(a) ** k / mpmath.factorial(k)
        return self.times(c, q) + self.times(s, p), self.times(c, p) - self.times(s, q)

    def step(self, drifts, kicks):
        """q and p after one step of a splitting, which begins and ends with what it has one more of."""
        q, p = (self.constant(x) for x in START)
        for k in range(len(drifts) + len(kicks)):
            if k % 2 == (len(kicks) > len(drifts)):
                q, p = self.drifted(q, p, drifts[k // 2])
            else:
                p = p + mpmath.mpf(kicks[k // 2]) * self.shifted(self.force(q), 1, 0)
        return q, p


def errors(method, of_dt, of_epsilon):
    """The errors of a step with these `drifts` and `kicks`, (powers of Δt, powers of ε), q and p being about 1."""
    with mpmath.workdps(30):
        series = Series(of_dt, of_epsilon)
        pairs = zip(series.step(*method), series.flow(), strict=True)
        return np.maximum(*(np.abs(a - b).astype(float) for a, b in pairs))
