// Pairs of bfloat16 in AVX-512 registers, for processors with AVX-512 BF16.
#pragma once

#include <immintrin.h>

#include "sampler.hpp"

namespace {

// Two rows of 16 points, inputs 2k and 2k + 1, as one row of pairs.
inline __m512i pairs(__m512 even, __m512 odd) {
  const __m512i order = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8,
                                         23, 7, 22, 6, 21, 5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
  return _mm512_permutexvar_epi16(order, (__m512i)_mm512_cvtne2ps_pbh(odd, even));
}

// Words of two inputs in bfloat16, the even one below (perceptron.hpp).
struct Bfloat16Pairs {
  static constexpr int INPUTS = 2;
  static void pack(const float (&weights)[2], float* word) {
    const uint32_t bits = round_to_bfloat16(weights[0]) | round_to_bfloat16(weights[1]) << 16;
    memcpy(word, &bits, sizeof bits);
  }
  static __m512 join(const __m512* inputs) { return _mm512_castsi512_ps(pairs(inputs[0], inputs[1])); }
  static __m512 add_product(__m512 weight, __m512 input, __m512 sum) {
    return _mm512_dpbf16_ps(sum, (__m512bh)weight, (__m512bh)input);
  }
};

}  // namespace
