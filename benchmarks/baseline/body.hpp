// What the baselines share: vectors, attitudes, the free body's step with the symplectic κ in two forms.

#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>

namespace {

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

// Λᵀπ and Λx of the attitude (w, v).
template <class T>
inline Vec<T> to_body(T w, Vec<T> v, Vec<T> pi) {
  const Vec<T> t = T(2) * cross(v, pi);
  return pi - w * t + cross(v, t);
}
template <class T>
inline Vec<T> to_space(T w, Vec<T> v, Vec<T> x) {
  const Vec<T> t = T(2) * cross(v, x);
  return x + w * t + cross(v, t);
}

// q cay(2h) by the increment, norm defect folded in: what to add to w and v.
template <class T>
struct Increment {
  T w;
  Vec<T> v;
};
template <class T>
inline Increment<T> increment(T w, Vec<T> v, Vec<T> h) {
  const T hh = dot(h, h), root = std::sqrt(1 + hh), inverse = 1 / (root * (1 + root));
  const T c = inverse * (1 + root), d = c * (w * w + dot(v, v) - 1) / 2;
  const T k = -hh * inverse - d;
  const Vec<T> ch = (c - d) * h;
  return {w * k - dot(v, ch), w * ch + k * v + cross(v, ch)};
}

// M⁻¹f of a matrix given by its rows, by the adjugate; and its determinant.
template <class T>
struct Solution {
  Vec<T> x;
  T determinant;
};
template <class T>
inline Solution<T> solve(Vec<T> r0, Vec<T> r1, Vec<T> r2, Vec<T> f) {
  const Vec<T> c0 = cross(r1, r2), c1 = cross(r2, r0), c2 = cross(r0, r1);
  const T det = dot(r0, c0);
  return {(1 / det) * (f.x * c0 + f.y * c1 + f.z * c2), det};
}

// The symplectic κ of the free body: two ways to h, three iterations each.
constexpr int kIterations = 3;

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
    return solve(r0, r1, r2, f).x;
  }

  Root<T> operator()(Vec<T> a) const {
    const Vec<T> u = J_inverse * a;
    Vec<T> h = u + J_inverse * cross(a, u);
#pragma GCC unroll 3
    for (int k = 0; k < kIterations; ++k) h = h - correction(h, a, residual(h, a));
    return {h, residual(h, a)};
  }
};

template <class T, bool kHalley = true>  // else Newton's own steps: a little faster in blocks
struct Scalar {
  using Flag = std::uint8_t;  // interleaves eight vectors: fastest here, where the chain of operations is long
  Vec<T> J, C;  // C = adj J
  T J2, J3;

  explicit Scalar(Vec<T> inertia)
      : J(inertia), C{J.y * J.z, J.z * J.x, J.x * J.y}, J2(trace(C)), J3(J.x * C.x) {}

  // The root m of the quartic.
  T root(Vec<T> a) const {
    const Vec<T> Ca = C * a;
    const T s = dot(a, a), aCa = dot(a, Ca);
    const T c0 = -(aCa + s * s), c1 = J3 + s, c2 = -(J2 + 2 * s), r3 = 1 / J3;
    const Vec<T> u = r3 * Ca, g = cross(a, u);
    T m = r3 * aCa * (1 + dot(u, u)) - r3 * dot(g, C * g);
#pragma GCC unroll 3
    for (int k = 0; k < kIterations; ++k) {
      const T f = c0 + m * (c1 + m * (c2 + m * (1 - m)));
      const T slope = c1 + m * (2 * c2 + m * (3 - 4 * m));
      if constexpr (kHalley) {
        const T bend = 2 * c2 + m * (6 - 12 * m);
        m -= 2 * f * slope / (2 * slope * slope - f * bend);
      } else {
        m -= f / slope;
      }
    }
    return m;
  }

  // h and its residual, of a root m.
  Root<T> half_rotation(Vec<T> a, T m) const {
    const Vec<T> Ja = J * a, Ca = C * a;
    const T s = dot(a, a), n = s - m * (1 - m);
    const Vec<T> h = (1 / (J3 + dot(a, Ja) - m * (J2 + n))) * (n * a + Ca + m * Ja - cross(a, Ja));
    return {h, J * h - dot(a, h) * h - a - cross(a, h)};
  }

  Root<T> operator()(Vec<T> a) const { return half_rotation(a, root(a)); }
};

}  // namespace
