// The path for processors with AVX-512 BF16, which multiply pairs of bfloat16 (Zen 4, Cooper Lake, and what has AMX without being
// allowed to use it); in float32 it is the AVX-512 path.
#include "sampler.hpp"

#if SOLIDGRAIN_AVX512BF16
#include <cmath>
#include <cstdint>
#include <cstring>

#include <immintrin.h>

#include "target.hpp"
SOLIDGRAIN_TARGET("avx512bf16,avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")

#include "simd_avx512.hpp"
#include "simd_avx512bf16.hpp"

#include "noise.hpp"
#include "perceptron.hpp"

namespace {

size_t packed_bytes_of(const Sampler& sampler, const Layer& layer) {
  return (sampler.bfloat16 ? packed_bytes<Avx512, Bfloat16Pairs> : packed_bytes<Avx512>)(sampler, layer);
}

void pack_layer(const Sampler& sampler, const Layer& layer, void* packed) {
  (sampler.bfloat16 ? pack<Avx512, Bfloat16Pairs> : pack<Avx512>)(sampler, layer, packed);
}

size_t scratch_bytes_of(const Sampler& sampler) {
  return (sampler.bfloat16 ? scratch_bytes<Avx512, Bfloat16Pairs> : scratch_bytes<Avx512>)(sampler);
}

void perceive_points(const Sampler& sampler, const float* eta, int count, float* rgb, void* scratch) {
  (sampler.bfloat16 ? perceive<Avx512, Bfloat16Pairs> : perceive<Avx512>)(sampler, eta, count, rgb, scratch);
}

}  // namespace

const Path avx512bf16_path = {
    "avx512bf16", true, packed_bytes_of, pack_layer, scratch_bytes_of, look_up<Avx512, true>, perceive_points,
};

SOLIDGRAIN_TARGET_END
#endif
