// Counts the arithmetic operations of the steps of engine.c: the same source with numbers that count.

#include <cmath>
#include <cstdio>

static long operations = 0;

struct Counted {
  double x;
  Counted(double x = 0) : x(x) {}
  operator double() const { return x; }
};
static Counted operator+(Counted a, Counted b) { return operations++, a.x + b.x; }
static Counted operator-(Counted a, Counted b) { return operations++, a.x - b.x; }
static Counted operator*(Counted a, Counted b) { return operations++, a.x * b.x; }
static Counted operator/(Counted a, Counted b) { return operations++, a.x / b.x; }
static Counted operator-(Counted a) { return -a.x; }
static Counted &operator+=(Counted &a, Counted b) { return a = a + b; }
static Counted &operator-=(Counted &a, Counted b) { return a = a - b; }
static Counted &operator*=(Counted &a, Counted b) { return a = a * b; }
static Counted &operator/=(Counted &a, Counted b) { return a = a / b; }
static Counted sqrt(Counted a) { return operations++, std::sqrt(a.x); }
#define MIXED(op) \
  template <class T> static Counted operator op(T a, Counted b) { return Counted(double(a)) op b; } \
  template <class T> static Counted operator op(Counted a, T b) { return a op Counted(double(b)); }
MIXED(+) MIXED(-) MIXED(*) MIXED(/)

#define REAL Counted
#include "engine.c"

static void still(Counted, const Counted *, const Counted *, Counted *torque, void *) {
  for (int i = 0; i < 3; i++) torque[i] = 0;
}

int main() {
  const Counted J[3] = {1, 2, 2.5};
  Body start = {{1, 0, 0, 0}, {0.3, 0.5, 1.1}}, body = start;
  Counted m, work;
  operations = 0, so3_midpoint(J, &body, 0.05);
  std::printf("so3_midpoint %ld\n", operations);
  so3_prepare(J, &(body = start), 0.05, &m);
  operations = 0, so3_explicit(J, m, &body, 0.05);
  std::printf("so3_explicit %ld\n", operations);
  body = start, operations = 0, torqued_midpoint(J, still, nullptr, &body, 0, 0.05, &work);
  std::printf("torqued_midpoint %ld\n", operations);
}
