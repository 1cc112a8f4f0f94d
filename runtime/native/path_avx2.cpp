// The path for processors with AVX2 and FMA.
#if defined(__x86_64__)
#include <cmath>
#include <cstdint>
#include <cstring>

#include <immintrin.h>

#include "target.hpp"
SOLIDGRAIN_TARGET("avx2,fma")

#include "simd_avx2.hpp"

#include "noise.hpp"
#include "perceptron.hpp"

const Path avx2_path = {
    "avx2", false, packed_bytes<Avx2>, pack<Avx2>, scratch_bytes<Avx2>, look_up<Avx2, false>, perceive<Avx2>,
};

SOLIDGRAIN_TARGET_END
#endif
