// The path for processors with AMX (bfloat16 tiles): noise in AVX-512, the perceptron in tiles.
#include "sampler.hpp"

#if SOLIDGRAIN_AMX
#include <cmath>
#include <cstdint>
#include <cstring>

#include <immintrin.h>

#include "target.hpp"
SOLIDGRAIN_TARGET("amx-tile,amx-bf16,avx512bf16,avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")

#include "simd_avx512.hpp"

#include "noise.hpp"
#include "perceptron_amx.hpp"

const Path amx_path = {
    "amx", true, amx_packed_bytes, amx_pack, amx_scratch_bytes, look_up<Avx512, true>, amx_perceive,
};

SOLIDGRAIN_TARGET_END
#endif
