// Sixteen lanes in AVX-512 registers (F, DQ, BW, VL).
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace {  // one per source file, each compiled for its own instruction sets

struct Avx512 {
  static constexpr int LANES = 16;
  static constexpr int TILE_OUTPUTS = 8, TILE_VECTORS = 3;  // accumulators of the perceptron: 24 of 32 registers
  typedef __m512 F;
  typedef __m512i I;
  struct D { __m512d low, high; };
  struct M { __mmask8 low, high; };

  static F load(const float* p) { return _mm512_loadu_ps(p); }
  static D load(const double* p) { return {_mm512_loadu_pd(p), _mm512_loadu_pd(p + 8)}; }
  static void store(float* p, F v) { _mm512_storeu_ps(p, v); }
  static void store(double* p, D v) { _mm512_storeu_pd(p, v.low), _mm512_storeu_pd(p + 8, v.high); }
  static F all(float v) { return _mm512_set1_ps(v); }
  static D all(double v) { return {_mm512_set1_pd(v), _mm512_set1_pd(v)}; }
  static I all(int32_t v) { return _mm512_set1_epi32(v); }

  static F fma(F a, F b, F c) { return _mm512_fmadd_ps(a, b, c); }
  static D fma(D a, D b, D c) { return {_mm512_fmadd_pd(a.low, b.low, c.low), _mm512_fmadd_pd(a.high, b.high, c.high)}; }
  static double fma(double a, double b, double c) { return _mm_cvtsd_f64(_mm_fmadd_sd(_mm_set_sd(a), _mm_set_sd(b), _mm_set_sd(c))); }
  static F sub(F a, F b) { return _mm512_sub_ps(a, b); }
  static F floor(F v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
  static F leaky(F v, F slope) { return _mm512_max_ps(v, _mm512_mul_ps(v, slope)); }
  static D add(D a, D b) { return {_mm512_add_pd(a.low, b.low), _mm512_add_pd(a.high, b.high)}; }
  static D sub(D a, D b) { return {_mm512_sub_pd(a.low, b.low), _mm512_sub_pd(a.high, b.high)}; }
  static D mul(D a, D b) { return {_mm512_mul_pd(a.low, b.low), _mm512_mul_pd(a.high, b.high)}; }
  static D floor(D v) {
    constexpr int down = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
    return {_mm512_roundscale_pd(v.low, down), _mm512_roundscale_pd(v.high, down)};
  }
  static M less(D a, D b) {
    return {_mm512_cmp_pd_mask(a.low, b.low, _CMP_LT_OQ), _mm512_cmp_pd_mask(a.high, b.high, _CMP_LT_OQ)};
  }
  static M equal(D a, D b) {
    return {_mm512_cmp_pd_mask(a.low, b.low, _CMP_EQ_OQ), _mm512_cmp_pd_mask(a.high, b.high, _CMP_EQ_OQ)};
  }
  static D add_where(M where, D v, D amount) {
    return {_mm512_mask_add_pd(v.low, where.low, v.low, amount.low),
            _mm512_mask_add_pd(v.high, where.high, v.high, amount.high)};
  }
  static I to_int(D v) {
    return _mm512_inserti64x4(_mm512_castsi256_si512(_mm512_cvttpd_epi32(v.low)), _mm512_cvttpd_epi32(v.high), 1);
  }
  static I to_int(F v) { return _mm512_cvttps_epi32(v); }
  static F to_float(D v) {
    return _mm512_insertf32x8(_mm512_castps256_ps512(_mm512_cvtpd_ps(v.low)), _mm512_cvtpd_ps(v.high), 1);
  }

  static I add(I a, I b) { return _mm512_add_epi32(a, b); }
  static I mul(I a, I b) { return _mm512_mullo_epi32(a, b); }
  static __mmask16 less(I a, I b) { return _mm512_cmplt_epi32_mask(a, b); }
  static __mmask16 equal(I a, I b) { return _mm512_cmpeq_epi32_mask(a, b); }
  static I add_where(__mmask16 where, I v, I amount) { return _mm512_mask_add_epi32(v, where, v, amount); }
  static I bit_and(I a, I b) { return _mm512_and_si512(a, b); }
  template <int N> static I shift_left(I v) { return _mm512_slli_epi32(v, N); }
  template <int N> static I shift_right(I v) { return _mm512_srli_epi32(v, N); }
  static F as_float(I v) { return _mm512_castsi512_ps(v); }

  static F gather(const float* table, I index) { return _mm512_i32gather_ps(index, table, 4); }
  // 32 bits: table[index] below, table[index + 1] above.
  static I gather(const uint16_t* table, I index) { return _mm512_i32gather_epi32(index, table, 2); }
  // Two neighbours in one read of 64 bits each: low = table[index], high = table[index + 1].
  static void gather_pair(const float* table, I index, F& low, F& high) {
    const I evens = _mm512_set_epi32(30, 28, 26, 24, 22, 20, 18, 16, 14, 12, 10, 8, 6, 4, 2, 0);
    const I odds = _mm512_set_epi32(31, 29, 27, 25, 23, 21, 19, 17, 15, 13, 11, 9, 7, 5, 3, 1);
    F first = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(index), table, 4));
    F second = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(index, 1), table, 4));
    low = _mm512_permutex2var_ps(first, evens, second);
    high = _mm512_permutex2var_ps(first, odds, second);
  }
};

}  // namespace
