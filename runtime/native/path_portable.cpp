// The path that every processor has.
#include "simd_portable.hpp"

#include "noise.hpp"
#include "perceptron.hpp"

const Path portable_path = {
    "portable", false, packed_bytes<Portable>, pack<Portable>, scratch_bytes<Portable>, look_up<Portable, false>, perceive<Portable>,
};
