// The symplectic κ step of a free rigid body (principal inertia), structure of arrays: what a C++ user would write.
//
//   a = ½Δt Π_n / tr J,   Π_n = Λ_nᵀπ;   J/tr J → J
//   newton   J h + h × J h = a (1 + |h|²)                          three Newton steps on the vector h
//   scalar   h = (J − m − â)⁻¹ a,   m = a·h                        three Halley steps on the quartic for m
//   q ← q + q (c − 1 − d, (c − d) h),   c = 1/√(1 + |h|²), d = ½c(|q|² − 1)    an increment, norm defect folded in
//
// Per body it keeps the largest |residual| and whether every step converged: |residual| ≤ 32 eps max|a| and |h| ≤ 1.

#include "body.hpp"

namespace {

template <class T, class Solve>
void advance(T* q, const T* p, T* worst, typename Solve::Flag* converged, std::int64_t bodies,
             std::int64_t steps, double dt, const double* inertia) {
  const double r = 1 / (inertia[0] + inertia[1] + inertia[2]);
  const Solve solve({T(r * inertia[0]), T(r * inertia[1]), T(r * inertia[2])});
  const T scale = T(0.5 * r * dt), tolerance = 32 * std::numeric_limits<T>::epsilon();
  T *__restrict qw = q, *__restrict qx = q + bodies, *__restrict qy = q + 2 * bodies, *__restrict qz = q + 3 * bodies;
  const T *__restrict px = p, *__restrict py = p + bodies, *__restrict pz = p + 2 * bodies;
  T* __restrict largest = worst;
  typename Solve::Flag* __restrict all = converged;

  for (std::int64_t n = 0; n < steps; ++n) {
#pragma GCC ivdep
    for (std::int64_t i = 0; i < bodies; ++i) {
      const T w = qw[i];
      const Vec<T> v = {qx[i], qy[i], qz[i]}, pi = {px[i], py[i], pz[i]};
      const Vec<T> a = scale * to_body(w, v, pi);

      const auto [h, f] = solve(a);
      const T residual = std::sqrt(dot(f, f));
      largest[i] = larger(largest[i], residual);
      all[i] &= (residual <= tolerance * max_abs(a)) & (dot(h, h) <= 1);

      const auto [dw, dv] = increment(w, v, h);
      qw[i] = w + dw;
      qx[i] = v.x + dv.x;
      qy[i] = v.y + dv.y;
      qz[i] = v.z + dv.z;
    }
  }
}

}  // namespace

#define EXPORT(name, T, Solve)                                                                          \
  extern "C" void name(T* q, const T* p, T* worst, Solve<T>::Flag* converged, std::int64_t bodies,       \
                       std::int64_t steps, double dt, const double* inertia) {                           \
    advance<T, Solve<T>>(q, p, worst, converged, bodies, steps, dt, inertia);                            \
  }

EXPORT(newton_float64, double, Newton)
EXPORT(newton_float32, float, Newton)
EXPORT(scalar_float64, double, Scalar)
EXPORT(scalar_float32, float, Scalar)
