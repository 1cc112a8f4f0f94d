// Eight lanes in AVX2 and FMA registers.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace {  // one per source file, each compiled for its own instruction sets

struct Avx2 {
  static constexpr int LANES = 8;
  static constexpr int TILE_OUTPUTS = 4, TILE_VECTORS = 3;  // accumulators of the perceptron: 12 of 16 registers
  typedef __m256 F;
  typedef __m256i I;
  struct D { __m256d low, high; };
  typedef D M;

  static F load(const float* p) { return _mm256_loadu_ps(p); }
  static D load(const double* p) { return {_mm256_loadu_pd(p), _mm256_loadu_pd(p + 4)}; }
  static void store(float* p, F v) { _mm256_storeu_ps(p, v); }
  static void store(double* p, D v) { _mm256_storeu_pd(p, v.low), _mm256_storeu_pd(p + 4, v.high); }
  static F all(float v) { return _mm256_set1_ps(v); }
  static D all(double v) { return {_mm256_set1_pd(v), _mm256_set1_pd(v)}; }
  static I all(int32_t v) { return _mm256_set1_epi32(v); }

  static F fma(F a, F b, F c) { return _mm256_fmadd_ps(a, b, c); }
  static D fma(D a, D b, D c) { return {_mm256_fmadd_pd(a.low, b.low, c.low), _mm256_fmadd_pd(a.high, b.high, c.high)}; }
  static double fma(double a, double b, double c) { return _mm_cvtsd_f64(_mm_fmadd_sd(_mm_set_sd(a), _mm_set_sd(b), _mm_set_sd(c))); }
  static F sub(F a, F b) { return _mm256_sub_ps(a, b); }
  static F leaky(F v, F slope) { return _mm256_max_ps(v, _mm256_mul_ps(v, slope)); }
  static D add(D a, D b) { return {_mm256_add_pd(a.low, b.low), _mm256_add_pd(a.high, b.high)}; }
  static D sub(D a, D b) { return {_mm256_sub_pd(a.low, b.low), _mm256_sub_pd(a.high, b.high)}; }
  static D mul(D a, D b) { return {_mm256_mul_pd(a.low, b.low), _mm256_mul_pd(a.high, b.high)}; }
  static D floor(D v) { return {_mm256_floor_pd(v.low), _mm256_floor_pd(v.high)}; }
  static M less(D a, D b) { return {_mm256_cmp_pd(a.low, b.low, _CMP_LT_OQ), _mm256_cmp_pd(a.high, b.high, _CMP_LT_OQ)}; }
  static M equal(D a, D b) { return {_mm256_cmp_pd(a.low, b.low, _CMP_EQ_OQ), _mm256_cmp_pd(a.high, b.high, _CMP_EQ_OQ)}; }
  static D add_where(M where, D v, D amount) {
    return add(v, D{_mm256_and_pd(where.low, amount.low), _mm256_and_pd(where.high, amount.high)});
  }
  static I to_int(D v) { return _mm256_set_m128i(_mm256_cvttpd_epi32(v.high), _mm256_cvttpd_epi32(v.low)); }
  static F to_float(D v) { return _mm256_set_m128(_mm256_cvtpd_ps(v.high), _mm256_cvtpd_ps(v.low)); }

  static I add(I a, I b) { return _mm256_add_epi32(a, b); }
  static I mul(I a, I b) { return _mm256_mullo_epi32(a, b); }
  static I less(I a, I b) { return _mm256_cmpgt_epi32(b, a); }
  static I equal(I a, I b) { return _mm256_cmpeq_epi32(a, b); }
  static I add_where(I where, I v, I amount) { return add(v, bit_and(where, amount)); }
  static I bit_and(I a, I b) { return _mm256_and_si256(a, b); }
  template <int N> static I shift_right(I v) { return _mm256_srli_epi32(v, N); }

  static F gather(const float* table, I index) { return _mm256_i32gather_ps(table, index, 4); }
  // Two neighbours in one read of 64 bits each: low = table[index], high = table[index + 1].
  static void gather_pair(const float* table, I index, F& low, F& high) {
    const double* base = reinterpret_cast<const double*>(table);
    F first = _mm256_castpd_ps(_mm256_i32gather_pd(base, _mm256_castsi256_si128(index), 4));
    F second = _mm256_castpd_ps(_mm256_i32gather_pd(base, _mm256_extracti128_si256(index, 1), 4));
    F evens = _mm256_shuffle_ps(first, second, 0x88), odds = _mm256_shuffle_ps(first, second, 0xdd);
    low = _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(evens), 0xd8));
    high = _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(odds), 0xd8));
  }
};

}  // namespace
