/* Three conserving steps of a rigid body in plain C, for engines that have their own loop.

   q = (w, x, y, z): attitude, a unit quaternion from body to space. pi: angular momentum in space.
   J: principal moments of inertia. Each step returns 1 if it solved its equation, else 0: then use a smaller dt.
   The symplectic steps need |dt Omega| below about 1 rad, the torqued step below about 2 rad. */

#include <math.h>

#ifndef REAL
#define REAL double
#endif
typedef REAL real;

typedef struct {
  real q[4], pi[3];
} Body;

static real dot(const real a[3], const real b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void cross(const real a[3], const real b[3], real out[3]) {
  for (int i = 0, j = 1, k = 2; i < 3; j = k, k = i, i++) out[i] = a[j] * b[k] - a[k] * b[j];
}

/* Rotate v from body to space (sign = 1) or from space to body (sign = -1). */
static void rotate(const real q[4], int sign, const real v[3], real out[3]) {
  real t[3], u[3];
  cross(q + 1, v, t);
  cross(q + 1, t, u);
  for (int i = 0; i < 3; i++) out[i] = v[i] + 2 * (sign * q[0] * t[i] + u[i]);
}

/* q <- q cay(2h), as an increment that also corrects |q|: rounding errors are of the size of the step. */
static void advance(real q[4], const real h[3]) {
  const real hh = dot(h, h), s = sqrt(1 + hh), r = 1 / (s * (1 + s)), c = r * (1 + s);
  const real d = c * (q[0] * q[0] + dot(q + 1, q + 1) - 1) / 2, k = -hh * r - d;
  real ch[3], x[3];
  for (int i = 0; i < 3; i++) ch[i] = (c - d) * h[i];
  cross(q + 1, ch, x);
  const real w = q[0];
  q[0] += w * k - dot(q + 1, ch);
  for (int i = 0; i < 3; i++) q[i + 1] += w * ch[i] + k * q[i + 1] + x[i];
}

/* a = dt/2 Pi, with Pi the momentum in the body. */
static void half_impulse(const Body *body, real dt, real a[3]) {
  rotate(body->q, -1, body->pi, a);
  for (int i = 0; i < 3; i++) a[i] *= dt / 2;
}

/* The root m = a.h of the quartic of the symplectic step J h = a + a x h + m h. It is the same for all steps of a free
   body with one dt. */
static int solve_m(const real J[3], const real a[3], real *m) {
  const real s = dot(a, a), J3 = J[0] * J[1] * J[2], J2 = J[0] * J[1] + J[1] * J[2] + J[2] * J[0];
  const real trace = J[0] + J[1] + J[2], aCa = J3 * (a[0] * a[0] / J[0] + a[1] * a[1] / J[1] + a[2] * a[2] / J[2]);
  const real c0 = -(aCa + s * s), c1 = J3 + trace * s, c2 = -(J2 + 2 * s);
  *m = -c0 / c1;
  for (int n = 0; n < 20; n++) {
    const real f = c0 + *m * (c1 + *m * (c2 + *m * (trace - *m)));
    const real slope = c1 + *m * (2 * c2 + *m * (3 * trace - 4 * *m)), step = f / slope;
    *m -= step;
    if (fabs(step) <= 4e-16 * fabs(*m)) return slope > 0;
  }
  return 0;
}

/* h = (J - m - [a]x)^-1 a, and the rotation by cay(2h). */
static int symplectic(const real J[3], const real a[3], real m, Body *body) {
  const real s = dot(a, a), J3 = J[0] * J[1] * J[2], J2 = J[0] * J[1] + J[1] * J[2] + J[2] * J[0];
  const real Ja[3] = {J[0] * a[0], J[1] * a[1], J[2] * a[2]}, trace = J[0] + J[1] + J[2];
  const real k = s - m * (trace - m), r = 1 / (J3 - m * (J2 + k) + dot(a, Ja));
  real h[3], x[3];
  cross(a, Ja, x);
  for (int i = 0; i < 3; i++) h[i] = r * (J3 / J[i] * a[i] + k * a[i] + m * Ja[i] - x[i]);
  advance(body->q, h);
  return dot(h, h) <= 1;
}

/* A free body, energy, momentum and the symplectic form to round-off. Lewis & Simo 1994, kappa of (3.16). */
int so3_midpoint(const real J[3], Body *body, real dt) {
  real a[3], m;
  half_impulse(body, dt, a);
  return solve_m(J, a, &m) && symplectic(J, a, m, body);
}

/* The same step, with m solved once per trajectory by so3_prepare. */
int so3_prepare(const real J[3], const Body *body, real dt, real *m) {
  real a[3];
  half_impulse(body, dt, a);
  return solve_m(J, a, m);
}

int so3_explicit(const real J[3], real m, Body *body, real dt) {
  real a[3];
  half_impulse(body, dt, a);
  return symplectic(J, a, m, body);
}

/* A torque in the body, of the time, the attitude and the angular velocity in the body. */
typedef void (*Torque)(real t, const real q[4], const real Omega[3], real torque[3], void *data);

/* J y + y x J y = a + dt^2/4 T, y = dt/2 Omega: the kinetic energy changes by dt Omega.T and pi by dt (L_n + L_n+1)/2 T,
   both to round-off, for any torque. `work` accumulates dt Omega.T; t is the time at the start of the step. */
int torqued_midpoint(const real J[3], Torque law, void *data, Body *body, real t, real dt, real *work) {
  real a[3], y[3], Omega[3], T[3], f[3], step[3], Jy[3], x[3], q[4], middle[4];
  int solved = 0;
  half_impulse(body, dt, a);
  for (int i = 0; i < 3; i++) y[i] = a[i] / J[i];
  for (int n = 0; n < 50 && !solved; n++) {
    for (int i = 0; i < 4; i++) q[i] = body->q[i];
    advance(q, y);
    for (int i = 0; i < 4; i++) middle[i] = body->q[i] + q[i];
    const real size = sqrt(middle[0] * middle[0] + dot(middle + 1, middle + 1));
    for (int i = 0; i < 4; i++) middle[i] /= size;
    for (int i = 0; i < 3; i++) Omega[i] = 2 * y[i] / dt, Jy[i] = J[i] * y[i];
    law(t + dt / 2, middle, Omega, T, data);
    cross(y, Jy, x);
    for (int i = 0; i < 3; i++) f[i] = Jy[i] + x[i] - a[i] - dt * dt / 4 * T[i];
    /* Newton's matrix J + [y]x J - [J y]x, its torque left out: (rows) and its solution by cross products of rows */
    const real d0 = J[2] - J[1], d1 = J[0] - J[2], d2 = J[1] - J[0];
    const real K[3][3] = {{J[0], d0 * y[2], d0 * y[1]}, {d1 * y[2], J[1], d1 * y[0]}, {d2 * y[1], d2 * y[0], J[2]}};
    real c[3][3];
    for (int i = 0; i < 3; i++) cross(K[(i + 1) % 3], K[(i + 2) % 3], c[i]);
    const real det = dot(K[0], c[0]);
    for (int i = 0; i < 3; i++) step[i] = (f[0] * c[0][i] + f[1] * c[1][i] + f[2] * c[2][i]) / det;
    for (int i = 0; i < 3; i++) y[i] -= step[i];
    solved = dot(step, step) <= 1e-29 * dot(y, y) && det > 0;
  }
  /* One rotation and one torque for both balances: those of the last y. */
  for (int i = 0; i < 4; i++) q[i] = body->q[i];
  advance(q, y);
  real first[3], last[3];
  rotate(body->q, 1, T, first);
  rotate(q, 1, T, last);
  for (int i = 0; i < 3; i++) body->pi[i] += dt * (first[i] + last[i]) / 2;
  for (int i = 0; i < 4; i++) body->q[i] = q[i];
  *work += 2 * dot(y, T);
  return solved;
}
