// The step of free_rigid_body.cpp in the scalar form, with the loop over bodies inside of the one over steps, in blocks:
// each block of kBlock bodies makes all its steps while its numbers stay in the first cache, and every line of the inner
// loop is an instruction for a whole vector of bodies. This is what machine code of `li.run` does, by hand.
//
//   midpoint   m by three Newton steps on the quartic, in each step
//   explicit   m once for a trajectory, of which it is a constant

#include "body.hpp"

#ifndef BLOCK
#define BLOCK 16
#endif

namespace {

constexpr int kBlock = BLOCK;

template <class T>
struct Block {
  T w[kBlock], x[kBlock], y[kBlock], z[kBlock], px[kBlock], py[kBlock], pz[kBlock], m[kBlock], worst[kBlock];
  typename Newton<T>::Flag good[kBlock];
};

template <class T, bool kExplicit>
void advance(T* q, const T* p, T* worst, std::uint8_t* converged, std::int64_t bodies, std::int64_t steps, double dt,
             const double* inertia) {
  using Flag = typename Newton<T>::Flag;
  const double r = 1 / (inertia[0] + inertia[1] + inertia[2]);
  const Scalar<T, false> solve({T(r * inertia[0]), T(r * inertia[1]), T(r * inertia[2])});
  const T scale = T(0.5 * r * dt), tolerance = 32 * std::numeric_limits<T>::epsilon();
  for (std::int64_t first = 0; first < bodies; first += kBlock) {
    Block<T> b;
    for (int i = 0; i < kBlock; ++i) {
      const std::int64_t k = first + i < bodies ? first + i : bodies - 1;  // the last block repeats the last body
      b.w[i] = q[k], b.x[i] = q[k + bodies], b.y[i] = q[k + 2 * bodies], b.z[i] = q[k + 3 * bodies];
      b.px[i] = p[k], b.py[i] = p[k + bodies], b.pz[i] = p[k + 2 * bodies];
      b.worst[i] = worst[k], b.good[i] = converged[k];
      if (kExplicit) b.m[i] = solve.root(scale * to_body(b.w[i], {b.x[i], b.y[i], b.z[i]}, {b.px[i], b.py[i], b.pz[i]}));
    }
    for (std::int64_t n = 0; n < steps; ++n) {
#pragma GCC ivdep
      for (int i = 0; i < kBlock; ++i) {
        const T w = b.w[i];
        const Vec<T> v = {b.x[i], b.y[i], b.z[i]}, pi = {b.px[i], b.py[i], b.pz[i]};
        const Vec<T> a = scale * to_body(w, v, pi);

        const auto [h, f] = solve.half_rotation(a, kExplicit ? b.m[i] : solve.root(a));
        const T residual = max_abs(f);
        b.worst[i] = larger(b.worst[i], residual);
        b.good[i] &= Flag(residual <= tolerance * max_abs(a)) & Flag(dot(h, h) <= 1);

        const auto [dw, dv] = increment(w, v, h);
        b.w[i] = w + dw;
        b.x[i] = v.x + dv.x;
        b.y[i] = v.y + dv.y;
        b.z[i] = v.z + dv.z;
      }
    }
    for (int i = 0; i < kBlock && first + i < bodies; ++i) {
      const std::int64_t k = first + i;
      q[k] = b.w[i], q[k + bodies] = b.x[i], q[k + 2 * bodies] = b.y[i], q[k + 3 * bodies] = b.z[i];
      worst[k] = b.worst[i], converged[k] = std::uint8_t(b.good[i]);
    }
  }
}

}  // namespace

#define EXPORT(name, T, kExplicit)                                                                                   \
  extern "C" void name(T* q, const T* p, T* worst, std::uint8_t* converged, std::int64_t bodies, std::int64_t steps, \
                       double dt, const double* inertia) {                                                           \
    advance<T, kExplicit>(q, p, worst, converged, bodies, steps, dt, inertia);                                       \
  }

EXPORT(midpoint_float64, double, false)
EXPORT(midpoint_float32, float, false)
EXPORT(explicit_float64, double, true)
EXPORT(explicit_float32, float, true)
