// Four lanes in the compiler's own vector types: SSE2, NEON, or plain registers where there is neither.
#pragma once

#include <cstdint>
#include <cstring>

namespace {  // one per source file, each compiled for its own instruction sets

struct Portable {
  static constexpr int LANES = 4;
  static constexpr int TILE_OUTPUTS = 4, TILE_VECTORS = 2;  // accumulators of the perceptron: 8 of 16 registers
  typedef float F __attribute__((vector_size(16)));
  typedef int32_t I __attribute__((vector_size(16)));
  typedef uint32_t U __attribute__((vector_size(16)));  // for what may overflow
  typedef double D __attribute__((vector_size(32)));
  typedef int64_t M __attribute__((vector_size(32)));

  template <class V, class T> static V load_as(const T* p) { V v; memcpy(&v, p, sizeof v); return v; }
  static F load(const float* p) { return load_as<F>(p); }
  static D load(const double* p) { return load_as<D>(p); }
  static void store(float* p, F v) { memcpy(p, &v, sizeof v); }
  static void store(double* p, D v) { memcpy(p, &v, sizeof v); }
  static F all(float v) { return F{v, v, v, v}; }
  static D all(double v) { return D{v, v, v, v}; }
  static I all(int32_t v) { return I{v, v, v, v}; }

  static F fma(F a, F b, F c) { return a * b + c; }
  static D fma(D a, D b, D c) { return a * b + c; }
  static double fma(double a, double b, double c) { return a * b + c; }
  static F sub(F a, F b) { return a - b; }
  static F leaky(F v, F slope) { return v > 0 ? v : v * slope; }
  static D add(D a, D b) { return a + b; }
  static D sub(D a, D b) { return a - b; }
  static D mul(D a, D b) { return a * b; }
  static D floor(D v) {
    D whole = __builtin_convertvector(__builtin_convertvector(v, M), D);
    return whole - (whole > v ? all(1.0) : all(0.0));
  }
  static M less(D a, D b) { return a < b; }
  static M equal(D a, D b) { return a == b; }
  static D add_where(M where, D v, D amount) { return where ? v + amount : v; }
  static I to_int(D v) { return __builtin_convertvector(v, I); }
  static F to_float(D v) { return __builtin_convertvector(v, F); }

  static I add(I a, I b) { return I(U(a) + U(b)); }
  static I mul(I a, I b) { return I(U(a) * U(b)); }
  static I less(I a, I b) { return a < b; }
  static I equal(I a, I b) { return a == b; }
  static I add_where(I where, I v, I amount) { return add(v, where & amount); }
  static I bit_and(I a, I b) { return a & b; }
  template <int N> static I shift_right(I v) { return I(U(v) >> N); }

  static F gather(const float* table, I index) {
    return F{table[index[0]], table[index[1]], table[index[2]], table[index[3]]};
  }
  // Two neighbours at once: low = table[index], high = table[index + 1].
  static void gather_pair(const float* table, I index, F& low, F& high) {
    low = gather(table, index);
    high = gather(table + 1, index);
  }
};

}  // namespace
