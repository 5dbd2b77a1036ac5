// The symplectic κ step of a free rigid body (principal inertia), structure of arrays: what a C++ user would write.
//
//   a = ½Δt Π_n / tr J,   Π_n = Λ_nᵀπ;   J/tr J → J
//   newton   J h + h × J h = a (1 + |h|²)                          three Newton steps on the vector h
//   scalar   h = (J − m − â)⁻¹ a,   m = a·h                        three Halley steps on the quartic for m
//   q ← q + q (c − 1 − d, (c − d) h),   c = 1/√(1 + |h|²), d = ½c(|q|² − 1)    an increment, norm defect folded in
//
// Per body it keeps the largest |residual| and whether every step converged: |residual| ≤ 32 eps max|a| and |h| ≤ 1.

#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>

namespace {

constexpr int kIterations = 3;

template <class T>
struct Vec {
  T x, y, z;
};

template <class T>
inline Vec<T> operator+(Vec<T> a, Vec<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T>
inline Vec<T> operator-(Vec<T> a, Vec<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class T>
inline Vec<T> operator*(T s, Vec<T> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class T>
inline Vec<T> operator*(Vec<T> a, Vec<T> b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }  // by components
template <class T>
inline T dot(Vec<T> a, Vec<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T>
inline T trace(Vec<T> a) { return a.x + a.y + a.z; }
template <class T>
inline Vec<T> cross(Vec<T> a, Vec<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
inline T larger(T a, T b) { return a > b ? a : b; }
template <class T>
inline T max_abs(Vec<T> a) { return larger(larger(std::fabs(a.x), std::fabs(a.y)), std::fabs(a.z)); }

template <class T>
struct Root {
  Vec<T> h, residual;
};

template <class T>
struct Newton {
  using Flag = std::conditional_t<sizeof(T) == 8, std::int64_t, std::int32_t>;  // vectors of one width: fastest here
  Vec<T> J, J_inverse, d;

  explicit Newton(Vec<T> inertia)
      : J(inertia), J_inverse{1 / J.x, 1 / J.y, 1 / J.z}, d{J.z - J.y, J.x - J.z, J.y - J.x} {}

  Vec<T> residual(Vec<T> h, Vec<T> a) const {
    return J * h + Vec<T>{d.x * h.y * h.z, d.y * h.z * h.x, d.z * h.x * h.y} - (1 + dot(h, h)) * a;
  }

  // K⁻¹f by the adjugate, K = J + (h × J h)' − 2 a⊗h.
  Vec<T> correction(Vec<T> h, Vec<T> a, Vec<T> f) const {
    const Vec<T> t = T(2) * a;
    const Vec<T> r0 = {J.x - t.x * h.x, d.x * h.z - t.x * h.y, d.x * h.y - t.x * h.z};
    const Vec<T> r1 = {d.y * h.z - t.y * h.x, J.y - t.y * h.y, d.y * h.x - t.y * h.z};
    const Vec<T> r2 = {d.z * h.y - t.z * h.x, d.z * h.x - t.z * h.y, J.z - t.z * h.z};
    const Vec<T> c0 = cross(r1, r2), c1 = cross(r2, r0), c2 = cross(r0, r1);
    return (1 / dot(r0, c0)) * (f.x * c0 + f.y * c1 + f.z * c2);
  }

  Root<T> operator()(Vec<T> a) const {
    const Vec<T> u = J_inverse * a;
    Vec<T> h = u + J_inverse * cross(a, u);
#pragma GCC unroll 3
    for (int k = 0; k < kIterations; ++k) h = h - correction(h, a, residual(h, a));
    return {h, residual(h, a)};
  }
};

template <class T>
struct Scalar {
  using Flag = std::uint8_t;  // interleaves eight vectors: fastest here, where the chain of operations is long
  Vec<T> J, C;  // C = adj J
  T J2, J3;

  explicit Scalar(Vec<T> inertia)
      : J(inertia), C{J.y * J.z, J.z * J.x, J.x * J.y}, J2(trace(C)), J3(J.x * C.x) {}

  Root<T> operator()(Vec<T> a) const {
    const Vec<T> Ja = J * a, Ca = C * a;
    const T s = dot(a, a), aCa = dot(a, Ca);
    const T c0 = -(aCa + s * s), c1 = J3 + s, c2 = -(J2 + 2 * s), r3 = 1 / J3;
    const Vec<T> u = r3 * Ca, g = cross(a, u);
    T m = r3 * aCa * (1 + dot(u, u)) - r3 * dot(g, C * g);
#pragma GCC unroll 3
    for (int k = 0; k < kIterations; ++k) {
      const T f = c0 + m * (c1 + m * (c2 + m * (1 - m)));
      const T slope = c1 + m * (2 * c2 + m * (3 - 4 * m)), bend = 2 * c2 + m * (6 - 12 * m);
      m -= 2 * f * slope / (2 * slope * slope - f * bend);
    }
    const T n = s - m * (1 - m);
    const Vec<T> h = (1 / (J3 + dot(a, Ja) - m * (J2 + n))) * (n * a + Ca + m * Ja - cross(a, Ja));
    return {h, J * h - dot(a, h) * h - a - cross(a, h)};
  }
};

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
      const Vec<T> t = T(2) * cross(v, pi);
      const Vec<T> a = scale * (pi - w * t + cross(v, t));

      const auto [h, f] = solve(a);
      const T hh = dot(h, h), residual = std::sqrt(dot(f, f));
      largest[i] = larger(largest[i], residual);
      all[i] &= (residual <= tolerance * max_abs(a)) & (hh <= 1);

      const T root = std::sqrt(1 + hh), inverse = 1 / (root * (1 + root));
      const T c = inverse * (1 + root), d = c * (w * w + dot(v, v) - 1) / 2;
      const T k = -hh * inverse - d;
      const Vec<T> ch = (c - d) * h;
      const Vec<T> dv = w * ch + k * v + cross(v, ch);
      qw[i] = w + (w * k - dot(v, ch));
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
