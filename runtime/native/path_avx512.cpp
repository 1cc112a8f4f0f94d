// The path for processors with AVX-512.
#if defined(__x86_64__)
#include <cmath>
#include <cstdint>
#include <cstring>

#include <immintrin.h>

#include "target.hpp"
SOLIDGRAIN_TARGET("avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")

#include "simd_avx512.hpp"

#include "noise.hpp"
#include "perceptron.hpp"

const Path avx512_path = {
    "avx512", false, packed_bytes<Avx512>, pack<Avx512>, scratch_bytes<Avx512>, look_up<Avx512, false>, perceive<Avx512>,
};

SOLIDGRAIN_TARGET_END
#endif
