// The implicit midpoint rule (6.17) for a pseudo-rigid ball of the paper's material, body by body: what a C++ user would
// write. Unknown U = F_{n+1} − F_n, residual R = E U + (Δt²/2) F_m S(C_m) − Δt P, S = μ1 + (λ − (λ+μ)/I₃) cof C, Newton
// with the full 9×9 matrix and Gaussian elimination, until the correction is below 1e-9, at most 25 times.

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

using Mat = double[3][3];

double cofactor(const Mat A, Mat c) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int a = (i + 1) % 3, b = (i + 2) % 3, k = (j + 1) % 3, l = (j + 2) % 3;
      c[i][j] = A[a][k] * A[b][l] - A[a][l] * A[b][k];
    }
  return A[0][0] * c[0][0] + A[0][1] * c[0][1] + A[0][2] * c[0][2];
}

void product(const Mat A, const Mat B, Mat out) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out[i][j] = A[i][0] * B[0][j] + A[i][1] * B[1][j] + A[i][2] * B[2][j];
}

void gram(const Mat F, Mat C) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) C[i][j] = F[0][i] * F[0][j] + F[1][i] * F[1][j] + F[2][i] * F[2][j];
}

bool step(double* F, double* P, double dt, double E, double lam, double mu) {
  const double c = dt * dt / 2;
  double u[9] = {}, force[9] = {};
  bool done = false;
  for (int iteration = 0; iteration < 26; ++iteration) {
    Mat Fm, C, cof, S, force_matrix;
    for (int i = 0; i < 9; ++i) Fm[i / 3][i % 3] = F[i] + u[i] / 2;
    gram(Fm, C);
    const double I3 = cofactor(C, cof), r = lam - (lam + mu) / I3, slope = (lam + mu) / (I3 * I3);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) S[i][j] = r * cof[i][j] + (i == j ? mu : 0);
    product(Fm, S, force_matrix);
    for (int i = 0; i < 9; ++i) force[i] = force_matrix[i / 3][i % 3];
    if (done) break;
    double A[9][10];
    for (int k = 0; k < 3; ++k)
      for (int l = 0; l < 3; ++l) {  // dU = e_k ⊗ e_l, dF_m = ½dU, dC = ½(f e_lᵀ + e_l fᵀ), f = row k of F_m
        Mat dC = {}, dS, FdS;
        for (int b = 0; b < 3; ++b) {
          dC[l][b] += Fm[k][b] / 2;
          dC[b][l] += Fm[k][b] / 2;
        }
        double dI3 = 0;
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) dI3 += cof[i][j] * dC[i][j];
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) {
            const int a = (i + 1) % 3, b = (i + 2) % 3, m = (j + 1) % 3, n = (j + 2) % 3;
            const double dcof = dC[a][m] * C[b][n] + C[a][m] * dC[b][n] - dC[a][n] * C[b][m] - C[a][n] * dC[b][m];
            dS[i][j] = slope * dI3 * cof[i][j] + r * dcof;
          }
        product(Fm, dS, FdS);
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j)
            A[3 * i + j][3 * k + l] = c * (FdS[i][j] + (i == k ? S[l][j] / 2 : 0)) + (i == k && j == l ? E : 0);
      }
    for (int i = 0; i < 9; ++i) A[i][9] = E * u[i] + c * force[i] - dt * P[i];
    for (int k = 0; k < 9; ++k) {
      const double inverse = 1 / A[k][k];
      for (int i = k + 1; i < 9; ++i) {
        const double f = A[i][k] * inverse;
        for (int j = k + 1; j < 10; ++j) A[i][j] -= f * A[k][j];
      }
    }
    double largest = 0;
    for (int i = 8; i >= 0; --i) {
      double s = A[i][9];
      for (int j = i + 1; j < 9; ++j) s -= A[i][j] * A[j][9];
      A[i][9] = s / A[i][i];
      largest = std::max(largest, std::fabs(A[i][9]));
    }
    for (int i = 0; i < 9; ++i) u[i] -= A[i][9];
    done = largest < 1e-9;
  }
  for (int i = 0; i < 9; ++i) {
    F[i] += u[i];
    P[i] -= dt * force[i];
  }
  return done;
}

}  // namespace

extern "C" void midpoint(double* F, double* P, std::uint8_t* good, std::int64_t bodies, std::int64_t steps, double dt,
                         double E, double lam, double mu) {
  for (std::int64_t i = 0; i < bodies; ++i)
    for (std::int64_t n = 0; n < steps; ++n) good[i] &= step(F + 9 * i, P + 9 * i, dt, E, lam, mu);
}
