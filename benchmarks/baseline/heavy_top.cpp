// The two schemes for a heavy top (principal inertia, γ = e₃), structure of arrays: what a C++ user would write.
//
//   splitting            π += ½Δt γ × ΛE;   a step of the free body, symplectic κ, scalar form;   π += ½Δt γ × ΛE
//   energy_momentum      a = ½Δt Π_n / tr J,   J/tr J → J,   s = ¼Δt² / tr J,   Γ = Λ_nᵀγ,   κ = 1
//                        J h + h × J h − a = s [w − h (h·w)/(1 + |h|²)],   w = (Γ − h × Γ) × E     four Newton steps
//                        π += Δt γ × ½(Λ_n + Λ_{n+1})E,   Λ_{n+1} = Λ_n cay(2h)
//
// Per body they keep the largest |residual| and whether every step converged.

#include "body.hpp"

namespace {

template <class T>
inline Vec<T> read(const T* x, std::int64_t bodies, std::int64_t i) {
  return {x[i], x[i + bodies], x[i + 2 * bodies]};
}
template <class T>
inline void write(T* x, std::int64_t bodies, std::int64_t i, Vec<T> v) {
  x[i] = v.x;
  x[i + bodies] = v.y;
  x[i + 2 * bodies] = v.z;
}

// The torque γ × ΛE.
template <class T>
inline Vec<T> torque(T w, Vec<T> v, Vec<T> E) {
  const Vec<T> e = to_space(w, v, E);
  return {-e.y, e.x, 0};
}

template <class T>
struct Splitting {
  using Flag = std::uint8_t;
  Vec<T> E;
  Scalar<T> solve;
  T half, scale;

  Splitting(Vec<T> inertia, Vec<T> weight, T dt)
      : E(weight), solve((1 / trace(inertia)) * inertia), half(dt / 2), scale(dt / (2 * trace(inertia))) {}

  bool step(T& w, Vec<T>& v, Vec<T>& pi, T& residual, T tolerance) const {
    pi = pi + half * torque(w, v, E);
    const Vec<T> a = scale * to_body(w, v, pi);
    const auto [h, f] = solve(a);
    residual = std::sqrt(dot(f, f));
    const auto [dw, dv] = increment(w, v, h);
    w += dw;
    v = v + dv;
    pi = pi + half * torque(w, v, E);
    return (residual <= tolerance * max_abs(a)) & (dot(h, h) <= 1);
  }
};

template <class T>
struct EnergyMomentum {
  using Flag = std::conditional_t<sizeof(T) == 8, std::int64_t, std::int32_t>;
  Vec<T> J, J_inverse, d, E;
  T dt, scale, s;

  EnergyMomentum(Vec<T> inertia, Vec<T> weight, T dt)
      : J((1 / trace(inertia)) * inertia), J_inverse{1 / J.x, 1 / J.y, 1 / J.z},
        d{J.z - J.y, J.x - J.z, J.y - J.x}, E(weight), dt(dt), scale(dt / (2 * trace(inertia))),
        s(dt * dt / (4 * trace(inertia))) {}

  Vec<T> residual(Vec<T> h, Vec<T> a, Vec<T> Gamma) const {
    const Vec<T> w = cross(Gamma, E) + dot(Gamma, E) * h - dot(h, E) * Gamma;
    const Vec<T> force = w - (dot(h, w) / (1 + dot(h, h))) * h;
    return J * h + Vec<T>{d.x * h.y * h.z, d.y * h.z * h.x, d.z * h.x * h.y} - a - s * force;
  }

  // K − s[(Γ·E)1 − Γ⊗E],   K = J + (h × J h)'.
  Solution<T> correction(Vec<T> h, Vec<T> Gamma, Vec<T> f) const {
    const T g = s * dot(Gamma, E);
    const Vec<T> sE = s * E;
    const Vec<T> r0 = {J.x - g + Gamma.x * sE.x, d.x * h.z + Gamma.x * sE.y, d.x * h.y + Gamma.x * sE.z};
    const Vec<T> r1 = {d.y * h.z + Gamma.y * sE.x, J.y - g + Gamma.y * sE.y, d.y * h.x + Gamma.y * sE.z};
    const Vec<T> r2 = {d.z * h.y + Gamma.z * sE.x, d.z * h.x + Gamma.z * sE.y, J.z - g + Gamma.z * sE.z};
    return solve(r0, r1, r2, f);
  }

  bool step(T& w, Vec<T>& v, Vec<T>& pi, T& worst, T tolerance) const {
    const Vec<T> a = scale * to_body(w, v, pi), Gamma = to_body(w, v, Vec<T>{0, 0, 1});
    const Vec<T> u = J_inverse * a;
    Vec<T> h = u + J_inverse * (cross(a, u) + s * cross(Gamma, E));
#pragma GCC unroll 4
    for (int k = 0; k < 4; ++k) h = h - correction(h, Gamma, residual(h, a, Gamma)).x;
    const Vec<T> f = residual(h, a, Gamma);
    worst = std::sqrt(dot(f, f));
    const Vec<T> e = to_space(w, v, (1 / (1 + dot(h, h))) * (E + cross(h, E) + dot(h, E) * h));
    pi = pi + dt * Vec<T>{-e.y, e.x, 0};
    const auto [dw, dv] = increment(w, v, h);
    w += dw;
    v = v + dv;
    return (worst <= tolerance * (max_abs(a) + s * max_abs(E))) & (correction(h, Gamma, f).determinant > 0);
  }
};

template <class T, class Scheme>
void advance(T* __restrict q, T* __restrict p, T* __restrict worst, typename Scheme::Flag* __restrict converged,
             std::int64_t bodies, std::int64_t steps, double dt, const double* constants) {
  const auto three = [&](int k) { return Vec<T>{T(constants[k]), T(constants[k + 1]), T(constants[k + 2])}; };
  const Scheme scheme(three(0), three(3), T(dt));
  const T tolerance = 32 * std::numeric_limits<T>::epsilon();
  T* __restrict imaginary = q + bodies;
  for (std::int64_t n = 0; n < steps; ++n) {
#pragma GCC ivdep
    for (std::int64_t i = 0; i < bodies; ++i) {
      T w = q[i], residual;
      Vec<T> v = read(imaginary, bodies, i), pi = read(p, bodies, i);
      converged[i] &= scheme.step(w, v, pi, residual, tolerance);
      worst[i] = larger(worst[i], residual);
      q[i] = w;
      write(imaginary, bodies, i, v);
      write(p, bodies, i, pi);
    }
  }
}

}  // namespace

#define EXPORT(name, T, Scheme)                                                                           \
  extern "C" void name(T* q, T* p, T* worst, Scheme<T>::Flag* converged, std::int64_t bodies,            \
                       std::int64_t steps, double dt, const double* constants) {                          \
    advance<T, Scheme<T>>(q, p, worst, converged, bodies, steps, dt, constants);                          \
  }

EXPORT(splitting_float64, double, Splitting)
EXPORT(energy_momentum_float64, double, EnergyMomentum)
